"""SceneStore: what comes back is what went in, and the files never change."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import json
import struct
from collections.abc import Callable
from dataclasses import asdict
from itertools import accumulate, pairwise
from pathlib import Path

import pytest
import torch
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from envs.card import Card
from envs.codec import decode, encode
from envs.scene import Lights, MapKind, Scene, SceneError, SceneSource, collate
from envs.shards import FORMAT_VERSION, Shard
from envs.sources.synthetic import build_scene, red_light, straight_road, two_cars_head_on
from envs.store import SceneStore


def assert_same(ours: Scene, theirs: Scene) -> None:
    assert ours.scene_id == theirs.scene_id
    assert torch.equal(ours.origin, theirs.origin)
    assert torch.equal(ours.lacks, theirs.lacks)
    for part in ("agents", "road", "lights"):
        mine, other = getattr(ours, part), getattr(theirs, part)
        for field in mine.__dataclass_fields__:
            left, right = getattr(mine, field), getattr(other, field)
            assert left.dtype == right.dtype, field
            assert left.shape == right.shape, field
            assert torch.equal(left, right), field


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def store(tmp_path: Path, write_store) -> SceneStore:
    return SceneStore(write_store(tmp_path / "store", [straight_road(3), red_light()], [two_cars_head_on()]))


def test_a_store_is_a_sequence_of_scenes(store: SceneStore) -> None:
    assert isinstance(store, SceneSource)
    assert len(store) == 3
    assert_same(store[0], straight_road(3))
    assert_same(store[1], red_light())
    assert_same(store[-1], two_cars_head_on())
    assert [scene.scene_id for scene in store] == store.scene_ids
    assert collate(list(store)).agents.valid.shape == (3, 3, 91)
    with pytest.raises(IndexError, match="scene 3 of 3"):
        store[3]


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Ragged scenes with gaps in the tracks, ids of any size and perhaps lights."""
    seed = draw(st.integers(0, 2**31))
    generator = torch.Generator().manual_seed(seed)
    agents, lights, links = draw(st.integers(1, 5)), draw(st.integers(0, 3)), draw(st.integers(0, 4))
    valid = torch.rand(agents, 91, generator=generator) > 0.4
    valid[:, 10] = draw(st.booleans())
    lines = [(MapKind.EDGE_BOUNDARY, torch.randn(draw(st.integers(1, 6)), 3, generator=generator)) for _ in range(3)]
    scene = build_scene(
        torch.randn(agents, 91, 3, generator=generator), lines, valid=valid, scene_id=f"{seed}-{agents}"
    )
    big = draw(st.sampled_from([1, 2**7, 2**15, 2**31, 2**62]))
    scene.agents.track_id = torch.arange(agents) - big
    scene.road.links = torch.randint(0, big, (links, 3), generator=generator)
    scene.origin = torch.randn(3, generator=generator, dtype=torch.float64)
    scene.lights = Lights(
        lane_id=torch.arange(lights),
        state=torch.randint(-1, 9, (lights, 91), generator=generator),
        stop_point=torch.randn(lights, 91, 3, generator=generator),
        batch_size=[],
    )
    return scene


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(made=st.lists(scenes(), min_size=1, max_size=4, unique_by=lambda scene: scene.scene_id))
def test_every_scene_comes_back_exactly(tmp_path_factory, write_store, made: list[Scene]) -> None:
    store = SceneStore(write_store(tmp_path_factory.mktemp("store"), made[:2], made[2:]))
    assert store.scene_ids == [scene.scene_id for scene in made]
    assert store.num_agents.tolist() == [int(scene.agents.present.sum()) for scene in made]
    for index, scene in enumerate(made):
        assert_same(store[index], scene)


def test_changing_a_loaded_scene_changes_neither_the_file_nor_the_next_load(store: SceneStore) -> None:
    before = digests(store.folders[0])
    scene = store[1]
    for part in (scene.agents, scene.road, scene.lights):
        for field in part.__dataclass_fields__:
            getattr(part, field).zero_()
    scene.origin.fill_(7)
    assert_same(store[1], red_light())
    assert digests(store.folders[0]) == before


def test_ids_subsets_and_provenance(store: SceneStore) -> None:
    name = two_cars_head_on().scene_id
    assert store.index_of(name) == 2
    part = store.subset([2, 0])
    assert len(part) == 2
    assert part.scene_ids == [name, straight_road(3).scene_id]
    assert part.index_of(name) == 0
    assert part.num_agents.tolist() == [2, 3]
    assert_same(part[1], straight_road(3))
    assert part.subset([1]).scene_ids == part.subset(part.num_agents > 2).scene_ids == part.scene_ids[1:]
    with pytest.raises(IndexError, match=r"whole numbers or a mask, got shape \(1,\) of float"):
        part.subset([0.5])
    assert store.provenance(1) == ("made", 1)
    with pytest.raises(SceneError, match="no scene 'red_light'"):
        part.index_of("red_light")


def test_a_store_travels_as_its_folders_and_opens_again(store: SceneStore) -> None:
    part = store.subset([1])
    part[0]
    _, (folders, rows) = part.__reduce__()
    assert (folders, rows.tolist()) == (store.folders, [1])
    arrived = copy.copy(part)
    assert arrived.scene_ids == ["red_light"]
    assert_same(arrived[0], red_light())


def test_several_folders_are_one_store_and_can_be_told_apart(tmp_path: Path, write_store) -> None:
    roads = write_store(tmp_path / "a", [straight_road(2), straight_road(5)], source="womd", split="training")
    lights = write_store(tmp_path / "b", [red_light()], source="sumo", split="test")
    store = SceneStore(roads, lights)
    assert store.scene_ids == ["straight_road_2_None", "straight_road_5_None", "red_light"]
    assert_same(store[2], red_light())
    assert store.select(source="sumo").scene_ids == ["red_light"]
    assert store.select(split="training", min_agents=3).scene_ids == ["straight_road_5_None"]
    assert copy.copy(store.select(has_lights=False)).scene_ids == store.scene_ids[:2]
    store.verify()
    with pytest.raises(ValueError, match="no split 'tune'; there is 'training', 'test'"):
        store.select(split="tune")
    with pytest.raises(SceneError, match="share scene red_light"):
        SceneStore(lights, lights)


def test_scenes_are_selected_by_what_they_hold(store: SceneStore) -> None:
    assert store.select(has_lights=True).scene_ids == ["red_light"]
    assert store.select(max_agents=2, has_lights=False).scene_ids == [two_cars_head_on().scene_id]
    assert len(store.select(complete_in=["topology"])) == 0
    assert len(store.select(complete_in=["lights"])) == 3
    with pytest.raises(ValueError, match="nothing is called 'signals'; a recording may lack .*LIGHTS"):
        store.select(complete_in=["signals"])
    assert len(store.select(min_agents=9)) == 0


@pytest.mark.parametrize("rows", [[], [0], [2, 0], [0, 1, 2], [0, 1, 3, 4], [5, 4, 3, 1], [3, 3, 3, 3]])
def test_the_card_of_a_view_is_that_of_its_scenes_one_by_one(tmp_path: Path, write_store, rows: list[int]) -> None:
    shards = [straight_road(3), red_light()], [two_cars_head_on(), *(straight_road(n, seed=n) for n in (1, 2, 4))]
    view = SceneStore(write_store(tmp_path / "cards", *shards)).subset(rows)
    one_by_one = Card()
    for scene in view:
        one_by_one.add(scene)
    assert view.card().counts == one_by_one.counts


def test_a_card_reads_the_fewer_scenes_of_a_shard(tmp_path: Path, write_store, monkeypatch) -> None:
    read, scene = [], Shard.scene
    monkeypatch.setattr(Shard, "scene", lambda shard, row: read.append(row) or scene(shard, row))
    store = SceneStore(write_store(tmp_path / "cards", [straight_road(n, seed=n) for n in (1, 2, 3, 4)]))
    for rows, expected in (([0, 1, 2, 3], []), ([0, 1, 3], [2]), ([3], [3]), ([2, 2, 2], [2, 2, 2])):
        read.clear()
        store.subset(rows).card()
        assert read == expected


def test_a_view_names_the_folders_that_its_scenes_came_from(tmp_path: Path, write_store) -> None:
    roads = write_store(tmp_path / "a", [straight_road(2), straight_road(5)], source="womd", split="training")
    lights = write_store(tmp_path / "b", [red_light()], source="sumo", split="test")
    origins = SceneStore(roads, lights).origins()
    assert [(each["source"], each["split"], each["scenes"]) for each in origins] == [
        ("womd", "training", 2), ("sumo", "test", 1),
    ]  # fmt: skip
    assert SceneStore(roads, lights).subset([2]).origins() == origins[1:]
    json.dumps(origins)


def test_blocks_are_runs_of_scenes_of_one_file(store: SceneStore) -> None:
    assert store.blocks == [2, 1]
    assert store.subset([0, 2, 1]).blocks == [1, 1, 1]
    assert store.subset([1, 0]).blocks == [2]
    assert store.subset([]).blocks == []


def test_values_at_invalid_steps_are_refused() -> None:
    scene = straight_road()
    scene.agents.valid[0, 50] = False
    with pytest.raises(SceneError, match=r"agents\.\w+ is not zero at an invalid step"):
        encode(scene)


def test_points_out_of_order_are_refused() -> None:
    scene = straight_road()
    scene.road.start = scene.road.start.flip(0)
    with pytest.raises(SceneError, match="do not lie behind each other"):
        encode(scene)


@settings(max_examples=200, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), change=st.integers(1, 255))
def test_a_damaged_block_is_an_error_and_never_another_scene(place: float, change: int) -> None:
    block = bytearray(encode(straight_road(3)))
    block[int(place * len(block))] ^= change
    with contextlib.suppress(SceneError):
        assert_same(decode(bytes(block)), straight_road(3))  # bits that mean nothing


@pytest.mark.parametrize("keep", [0, 1, 3, 20, -1])
def test_a_cut_block_is_an_error(keep: int) -> None:
    with pytest.raises(SceneError, match="the block of the scene"):
        decode(encode(straight_road(3))[:keep])


def change_json(path: Path, **changes: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_another_version_is_refused(store: SceneStore) -> None:
    change_json(store.folders[0] / "manifest.json", version=99)
    with pytest.raises(SceneError, match=r"manifest\.json: version 99 where 3"):
        SceneStore(*store.folders)


def test_a_shard_of_another_version_is_refused(store: SceneStore) -> None:
    path = store.folders[0] / "00000.scenes"
    path.write_bytes(path.read_bytes()[:-1] + b"\x01")
    with pytest.raises(SceneError, match=r"00000\.scenes: damaged \(no shard of version 3"):
        SceneStore(*store.folders)


def test_an_unfinished_conversion_is_refused(store: SceneStore) -> None:
    change_json(store.folders[0] / "manifest.json", complete=False)
    with pytest.raises(SceneError, match="has not finished"):
        SceneStore(*store.folders)


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"version": 3}', '{"version": 3, "surprise": 2}', "[" * 100_000, "\x00"]
)
def test_a_damaged_manifest_is_refused(store: SceneStore, content: str) -> None:
    (store.folders[0] / "manifest.json").write_text(content)
    with pytest.raises(SceneError, match=r"manifest\.json"):
        SceneStore(*store.folders)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shards": 7}, "damaged .shards is 7, which it must not be"),
        ({"shards": [{"name": "00000.scenes"}]}, r"damaged .shards\[0\] is "),
        ({"shards": [{"name": "x.scenes", "scenes": -1, "sha256": ""}]}, r"damaged .shards\[0\]\['scenes'\] is -1"),
        ({"shards": [{"name": "../x.scenes", "scenes": 1, "sha256": ""}]}, "no shard can be named '../x.scenes'"),
        ({"notes": {"note": "often"}}, r"damaged .notes\['note'\] is 'often'"),
        ({"options": None}, "damaged .options is None"),
        ({"complete": "yes"}, "damaged .complete is 'yes'"),
        ({"a\nb": 1}, "damaged .*unexpected keyword"),
    ],
)
def test_a_manifest_of_wrong_values_is_named(store: SceneStore, changes: dict, message: str) -> None:
    change_json(store.folders[0] / "manifest.json", **changes)
    with pytest.raises(SceneError, match=rf"manifest\.json: {message}") as caught:
        SceneStore(*store.folders)
    assert str(caught.value).isprintable()


def test_a_store_without_scenes_can_be_asked_for_some(store: SceneStore) -> None:
    change_json(store.folders[0] / "manifest.json", shards=[])
    assert len(SceneStore(*store.folders).select(source="made", has_lights=True)) == 0


def rewrite(path: Path, change_block: Callable = bytes, **changes: object) -> None:
    """Write a shard anew, with checksums that fit: its first scene changed, or values of its record."""
    shard, data = Shard(path), path.read_bytes()
    ends = [*accumulate(shard.record.sizes, initial=8)]
    blocks = [data[start:end] for start, end in pairwise(ends)]
    blocks[0] = zstandard.compress(change_block(zstandard.decompress(blocks[0])))
    content = {"version": FORMAT_VERSION, **asdict(shard.record), "sizes": [*map(len, blocks)], **changes}
    record = zstandard.compress(json.dumps(content).encode())
    path.write_bytes(data[:8] + b"".join(blocks) + record + struct.pack("<Q", len(record)) + data[:8])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene_ids": ["a"]}, "units has not one value for each of 1 scenes"),
        ({"scene_ids": ["a", 7]}, r"scene_ids\[1\] is 7"),
        ({"scene_ids": ["a", "two\nlines"]}, r"scenario_id is 'two\\nlines'; must be text"),
        ({"sizes": [5, -5]}, r"sizes\[1\] is -5"),
        ({"sizes": [5, 6]}, "sizes are not those of its blocks"),
        ({"num_agents": [2**80, 1]}, r"num_agents\[0\] is 1208\d+"),
        ({"units": [["made", 0, 0], ["made", 1]]}, r"units\[0\] is \["),
        ({"lacks": None}, "lacks is None"),
        ({"card": {"scenes": 1}}, r"card\['scenes'\] is 1"),
    ],
)
def test_a_record_of_wrong_values_is_named(store: SceneStore, changes: dict, message: str) -> None:
    rewrite(store.folders[0] / "00000.scenes", **changes)
    with pytest.raises(SceneError, match=rf"00000\.scenes: (damaged \()?{message}"):
        SceneStore(*store.folders)


def test_a_record_that_is_nested_without_end_is_named(store: SceneStore) -> None:
    path = store.folders[0] / "00000.scenes"
    record = zstandard.compress(b"[" * 100_000)
    path.write_bytes(path.read_bytes()[:8] + record + struct.pack("<Q", len(record)) + path.read_bytes()[:8])
    with pytest.raises(SceneError, match=r"00000\.scenes: damaged .*recursion"):
        SceneStore(*store.folders)


def other_count(table: int, count: int) -> Callable[[bytes], bytes]:
    return lambda data: data[: 4 * table] + struct.pack("<I", count) + data[4 * table + 4 :]


def empty_agents(data: bytes) -> bytes:
    """A scene of agents that are never valid: few bytes, and gigabytes if they were unpacked."""
    count = 6_000_000
    return struct.pack("<9I", 1, count, *[0] * 7) + bytes(32 + count * (12 + 8 + 8) + -(-count * 91 // 8) + count // 4)


def lights_without_listings(data: bytes) -> bytes:
    return struct.pack("<9I", 1, *[0] * 5, 1, 0, 0) + bytes(32 + 8)


def nothing_at_all(data: bytes) -> bytes:
    return struct.pack("<9I", 1, *[0] * 8) + bytes(32)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (other_count(1, 2**32 - 1), "bytes where its header asks for"),
        (empty_agents, "claims 6000000 agents; at most 100000"),
        (lights_without_listings, "has 0 listings of 1 lights"),
        (nothing_at_all, "it holds the scene '' instead"),
        (lambda data: data[:-3] + b"\xff\xff\xff", "an id that is no text"),
        (lambda data: data[:-1] + b"?", r"it holds the scene 'straight_road_3_Non\?' instead"),
    ],
)
def test_a_block_that_does_not_fit_itself_is_named(store: SceneStore, change: Callable, message: str) -> None:
    rewrite(store.folders[0] / "00000.scenes", change)
    changed = SceneStore(*store.folders)
    with pytest.raises(SceneError, match=rf"00000\.scenes, scene 0 \(straight_road_3_None\): .*{message}"):
        changed[0]
    assert_same(changed[1], red_light())


def test_verify_names_the_file_and_the_scene_that_is_not_valid(store: SceneStore) -> None:
    path = store.folders[0] / "00000.scenes"
    rewrite(path, lambda data: data[:36] + b"\xff" * 24 + data[60:])  # the origin becomes NaN
    entries = json.loads((store.folders[0] / "manifest.json").read_text())["shards"]
    entries[0]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    change_json(store.folders[0] / "manifest.json", shards=entries)
    with pytest.raises(SceneError, match=r"00000\.scenes, scene 0 \(scene straight_road_3_None\): the origin is \[nan"):
        SceneStore(*store.folders).verify()


def test_a_missing_shard_or_store_is_refused(store: SceneStore) -> None:
    (store.folders[0] / "00001.scenes").rename(store.folders[0] / "elsewhere")
    with pytest.raises(SceneError, match=r"00001.*missing"):
        SceneStore(*store.folders)
    with pytest.raises(SceneError, match=r"nowhere does not exist; name a folder"):
        SceneStore(store.folders[0] / "nowhere")


def test_a_damaged_scene_is_named_and_the_others_stay_readable(store: SceneStore) -> None:
    path = store.folders[0] / "00000.scenes"
    data = bytearray(path.read_bytes())
    data[store._shards[0].record.sizes[0] + 40] ^= 1  # in the second scene
    path.write_bytes(data)
    with pytest.raises(SceneError, match=r"00000\.scenes, scene 1 \(red_light\): .*checksum"):
        store[1]
    assert_same(store[0], straight_road(3))


@pytest.mark.parametrize("name", ["00000.scenes", "00001.scenes"])
@pytest.mark.parametrize("place", [0.001, 0.5])
def test_verify_finds_one_changed_byte(store: SceneStore, name: str, place: float) -> None:
    store.verify()
    path = store.folders[0] / name
    data = bytearray(path.read_bytes())
    data[int(len(data) * place)] ^= 1
    path.write_bytes(data)
    with pytest.raises(SceneError, match=f"{name}: changed since"):
        store.verify()


@pytest.mark.parametrize("cut", [1, 7, 40, 400])
def test_a_cut_shard_is_refused(store: SceneStore, cut: int) -> None:
    path = store.folders[0] / "00001.scenes"
    path.write_bytes(path.read_bytes()[:-cut])
    with pytest.raises(SceneError, match=r"00001\.scenes: damaged \(no shard of version 3, or a cut one"):
        Shard(path)


if __name__ == "__main__":
    pytest.main([__file__])
