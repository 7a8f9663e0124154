"""Conversion: the same bytes whoever does it and however often it is cut off."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import fsspec
import pytest
from PIL import Image

from envs.convert import convert
from envs.convert.__main__ import main
from envs.scene import SceneError
from envs.sources import SOURCES, Record, Source
from envs.sources.scenario import Scenario
from envs.sources.synthetic import straight_road
from envs.sources.tfrecord import frame
from envs.sources.womd import read_womd
from envs.store import SceneStore, read_manifest

REPOSITORY = Path(__file__).resolve().parents[2]


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def raw(make_scenario, tmp_path: Path) -> Path:
    """A folder of two TFRecord files with three and four scenes."""
    folder = tmp_path / "raw"
    folder.mkdir()
    for name, numbers in (("a.tfrecord", range(3)), ("b.tfrecord-00000-of-00001", range(3, 7))):
        records = [make_scenario(f"scene{number}", 1 + number % 3).SerializeToString() for number in numbers]
        (folder / name).write_bytes(b"".join(map(frame, records)))
    return folder


def test_every_scene_of_every_file_in_order(raw: Path, tmp_path: Path) -> None:
    store = convert("womd", [raw], tmp_path / "out", shard_size=2)
    assert store.scene_ids == [f"scene{number}" for number in range(7)]
    assert [entry["scenes"] for entry in store.manifests[0].shards] == [2, 2, 2, 1]
    assert store.provenance(4) == (str(raw / "b.tfrecord-00000-of-00001"), 1)
    assert store.num_agents.tolist() == [1, 2, 3, 1, 2, 3, 1]
    direct = list(read_womd(raw / "a.tfrecord"))
    for index, scene in enumerate(direct):
        assert (store[index].agents == scene.agents).all()
        assert (store[index].road == scene.road).all()
        assert (store[index].lights == scene.lights).all()
    store.verify()


def test_inputs_may_be_files_folders_and_patterns(raw: Path, tmp_path: Path) -> None:
    by_folder = convert("womd", [raw], tmp_path / "one")
    by_pattern = convert("womd", [raw / "b*", raw / "a.tfrecord"], tmp_path / "two")
    assert by_pattern.scene_ids == by_folder.scene_ids[3:] + by_folder.scene_ids[:3]
    with pytest.raises(SceneError, match=r"nothing\*: no input"):
        convert("womd", [raw / "nothing*"], tmp_path / "three")
    (raw / "empty").mkdir()
    with pytest.raises(SceneError, match=r"empty: no input.*\.tfrecord"):
        convert("womd", [raw / "empty"], tmp_path / "three")
    assert not (tmp_path / "three").exists()


def test_an_input_that_cannot_be_counted_is_read_in_one_pass_into_shards_of_its_own(raw: Path, tmp_path: Path) -> None:
    files = sorted(raw.iterdir())
    packed = raw / "b.tfrecord.gz"
    packed.write_bytes(gzip.compress(files[1].read_bytes()))
    store = convert("womd", [files[0], packed], tmp_path / "out", shard_size=2)
    assert store.scene_ids == [f"scene{number}" for number in range(7)]
    names = [entry["name"] for entry in store.manifests[0].shards]
    assert names == ["00000.scenes", "00001.scenes", "00002-0000.scenes", "00002-0001.scenes"]
    assert convert("womd", [packed], tmp_path / "limited", limit=3).scene_ids == ["scene3", "scene4", "scene5"]


def test_inputs_may_lie_behind_an_address(raw: Path, tmp_path: Path) -> None:
    memory = fsspec.filesystem("memory")
    for file in raw.iterdir():
        memory.pipe(f"/womd/{file.name}", file.read_bytes())
    here, there = convert("womd", [raw], tmp_path / "here"), tmp_path / "there"
    store = convert("womd", ["memory://womd"], there, shard_size=2)
    assert store.scene_ids == here.scene_ids
    assert (store[6].agents == here[6].agents).all()
    assert store.provenance(0) == ("memory:///womd/a.tfrecord", 0)
    assert convert("womd", ["memory://womd/b*"], tmp_path / "some").scene_ids == here.scene_ids[3:]
    with pytest.raises(SceneError, match=r"memory://nowhere/\*: no input there"):
        convert("womd", ["memory://nowhere/*"], tmp_path / "none")
    with pytest.raises(SceneError, match=r"moon://x: cannot be read .*moon"):
        convert("womd", ["moon://x"], tmp_path / "none")


def test_a_changed_input_is_another_plan(raw: Path, tmp_path: Path) -> None:
    convert("womd", [raw], tmp_path / "out")
    with (raw / "a.tfrecord").open("ab") as file:
        file.write(b"more")
    with pytest.raises(SceneError, match="of other inputs: .*known by their paths .* and by their sizes"):
        convert("womd", [raw], tmp_path / "out")


def test_the_data_card_counts_what_the_scenes_hold(raw: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    assert main(["womd", str(raw), str(out), "--shard-size", "2", "--split", "training"]) == 0
    card = (out / "card.md").read_text()
    assert "| scenes | 7 |" in card and "| split | training |" in card
    assert "| scenes with traffic lights | 7 (100%) |" in card
    assert "| vehicle | 13 | 1.9 | 10-11 / 10-11 m/s | 9-10 s | 90-100 m | 4.5-5 m |" in card
    with Image.open(out / "card.png") as picture:
        assert picture.size[0] > 1000
    assert str(out / "card.md") in capsys.readouterr().out


def test_what_a_reader_could_not_take_over_is_reported(make_scenario, tmp_path: Path, capsys) -> None:
    scenario = make_scenario()
    scenario.tracks[1].object_type = 9
    (tmp_path / "new.tfrecord").write_bytes(frame(scenario.SerializeToString()))
    assert main(["womd", str(tmp_path / "new.tfrecord"), str(tmp_path / "out")]) == 0
    assert "track of unknown object type 9, taken as OTHER: 1 times" in capsys.readouterr().out
    assert "unknown object type 9" in (tmp_path / "out/card.md").read_text()


def test_limit_takes_the_first_scenes(raw: Path, tmp_path: Path) -> None:
    assert convert("womd", [raw], tmp_path / "out", limit=4).scene_ids == [f"scene{number}" for number in range(4)]


def test_a_finished_conversion_is_only_opened(raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    convert("womd", [raw], tmp_path / "out")
    times = [path.stat().st_mtime_ns for path in sorted((tmp_path / "out").rglob("*"))]
    with monkeypatch.context() as patched:
        patched.setitem(SOURCES, "womd", replace(SOURCES["womd"], count=None))  # what would read every file to count
        convert("womd", [raw], tmp_path / "out")
    assert [path.stat().st_mtime_ns for path in sorted((tmp_path / "out").rglob("*"))] == times


@pytest.mark.parametrize("harm", ["cut", "removed"])
def test_a_shard_that_was_lost_or_damaged_is_made_again(raw: Path, tmp_path: Path, harm: str) -> None:
    out = tmp_path / "out"
    convert("womd", [raw], out, shard_size=3)
    before, shard = digests(out), out / "00001.scenes"
    if harm == "cut":
        shard.write_bytes(shard.read_bytes()[:-9])
    else:
        shard.unlink()
    with pytest.raises(SceneError, match=r"00001\.scenes.*convert the scenes again"):
        SceneStore(out)
    convert("womd", [raw], out, shard_size=3)
    assert digests(out) == before


def test_a_folder_that_cannot_be_written_is_told(raw: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "out").write_text("a file")
    assert main(["womd", str(raw), str(tmp_path / "out")]) == 2
    assert str(tmp_path / "out") in capsys.readouterr().err.splitlines()[-1]


def test_another_conversion_is_not_mixed_in(raw: Path, tmp_path: Path) -> None:
    convert("womd", [raw], tmp_path / "out")
    with pytest.raises(SceneError, match="another conversion .'shard_size': 256 there, 3 here"):
        convert("womd", [raw], tmp_path / "out", shard_size=3)
    with pytest.raises(SceneError, match=r"conversion of other inputs: .*raw; asked for is .*a\.tfrecord"):
        convert("womd", [raw / "a.tfrecord"], tmp_path / "out")
    with pytest.raises(SceneError, match="holds 'a.tfrecord' and no store"):
        convert("womd", [raw], raw)
    assert (raw / "a.tfrecord").exists()


def test_a_lost_shard_is_made_again_and_leftovers_go(raw: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    convert("womd", [raw], out, shard_size=2)
    whole = digests(out)
    (out / "00001.scenes").unlink()
    (out / ".partial-00001.scenes-77").write_bytes(b"half")
    manifest = json.loads((out / "manifest.json").read_text())
    (out / "manifest.json").write_text(json.dumps({**manifest, "complete": False, "shards": []}))
    convert("womd", [raw], out, shard_size=2)
    assert digests(out) == whole


def test_processes_that_want_the_same_store_wait_for_each_other(raw: Path, tmp_path: Path) -> None:
    with ThreadPoolExecutor(3) as pool:
        stores = list(pool.map(lambda _: convert("womd", [raw], tmp_path / "out", shard_size=1), range(3)))
    assert [len(store) for store in stores] == [7, 7, 7]
    convert("womd", [raw], tmp_path / "alone", shard_size=1)
    assert digests(tmp_path / "out") == digests(tmp_path / "alone")


def test_a_source_may_generate_its_scenes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    roads = Source(
        name="roads",
        help="straight roads",
        find=list,
        records=lambda cars: (
            Record(cars, i, lambda notes, i=i: straight_road(int(cars), seed=5 + i)) for i in range(3)
        ),
        count=lambda cars: 3,
        size=lambda cars: 0,
    )
    monkeypatch.setitem(SOURCES, "roads", roads)
    store = convert("roads", ["2", "4"], tmp_path / "out", shard_size=4)
    assert store.scene_ids == [f"straight_road_{cars}_{seed}" for cars in (2, 4) for seed in (5, 6, 7)]
    assert store.provenance(4) == ("4", 1)


def damage(raw: Path) -> None:
    """Make the second record of the second file unreadable."""
    path = raw / "b.tfrecord-00000-of-00001"
    data = bytearray(path.read_bytes())
    second = int.from_bytes(data[:8], "little") + 16
    data[second + 40] ^= 1
    path.write_bytes(data)


def test_a_bad_record_stops_the_conversion_and_finished_shards_stay(raw: Path, tmp_path: Path, capsys) -> None:
    damage(raw)
    out = tmp_path / "out"
    assert main(["womd", str(raw), str(out), "--shard-size", "3"]) == 2
    assert "b.tfrecord-00000-of-00001, record 1: the checksum" in capsys.readouterr().err.splitlines()[-1]
    assert sorted(path.name for path in out.iterdir()) == ["00000.scenes", "manifest.json"]
    with pytest.raises(SceneError, match="has not finished"):
        SceneStore(out)


def test_bad_records_can_be_skipped_and_are_listed(raw: Path, tmp_path: Path, capsys) -> None:
    damage(raw)
    with (raw / "b.tfrecord-00000-of-00001").open("ab") as file:
        file.write(b"rest of a record")
    out = tmp_path / "out"
    assert main(["womd", str(raw), str(out), "--shard-size", "3", "--skip-bad"]) == 0
    store = SceneStore(out)
    assert store.scene_ids == ["scene0", "scene1", "scene2", "scene3", "scene5", "scene6"]
    assert [(Path(skip["input"]).name[0], skip["record"]) for skip in store.manifests[0].skipped] == [
        ("b", 1),
        ("b", 4),
    ]
    assert "skipped   2" in capsys.readouterr().out
    store.verify()


def test_a_store_with_gaps_is_not_passed_off_as_whole(raw: Path, tmp_path: Path) -> None:
    damage(raw)
    out = tmp_path / "out"
    convert("womd", [raw], out, skip_bad=True)
    with pytest.raises(SceneError, match="made without a bad input"):
        convert("womd", [raw], out)


def test_a_limit_takes_what_a_cut_file_still_holds(raw: Path, tmp_path: Path) -> None:
    packed, whole = raw / "b.tfrecord.gz", (raw / "b.tfrecord-00000-of-00001").read_bytes()
    packed.write_bytes(gzip.compress(whole[: len(whole) * 3 // 4]))
    store = convert("womd", [packed], tmp_path / "out", limit=100, skip_bad=True)
    assert store.scene_ids == ["scene3", "scene4"]
    assert [skip["record"] for skip in store.manifests[0].skipped] == [2]
    with pytest.raises(SceneError, match="b.tfrecord.gz"):
        convert("womd", [packed], tmp_path / "strict", limit=100)


def test_a_shard_that_could_not_be_read_back_is_refused_before_any_work(raw: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shard_size must be at most 10000, got 70000"):
        convert("womd", [raw], tmp_path / "out", shard_size=70_000)


def test_nothing_but_bad_inputs_is_an_error(make_scenario, tmp_path: Path) -> None:
    bad = make_scenario()
    bad.ClearField("sdc_track_index")
    (tmp_path / "bad.tfrecord").write_bytes(frame(bad.SerializeToString()))
    with pytest.raises(SceneError, match="no input gave a scene; the first error: .*SDC"):
        convert("womd", [tmp_path / "bad.tfrecord"], tmp_path / "out", skip_bad=True)


def test_two_scenes_of_one_id_are_refused(raw: Path, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"scene scene0 occurs twice: .*a\.tfrecord.*a\.tfrecord"):
        convert("womd", [raw / "a.tfrecord", raw / "a.tfrecord"], tmp_path / "out", shard_size=2)


@pytest.mark.parametrize(("name", "value"), [("workers", 0), ("shard_size", 0), ("limit", 0)])
def test_numbers_must_be_positive(raw: Path, tmp_path: Path, name: str, value: int) -> None:
    with pytest.raises(ValueError, match=f"{name} must be 1 or more, got 0"):
        convert("womd", [raw], tmp_path / "out", **{name: value})


def test_info_and_verify(raw: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    convert("womd", [raw], out)
    assert main(["info", str(out)]) == 0
    assert "7 in 1 shards" in capsys.readouterr().out
    assert main(["info", str(out), "--ids"]) == 0
    assert capsys.readouterr().out.splitlines()[-7].split()[:2] == ["0", "scene0"]
    assert main(["verify", str(out)]) == 0
    data = bytearray((out / "00000.scenes").read_bytes())
    data[30] ^= 1
    (out / "00000.scenes").write_bytes(data)
    assert main(["verify", str(out)]) == 2
    assert "error: " in capsys.readouterr().err
    assert main(["info", str(tmp_path / "none")]) == 2


def alive(group: int) -> bool:
    """Whether any process of a process group still runs."""
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, pgrp = status.read_text().rpartition(")")[2].split()[:3]
        except OSError:
            continue
        if int(pgrp) == group and state != "Z":
            return True
    return False


def wait_until(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


@pytest.mark.slow
def test_killed_with_two_workers_and_resumed_with_one_gives_the_same_bytes(make_scenario, tmp_path: Path) -> None:
    records = [make_scenario(f"scene{number}", 30).SerializeToString() for number in range(3)]
    raw = tmp_path / "many.tfrecord"
    for number in range(100):
        scenario = Scenario.FromString(records[number % 3])
        scenario.scenario_id = f"scene{number}"
        with raw.open("ab") as file:
            file.write(frame(scenario.SerializeToString()))
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    command = [sys.executable, "-m", "envs.convert", "womd", raw, cut, "--shard-size", "4", "--workers", "2"]
    process = subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        wait_until((cut / "00001.scenes").exists)
    finally:
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    wait_until(lambda: not alive(process.pid))
    with pytest.raises(SceneError, match="has not finished"):
        SceneStore(cut)
    convert("womd", [raw], cut, shard_size=4)
    convert("womd", [raw], whole, shard_size=4)
    assert len(SceneStore(cut)) == 100
    assert digests(cut) == digests(whole)


def convert_and_leave(inputs: list[Path], out: Path) -> int:
    """A process that converts, forked so that it starts at once; returns its number."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns of threads; ours are idle
        child = os.fork()
    if child == 0:
        try:
            convert("womd", inputs, out, shard_size=3)
        finally:
            os._exit(0)
    return child


@pytest.mark.slow
def test_fifty_kills_at_random_moments_leave_the_bytes_of_an_undisturbed_conversion(make_scenario, tmp_path) -> None:
    records = [make_scenario(f"scene{number}", 20).SerializeToString() for number in range(60)]
    plain, packed = tmp_path / "plain.tfrecord", tmp_path / "packed.tfrecord.gz"
    plain.write_bytes(b"".join(map(frame, records[:30])))
    packed.write_bytes(gzip.compress(b"".join(map(frame, records[30:])), 1))
    inputs = [plain, packed]
    start = time.monotonic()
    convert("womd", inputs, tmp_path / "whole", shard_size=3)
    seconds, draw = time.monotonic() - start, random.Random(0)
    whole, kills, finished = digests(tmp_path / "whole"), 0, 0
    while kills < 50 or not finished:
        out = tmp_path / f"cut{finished}"
        child = convert_and_leave(inputs, out)
        time.sleep(draw.uniform(0, seconds / 3 if kills < 50 else 10 * seconds))
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        kills += os.WIFSIGNALED(status)
        if (out / "manifest.json").exists() and read_manifest(out).complete:
            assert digests(out) == whole
            finished += 1
    assert len(SceneStore(tmp_path / "cut0")) == 60


def test_a_script_without_a_main_guard_is_told_so_and_does_not_wait_for_itself(raw: Path, tmp_path: Path) -> None:
    script = tmp_path / "unguarded.py"
    call = f"convert('womd', [{str(raw)!r}], {str(tmp_path / 'out')!r}, shard_size=2, workers=2)"
    script.write_text(f"from envs.convert import convert\n{call}\n")
    ended = subprocess.run([sys.executable, script], cwd=REPOSITORY, capture_output=True, text=True, timeout=120)
    assert ended.returncode != 0
    assert 'under `if __name__ == "__main__":`' in ended.stderr
    assert "SceneError: a worker ended: what it said stands above" in ended.stderr


@pytest.mark.slow
def test_two_workers_give_the_same_bytes_as_one(raw: Path, tmp_path: Path) -> None:
    convert("womd", [raw], tmp_path / "one", shard_size=2)
    convert("womd", [raw], tmp_path / "two", shard_size=2, workers=2)
    assert digests(tmp_path / "one") == digests(tmp_path / "two")


def test_real_files_convert(shared: Path, tmp_path: Path) -> None:
    store = convert("womd", [shared / "scenes/womd"], tmp_path / "womd")
    assert store.scene_ids == ["637f20cafde22ff8", "ee519cf571686d19"]
    assert store.num_agents.tolist() == [50, 84]  # realism.md section 1.2
    lights = convert("gpudrive", [shared / "scenes/gpudrive/lights"], tmp_path / "lights", limit=2)
    assert lights.scene_ids == ["238786b3cccc4a0e", "48b0814dee9301a0"]
    argoverse = convert("argoverse", [shared / "scenes/argoverse2"], tmp_path / "argoverse")
    assert len(argoverse) == 3
    for source in (store, lights, argoverse):
        source.verify()
    together = SceneStore(*(source.folders[0] for source in (store, lights, argoverse)))
    assert len(together.select(complete_in=["sizes"])) == 4
    assert together.select(source="argoverse").scene_ids == argoverse.scene_ids
    size = sum((store.folders[0] / shard["name"]).stat().st_size for shard in store.manifests[0].shards)
    assert size / len(store) < 110_000  # bytes; the protos have 975 KB


if __name__ == "__main__":
    pytest.main([__file__])
