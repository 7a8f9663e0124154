"""Every fault of a submission is found, each once and by its name, and the command says so."""

from __future__ import annotations

import gzip
import io
import json
import re
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dpa.realism.submission import CorruptError, SubmissionReader, encode_rollouts, validate, wire
from dpa.realism.submission.__main__ import main
from dpa.realism.submission.messages import SimAgentsChallengeSubmission, SimulatedTrajectory
from envs.scene import CURRENT_STEP, Scene
from envs.sources.scenario import Scenario
from envs.sources.tfrecord import frame
from tests.dpa.realism.submissions import IDS, METADATA, ROLLOUTS, SCENES, shard_bytes, write


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "mine.tar.gz"
    write(path)
    return path


Files = dict[str, bytes]
NAMES = [wire.shard_name(number, 2) for number in range(2)]


def two_shards(edit: Callable[[list], object] = lambda messages: None) -> Files:
    messages = [encode_rollouts(scene, poses) for scene, poses in zip(SCENES, ROLLOUTS, strict=True)]
    edit(messages)
    return {name: shard_bytes(messages[number::2]) for number, name in enumerate(NAMES)}


def pack(path: Path, files: Files, **mode: str) -> Path:
    with tarfile.open(path, **(mode or {"mode": "w:gz"})) as archive:
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return path


def trajectory(messages: list, rollout: int = 7) -> SimulatedTrajectory:
    return messages[1].joint_scenes[rollout].simulated_trajectories[0]


def add_object(messages: list, object_id: int) -> None:
    row = messages[1].joint_scenes[7].simulated_trajectories.add()
    row.CopyFrom(trajectory(messages))
    row.object_id = object_id


def in_scene_frame(messages: list) -> None:
    scene = SCENES[1].clone(recurse=False)
    scene.origin = torch.zeros(3, dtype=torch.float64)
    messages[1] = encode_rollouts(scene, ROLLOUTS[1])


EDITS: dict[str, tuple[Callable[[list], object], list[tuple[str, str]]]] = {
    "whole": (lambda m: None, []),
    "missing object": (
        lambda m: m[1].joint_scenes[7].simulated_trajectories.pop(),
        [("missing-object", f"{NAMES[1]}: scenario scene_1, rollout 7, object 2: is missing")],
    ),
    "extra object": (lambda m: add_object(m, 99), [("extra-object", "scene_1, rollout 7, object 99: is not there")]),
    "object twice": (lambda m: add_object(m, 1), [("duplicate-object", "rollout 7, object 1: comes 2 times")]),
    "no object id": (
        lambda m: trajectory(m).ClearField("object_id"),
        [
            ("no-object-id", "rollout 7: a trajectory has no object id"),
            ("missing-object", "object 1: is missing"),
            ("extra-object", "object 0: is not there"),
        ],
    ),
    "31 rollouts": (lambda m: m[1].joint_scenes.pop(), [("rollouts", "must have 32 rollouts .*, has 31")]),
    "33 rollouts": (lambda m: m[1].joint_scenes.append(m[1].joint_scenes[0]), [("rollouts", "has 33")]),
    "79 entries": (lambda m: trajectory(m).center_z.pop(), [("length", "object 1: center_z must have 80 .* has 79")]),
    "81 entries": (lambda m: trajectory(m).heading.append(0), [("length", "object 1: heading must have 80 .* 81")]),
    "no entries": (lambda m: trajectory(m).ClearField("center_x"), [("length", "center_x must have 80 .* has 0")]),
    "nan": (
        lambda m: trajectory(m).center_y.__setitem__(5, float("nan")),
        [("not-finite", "center_y is nan at simulated step 5")],
    ),
    "both infinities": (
        lambda m: trajectory(m).heading.__setitem__(slice(3, 5), [float("inf"), float("-inf")]),
        [("not-finite", "heading is inf at simulated step 3")],
    ),
    "no scenario id": (
        lambda m: m[1].ClearField("scenario_id"),
        [("no-scenario-id", "the scenario id is missing"), ("missing-scenario", "scenario scene_1: is not in")],
    ),
    "unknown scenario": (
        lambda m: setattr(m[1], "scenario_id", "elsewhere"),
        [("unknown-scenario", "elsewhere: is none of the 4"), ("missing-scenario", "scene_1")],
    ),
    "scenario twice": (
        lambda m: m.append(m[1]),
        [("duplicate-scenario", f"{NAMES[0]}: scenario scene_1: comes again|scene_1: comes again")],
    ),
    "missing scenario": (lambda m: m.pop(), [("missing-scenario", "scenario scene_3: is not in the submission")]),
    "scene frame": (in_scene_frame, [("frame", "scene_1, rollout 0: half of the objects start .* world coordinates")]),
    "several": (
        lambda m: (m[3].joint_scenes.pop(), trajectory(m, 2).center_x.pop(), trajectory(m, 9).center_x.pop()),
        [("length", "rollout 2"), ("length", "rollout 9"), ("rollouts", "scene_3")],
    ),
}


def check_faults(path: Path, expected: list[tuple[str, str]]) -> None:
    faults = validate(path, SCENES)
    assert [fault.kind for fault in faults] == [kind for kind, _ in expected], list(map(str, faults))
    for fault, (_, message) in zip(faults, expected, strict=True):
        assert re.search(message, fault.message)
    assert validate(path, SCENES) == faults


@pytest.mark.parametrize("case", EDITS)
def test_every_fault_of_rollouts_is_found(tmp_path: Path, case: str) -> None:
    edit, expected = EDITS[case]
    files = two_shards(edit)
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    check_faults(tmp_path, expected)


def other_metadata(**changes: object) -> bytes:
    message = SimAgentsChallengeSubmission.FromString(METADATA.to_bytes())
    for name, value in changes.items():
        message.ClearField(name) if value is None else setattr(message, name, value)
    return message.SerializeToString()


PACKS: dict[str, tuple[Callable[[Files], Files], list[tuple[str, str]]]] = {
    "renamed": (lambda f: {f"other{name}": data for name, data in f.items()}, []),
    "other file": (lambda f: {**f, "notes.txt": b"x"}, [("shard-name", "notes.txt: no name of a shard")]),
    "folder": (
        lambda f: {f"run/{name}": data for name, data in f.items()},
        [("folder", f"run/{name}: lies in a folder") for name in NAMES],
    ),
    "dot folder": (lambda f: {f"./{name}": data for name, data in f.items()}, [("folder", "lies in a folder")] * 2),
    "missing shard": (
        lambda f: {NAMES[0]: f[NAMES[0]]},
        [
            ("missing-shard", f"{NAMES[1]}: is missing"),
            ("missing-scenario", "scene_1"),
            ("missing-scenario", "scene_3"),
        ],
    ),
    "number too large": (
        lambda f: {NAMES[0]: f[NAMES[0]], "submission.binproto-00002-of-00002": f[NAMES[1]]},
        [("missing-shard", "00001-of-00002"), ("shard-name", "00002-of-00002: its number is not below 2")],
    ),
    "mixed sets": (
        lambda f: {NAMES[0]: f[NAMES[0]], "submission.binproto": f[NAMES[1]]},
        [("mixed-shards", "shards of different sets"), ("missing-shard", "00001-of-00002")],
    ),
    "empty": (
        lambda f: {},
        [("no-shards", "holds no shard"), *[("missing-scenario", name) for name in IDS]],
    ),
    "no metadata": (
        lambda f: {name: data[len(METADATA.to_bytes()) :] for name, data in f.items()},
        [("metadata", f"{NAMES[0]}: metadata: .* is missing")] * 8,
    ),
    "metadata differ": (
        lambda f: f | {NAMES[1]: other_metadata(num_model_parameters="8M") + f[NAMES[1]][len(METADATA.to_bytes()) :]},
        [("metadata-differ", f"{NAMES[1]}: num_model_parameters is '8M', but '7M' in {NAMES[0]}")],
    ),
    "metadata invalid": (
        lambda f: {
            name: other_metadata(account_name="me", unique_method_name=None) + data[len(METADATA.to_bytes()) :]
            for name, data in f.items()
        },
        [("metadata", "unique_method_name is missing"), ("metadata", "account_name must be the e-mail .* got 'me'")],
    ),
    "metadata that cannot be read": (
        lambda f: {NAMES[0]: f[NAMES[0]], NAMES[1]: f[NAMES[1]] + wire.varint(1 << 34) + b"\x00"},
        [("metadata", f"{NAMES[1]}: the metadata cannot be read")],
    ),
    "cut proto": (lambda f: f | {NAMES[1]: f[NAMES[1]][:-10]}, [("corrupt", f"{NAMES[1]}: ends within the field")]),
    "no proto": (lambda f: f | {NAMES[0]: b"\x07nonsense"}, [("corrupt", "byte 0 starts no field")]),
    "broken scenario": (
        lambda f: f | {NAMES[0]: METADATA.to_bytes() + wire.rollouts_head(3) + b"\x0a\x7fx"},
        [("corrupt", "a scenario in there cannot be read")],
    ),
}


@pytest.mark.parametrize("case", PACKS)
def test_every_fault_of_an_archive_is_found(tmp_path: Path, case: str) -> None:
    change, expected = PACKS[case]
    check_faults(pack(tmp_path / "mine.tar.gz", change(two_shards())), expected)


def test_a_plain_tar_is_refused(tmp_path: Path) -> None:
    path = pack(tmp_path / "mine.tar", two_shards(), mode="w")
    check_faults(path, [("corrupt", "is no .tar.gz, the only form that the challenge takes")])
    check_faults(path.rename(tmp_path / "mine.tar.gz"), [("corrupt", "is no .tar.gz")])


def test_a_shard_twice_and_a_real_folder_in_an_archive_are_found(tmp_path: Path) -> None:
    path = tmp_path / "mine.tar.gz"
    files = two_shards()
    with tarfile.open(path, "w:gz") as archive:
        for name in (NAMES[0], NAMES[1], NAMES[1]):
            member = tarfile.TarInfo(name)
            member.size = len(files[name])
            archive.addfile(member, io.BytesIO(files[name]))
        folder = tarfile.TarInfo("run")
        folder.type = tarfile.DIRTYPE
        archive.addfile(folder)
    kinds = ["duplicate-scenario", "duplicate-scenario", "not-a-file", "duplicate-shard"]
    assert [fault.kind for fault in validate(path, SCENES)] == kinds


def test_a_shard_that_is_too_large_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, archive: Path) -> None:
    monkeypatch.setattr(wire, "MAX_SHARD_BYTES", 1000)
    check_faults(archive, [("shard-size", "a shard must have less than 1000: use more shards")] * 2)


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.7, 0.999])
def test_a_cut_archive_is_one_fault(tmp_path: Path, archive: Path, kept: float) -> None:
    path = tmp_path / "mine.tar.gz"
    data = archive.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    assert [fault.kind for fault in validate(path, SCENES)] == ["corrupt"]
    with pytest.raises(CorruptError, match="mine.tar.gz"):
        list(SubmissionReader(path))


@pytest.mark.parametrize("where", [0.2, 0.5, 0.9])
def test_a_flipped_byte_is_one_fault(tmp_path: Path, archive: Path, where: float) -> None:
    path = tmp_path / "mine.tar.gz"
    data = bytearray(archive.read_bytes())
    data[int(where * len(data))] ^= 0x10
    path.write_bytes(data)
    assert "corrupt" in [fault.kind for fault in validate(path, SCENES)]
    assert not [fault for fault in validate(path, SCENES) if fault.kind.startswith("missing-s")]


@pytest.mark.parametrize("kept", [0.4, 0.5, 0.8])
def test_a_tar_that_was_cut_before_it_was_packed_is_one_fault(tmp_path: Path, archive: Path, kept: float) -> None:
    path = tmp_path / "mine.tar.gz"
    data = gzip.decompress(archive.read_bytes())
    path.write_bytes(gzip.compress(data[: int(kept * len(data))], 1))
    assert [fault.kind for fault in validate(path, SCENES)] == ["corrupt"]


def test_a_broken_header_inside_an_archive_is_not_its_end(tmp_path: Path, archive: Path) -> None:
    path = tmp_path / "mine.tar.gz"
    data = bytearray(gzip.decompress(archive.read_bytes()))
    data[data.index(NAMES[1].encode()) + 120] ^= 1
    path.write_bytes(gzip.compress(data, 1))
    assert [fault.kind for fault in validate(path, SCENES)] == ["corrupt"]


# --- command -------------------------------------------------------------------------------------------------------


def current_step_only(scene: Scene) -> bytes:
    """A Scenario of 11 steps, as in the test split."""
    position = (scene.agents.position[:, CURRENT_STEP].double() + scene.origin).tolist()
    now = [{"center_x": x, "center_y": y, "center_z": z, "valid": True} for x, y, z in position]
    states = [[{}] * CURRENT_STEP + [state] for state in now]
    ids = scene.agents.track_id.tolist()
    tracks = [{"id": track, "states": rows} for track, rows in zip(ids, states, strict=True)]
    gone = {"id": 77, "states": [{"valid": True}] * CURRENT_STEP + [{}]}
    return Scenario(scenario_id=scene.scene_id, tracks=[*tracks, gone]).SerializeToString()


def test_the_command_checks_against_scenario_files(
    tmp_path: Path, archive: Path, capsys: pytest.CaptureFixture
) -> None:
    scenes, out = tmp_path / "test.tfrecord", tmp_path / "faults.json"
    scenes.write_bytes(b"".join(frame(current_step_only(scene)) for scene in SCENES))
    assert main(["validate", str(archive), "--scenes", str(scenes), "--json", str(out)]) == 0
    assert json.loads(out.read_text()) == {"path": str(archive), "valid": True, "faults": []}
    scenes.write_bytes(b"".join(frame(current_step_only(scene)) for scene in SCENES[:3]))
    assert main(["validate", str(archive), "--scenes", str(scenes), "--json", str(out)]) == 1
    (fault,) = json.loads(out.read_text())["faults"]
    assert fault["kind"] == "unknown-scenario" and fault["scenario"] == "scene_3" and fault["shard"] == NAMES[1]
    assert fault["message"] in capsys.readouterr().out


def test_the_command_checks_against_a_store(tmp_path: Path, write_store, archive: Path) -> None:
    assert main(["validate", str(archive), "--scenes", str(write_store(tmp_path / "store", SCENES))]) == 0


def test_info_says_what_a_submission_holds(archive: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["info", str(archive)]) == 0
    text = capsys.readouterr().out
    for part in ("shards      2", "scenarios   4", "objects     2.0", "account_name: me@example.org"):
        assert part in text


def test_what_cannot_be_read_has_a_status_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["info", str(tmp_path / "nothing.tar.gz")]) == 2
    assert main(["validate", str(tmp_path), "--scenes", str(tmp_path / "nothing")]) == 2
    damaged = tmp_path / "mine.tar.gz"
    damaged.write_bytes(b"\x1f\x8bnonsense")
    assert main(["info", str(damaged)]) == 1
    assert capsys.readouterr().err.count("error: ") == 3
    with pytest.raises(SystemExit) as caught:
        main(["validate", str(damaged)])
    assert caught.value.code == 2


if __name__ == "__main__":
    pytest.main([__file__])
