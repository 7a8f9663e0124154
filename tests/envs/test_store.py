"""SceneStore: what comes back is what went in, and the files never change."""

from __future__ import annotations

import copy
import hashlib
import json
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from envs.scene import Lights, MapKind, Scene, SceneError, SceneSource, collate
from envs.shards import file_digest, write_shard
from envs.sources.synthetic import build_scene, red_light, straight_road, two_cars_head_on
from envs.store import Manifest, SceneStore, write_manifest


def store_of(folder: Path, *shards: list[Scene]) -> SceneStore:
    """A store written by hand, one shard for each list of scenes."""
    entries = []
    folder.mkdir(parents=True, exist_ok=True)
    for number, scenes in enumerate(shards):
        name = f"{number:05d}"
        write_shard(folder / name, scenes, [("made", row) for row in range(len(scenes))])
        digest = file_digest(folder / name / "shard.json")
        entries.append({"name": name, "scenes": len(scenes), "sha256": digest})
    write_manifest(folder, Manifest("made", {}, "", complete=True, shards=entries))
    return SceneStore(folder)


def assert_same(ours: Scene, theirs: Scene) -> None:
    assert ours.scene_id == theirs.scene_id
    assert torch.equal(ours.origin, theirs.origin)
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
def store(tmp_path: Path) -> SceneStore:
    return store_of(tmp_path / "store", [straight_road(3), red_light()], [two_cars_head_on()])


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
def test_every_scene_comes_back_exactly(tmp_path_factory: pytest.TempPathFactory, made: list[Scene]) -> None:
    store = store_of(tmp_path_factory.mktemp("store"), made[:2], *([made[2:]] if made[2:] else []))
    assert store.scene_ids == [scene.scene_id for scene in made]
    assert store.num_agents.tolist() == [int(scene.agents.present.sum()) for scene in made]
    for index, scene in enumerate(made):
        assert_same(store[index], scene)


def test_changing_a_loaded_scene_changes_neither_the_file_nor_the_next_load(store: SceneStore) -> None:
    before = digests(store.folder)
    scene = store[1]
    for part in (scene.agents, scene.road, scene.lights):
        for field in part.__dataclass_fields__:
            getattr(part, field).zero_()
    scene.origin.fill_(7)
    assert_same(store[1], red_light())
    assert digests(store.folder) == before


def test_even_the_mapped_arrays_cannot_reach_the_file(store: SceneStore) -> None:
    before = digests(store.folder)
    shard = store._shards[0]
    shard.scene(0)
    for values in shard._arrays.values():
        values.zero_()
    assert digests(store.folder) == before


def test_ids_subsets_and_provenance(store: SceneStore) -> None:
    name = two_cars_head_on().scene_id
    assert store.index_of(name) == 2
    part = store.subset([2, 0])
    assert len(part) == 2
    assert part.scene_ids == [name, straight_road(3).scene_id]
    assert part.index_of(name) == 0
    assert part.num_agents.tolist() == [2, 3]
    assert_same(part[1], straight_road(3))
    assert part.subset([1]).scene_ids == part.scene_ids[1:]
    assert store.provenance(1) == ("made", 1)
    with pytest.raises(SceneError, match="no scene 'red_light'"):
        part.index_of("red_light")


def test_a_store_travels_as_its_folder_and_opens_again(store: SceneStore) -> None:
    part = store.subset([1])
    part[0]
    _, (folder, rows) = part.__reduce__()
    assert (folder, rows.tolist()) == (store.folder, [1])
    arrived = copy.copy(part)
    assert arrived.scene_ids == ["red_light"]
    assert_same(arrived[0], red_light())


def test_values_at_invalid_steps_are_refused(tmp_path: Path) -> None:
    scene = straight_road()
    scene.agents.valid[0, 50] = False
    with pytest.raises(SceneError, match=r"agents\.\w+ is not zero at an invalid step"):
        write_shard(tmp_path / "shard", [scene], [("made", 0)])
    assert not list(tmp_path.iterdir())


def change_json(path: Path, **changes: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize("name", ["manifest.json", "00000/shard.json"])
def test_another_version_is_refused(store: SceneStore, name: str) -> None:
    change_json(store.folder / name, version=99)
    with pytest.raises(SceneError, match=rf"{name}: version 99 where 1"):
        SceneStore(store.folder)


def test_an_unfinished_conversion_is_refused(store: SceneStore) -> None:
    change_json(store.folder / "manifest.json", complete=False)
    with pytest.raises(SceneError, match="has not finished"):
        SceneStore(store.folder)


@pytest.mark.parametrize("content", ["{", "[]", '{"version": 1}', '{"version": 1, "surprise": 2}'])
def test_a_damaged_manifest_is_refused(store: SceneStore, content: str) -> None:
    (store.folder / "manifest.json").write_text(content)
    with pytest.raises(SceneError, match=r"manifest\.json"):
        SceneStore(store.folder)


def test_a_missing_shard_or_store_is_refused(store: SceneStore) -> None:
    (store.folder / "00001").rename(store.folder / "elsewhere")
    with pytest.raises(SceneError, match=r"00001.*missing"):
        SceneStore(store.folder)
    with pytest.raises(SceneError, match=r"nowhere.*missing"):
        SceneStore(store.folder / "nowhere")


def test_a_truncated_array_is_refused_before_it_is_read(store: SceneStore) -> None:
    path = store.folder / "00000/road/points.memmap"
    path.write_bytes(path.read_bytes()[:-4])
    reopened = SceneStore(store.folder)
    with pytest.raises(SceneError, match=r"points\.memmap: \d+ bytes where \d+ are needed"):
        reopened[0]
    path.unlink()
    with pytest.raises(SceneError, match=r"points\.memmap: the file is missing"):
        SceneStore(store.folder)[0]


@pytest.mark.parametrize("name", ["00000/road/points.memmap", "00001/agents/position.memmap"])
def test_verify_finds_one_changed_byte(store: SceneStore, name: str) -> None:
    store.verify()
    path = store.folder / name
    data = bytearray(path.read_bytes())
    data[5] ^= 1
    path.write_bytes(data)
    with pytest.raises(SceneError, match=f"{name}: the content does not fit its checksum"):
        SceneStore(store.folder).verify()


def test_verify_finds_a_changed_record(store: SceneStore) -> None:
    change_json(store.folder / "00001/shard.json", scene_ids=["other"])
    with pytest.raises(SceneError, match=r"shard\.json: changed since"):
        SceneStore(store.folder).verify()


if __name__ == "__main__":
    pytest.main([__file__])
