"""SceneLoader: what a batch holds follows from the seed, the epoch and its place, and from nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.loader import SceneLoader, epoch_order
from envs.mirror import mirror
from envs.scene import Scene, SceneError
from envs.sources.synthetic import straight_road
from envs.store import SceneStore


def changed(scene: Scene, generator: torch.Generator) -> Scene:
    """Mirrored or not, and moved by what was drawn for it."""
    flip, far = torch.rand(2, generator=generator).tolist()
    scene = mirror(scene) if flip < 0.5 else scene.clone()
    scene.agents.position[..., 0] += far
    return scene


def make_scenes(count: int) -> list[Scene]:
    """Scenes of different sizes."""
    scenes = []
    for number in range(count):
        scene = straight_road(2 + number % 3, seed=number)
        scene.scene_id = f"scene_{number}"
        scenes.append(scene)
    return scenes


class Blocks(list):
    """Scenes that lie in blocks, as those of a store do."""

    def __init__(self, scenes: Sequence[Scene], blocks: Sequence[int]) -> None:
        super().__init__(scenes)
        self.blocks = blocks


SCENES = make_scenes(23)
IN_BLOCKS = Blocks(SCENES, [5, 0, 4, 6, 1, 7])


def ids(batches: Any) -> list[list[str]]:
    return [batch.scene_id for batch in batches]


def flat(parts: Iterable[list[Any]]) -> list[Any]:
    return list(chain.from_iterable(parts))


def content(batch: Scene) -> list[Any]:
    agents = batch.agents
    return [batch.scene_id, agents.position.tolist(), agents.heading.tolist(), agents.track_id.tolist()]


def contents(batches: Any) -> list[list[Any]]:
    return [content(batch) for batch in batches]


# --- the order of an epoch ------------------------------------------------------------------------------------------


@settings(deadline=None)
@given(
    blocks=st.lists(st.integers(0, 9), min_size=1, max_size=8),
    window=st.integers(1, 10),
    seed=st.integers(0, 2**40),
    epoch=st.integers(0, 100),
)
def test_an_epoch_shows_every_scene_once_window_by_window(
    blocks: list[int], window: int, seed: int, epoch: int
) -> None:
    order = epoch_order(blocks, window, seed, epoch)
    assert order.sort().values.tolist() == list(range(sum(blocks)))
    assert torch.equal(order, epoch_order(blocks, window, seed, epoch))
    # Blocks come window by window: from the first scene of a block to its last one, no more than a window of blocks is
    # open at any time.
    owner = torch.arange(len(blocks)).repeat_interleave(torch.tensor(blocks))[order].tolist()
    for block in set(owner):
        last = len(owner) - 1 - owner[::-1].index(block)
        assert len(set(owner[owner.index(block) : last + 1])) <= window


def test_blocks_and_scenes_are_shuffled_anew_every_epoch_and_for_every_seed() -> None:
    def block_order(order: torch.Tensor) -> list[int]:
        return list(dict.fromkeys((order // 50).tolist()))

    orders = [epoch_order([50] * 6, 1, seed, epoch) for seed in range(2) for epoch in range(2)]
    assert len({tuple(order.tolist()) for order in orders}) == 4
    assert len({tuple(block_order(order)) for order in orders}) == 4


def test_the_blocks_of_a_window_are_mixed() -> None:
    blocks = (epoch_order([50] * 6, 2, seed=0, epoch=0) // 50)[:100]
    assert len(blocks.unique()) == 2
    assert 20 < int((blocks.diff() != 0).sum()) < 80  # half of the neighbours come from different blocks


def test_one_block_is_a_plain_permutation_with_every_place_equally_likely() -> None:
    places = torch.stack([epoch_order([4], 1, 0, epoch) for epoch in range(600)])
    counts = torch.stack([(places == scene).sum(0) for scene in range(4)])
    assert counts.min() > 110 and counts.max() < 190  # 150 expected, 11 standard deviation


def test_an_epoch_of_the_loader_is_its_order_cut_in_batches() -> None:
    loader = SceneLoader(IN_BLOCKS, 5, seed=7, block_window=2)
    order = [f"scene_{index}" for index in epoch_order(IN_BLOCKS.blocks, 2, seed=7, epoch=0).tolist()]
    batches = list(loader)
    assert len(batches) == len(loader) == 4
    assert flat(ids(batches)) == order[:20]
    assert batches[0].batch_size == (5,) and batches[0].agents.valid.shape[0] == 5


def test_loops_are_epochs() -> None:
    loader, other = SceneLoader(SCENES, 8), SceneLoader(SCENES, 8)
    assert loader.epoch == 0
    epochs = [ids(loader), ids(loader), ids(loader)]
    assert loader.epoch == 3
    assert epochs[0] != epochs[1] != epochs[2]
    assert ids(islice(other.endless(), 6)) == flat(epochs)


def test_the_last_batch_is_dropped_or_filled_up_from_the_start_of_the_epoch() -> None:
    assert len(ids(SceneLoader(SCENES, 10))) == 2
    filled = SceneLoader(SCENES, 10, drop_last=False)
    assert len(filled) == 3
    first, second, third = ids(filled)
    assert third[3:] == first[:7]
    assert sorted(first + second + third[:3]) == sorted(scene.scene_id for scene in SCENES)
    assert filled.epoch == 1
    (batch,) = SceneLoader(SCENES[:2], 5, drop_last=False)
    assert batch.scene_id == (batch.scene_id[:2] * 3)[:5]


# --- ranks ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drop_last", [True, False])
@pytest.mark.parametrize("world_size", [2, 3, 6])
def test_a_global_batch_has_the_same_scenes_on_any_number_of_ranks(world_size: int, drop_last: bool) -> None:
    alone = SceneLoader(IN_BLOCKS, 6, prepare=changed, drop_last=drop_last)
    ranks = [
        SceneLoader(IN_BLOCKS, 6 // world_size, prepare=changed, rank=rank, world_size=world_size, drop_last=drop_last)
        for rank in range(world_size)
    ]
    assert {len(rank) for rank in ranks} == {len(alone)}
    expected = [scene for batch in alone for scene in one_by_one(batch)]
    shared = [scene for parts in zip(*ranks, strict=True) for part in parts for scene in one_by_one(part)]
    assert shared == expected
    assert all(rank.state_dict() == alone.state_dict() for rank in ranks)


def one_by_one(batch: Scene) -> list[tuple]:
    """Id and states of the agents of each scene, without the padding."""
    agents = batch.agents
    real = agents.track_id >= 0
    return [
        (scene_id, agents.track_id[row, real[row]].tolist(), agents.poses[row, real[row]].tolist())
        for row, scene_id in enumerate(batch.scene_id)
    ]


# --- prepared scenes ------------------------------------------------------------------------------------------------


def test_what_is_drawn_depends_on_scene_and_epoch_and_not_on_the_batch() -> None:
    def shown(batch_size: int, window: int) -> list[dict[str, tuple]]:
        loader = SceneLoader(IN_BLOCKS, batch_size, prepare=changed, block_window=window, drop_last=False)
        return [{s[0]: s for batch in loader for s in one_by_one(batch)} for _ in range(2)]

    first, second = shown(4, 2), shown(9, 6)
    assert first == second
    assert all(first[0][name] != first[1][name] for name in first[0])
    plain = {s[0]: s for batch in SceneLoader(IN_BLOCKS, 23) for s in one_by_one(batch)}
    assert all(first[0][name] != plain[name] for name in plain)


def test_by_default_scenes_come_as_they_are_and_the_source_stays() -> None:
    before = [scene.clone() for scene in SCENES]
    list(SceneLoader(SCENES, 23, prepare=changed))
    (batch,) = SceneLoader(SCENES, 23)
    for row, name in enumerate(batch.scene_id):
        scene = before[int(name.removeprefix("scene_"))]
        num_agents = len(scene.agents.sdc)
        assert torch.equal(batch.agents.position[row, :num_agents], scene.agents.position)
        assert not batch.agents.valid[row, num_agents:].any()


def test_the_global_generator_is_left_alone() -> None:
    before = torch.get_rng_state()
    list(SceneLoader(SCENES, 4, prepare=changed))
    assert torch.equal(torch.get_rng_state(), before)


# --- resume ---------------------------------------------------------------------------------------------------------


def make_loader(**options: Any) -> SceneLoader:
    return SceneLoader(IN_BLOCKS, **{"batch_size": 4, "seed": 3, "prepare": changed, **options})


@pytest.mark.parametrize("drop_last", [True, False])
@pytest.mark.parametrize("handed_out", [0, 1, 3, 4, 5, 6, 8, 12])
def test_a_resumed_loader_goes_on_exactly(handed_out: int, drop_last: bool) -> None:
    loader = make_loader(drop_last=drop_last)
    batches = loader.endless()
    for _ in range(handed_out):
        next(batches)
    state = json.loads(json.dumps(loader.state_dict()))
    resumed = make_loader(drop_last=drop_last)
    resumed.load_state_dict(state)
    assert resumed.epoch == loader.epoch == handed_out // len(loader)
    assert contents(islice(resumed.endless(), 8)) == contents(islice(batches, 8))


def test_a_run_resumes_on_another_number_of_ranks() -> None:
    one = make_loader(batch_size=6)
    next(iter(one))
    ranks = [make_loader(batch_size=2, rank=rank, world_size=3) for rank in range(3)]
    for rank in ranks:
        rank.load_state_dict(one.state_dict())
    rest = zip(*(ids(rank) for rank in ranks), strict=True)
    assert [flat(parts) for parts in rest] == ids(one)


def test_a_larger_batch_after_resuming_goes_on_in_the_order_or_with_the_next_epoch() -> None:
    loader = make_loader(batch_size=5)
    list(islice(loader, 2))
    larger = make_loader(batch_size=6)
    larger.load_state_dict(loader.state_dict())
    order = [f"scene_{index}" for index in epoch_order(IN_BLOCKS.blocks, 4, seed=3, epoch=0).tolist()]
    assert ids(larger) == [order[10:16], order[16:22]]
    largest = make_loader(batch_size=14)
    largest.load_state_dict(loader.state_dict())
    assert largest.epoch == 1 and len(ids(largest)) == 1


def test_a_loop_that_was_left_goes_on_where_it_stopped() -> None:
    loader, whole = make_loader(), ids(make_loader())
    for _ in loader:
        break
    assert ids(loader) == whole[1:]
    assert ids(loader) != whole


def test_a_newer_loop_ends_an_older_one() -> None:
    loader, whole = make_loader(), ids(make_loader())
    older = iter(loader)
    next(older)
    assert next(iter(loader)).scene_id == whole[1]
    with pytest.raises(RuntimeError, match="newer one began"):
        next(older)
    assert ids(loader) == whole[2:]


def test_loading_a_state_ends_a_loop() -> None:
    loader, whole = make_loader(), ids(make_loader())
    begin = loader.state_dict()
    older = iter(loader)
    next(older)
    loader.load_state_dict(begin)
    with pytest.raises(RuntimeError, match="a state was loaded"):
        next(older)
    assert ids(loader) == whole


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda: make_loader(seed=4), "seed = 3 and the loader 4"),
        (lambda: make_loader(block_window=1), "block_window = 4 and the loader 1"),
        (lambda: SceneLoader(SCENES[:9], 4, seed=3), "num_scenes = 23 and the loader 9"),
        (lambda: SceneLoader(SCENES, 4, seed=3), "digest = '[0-9a-f]{32}' and the loader '[0-9a-f]{32}'"),
        (lambda: SceneLoader(Blocks(SCENES[::-1], IN_BLOCKS.blocks), 4, seed=3), "digest = "),
    ],
)
def test_a_state_of_another_order_is_refused(other: Callable[[], SceneLoader], message: str) -> None:
    loader = make_loader()
    next(iter(loader))
    resumed = other()
    before = resumed.state_dict()
    with pytest.raises(ValueError, match=message):
        resumed.load_state_dict(loader.state_dict())
    assert resumed.state_dict() == before


# --- what is refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"batch_size": 0}, "batch_size must be positive, got 0"),
        ({"world_size": -1}, "world_size must be positive, got -1"),
        ({"block_window": 0}, "block_window must be positive, got 0"),
        ({"rank": 2, "world_size": 2}, "got 2 of 2"),
        ({"rank": -1}, "got -1 of 1"),
        ({"batch_size": 12, "world_size": 2}, "23 scenes do not fill a global batch of 24"),
    ],
)
def test_numbers_out_of_range_are_refused(options: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SceneLoader(SCENES, **{"batch_size": 2, **options})


def test_no_scene_and_blocks_that_do_not_add_up_are_refused() -> None:
    with pytest.raises(ValueError, match="0 scenes do not fill"):
        SceneLoader([], 1, drop_last=False)
    with pytest.raises(ValueError, match="add up to 22, but there are 23 scenes"):
        SceneLoader(Blocks(SCENES, [20, 2]), 1)


# --- workers --------------------------------------------------------------------------------------------------------


@pytest.fixture
def store(write_store: Callable[[Path, list[Scene]], Path], tmp_path: Path) -> SceneStore:
    return SceneStore(write_store(tmp_path / "store", SCENES))


def test_workers_change_nothing_and_the_state_counts_what_was_handed_out(store: SceneStore) -> None:
    here = SceneLoader(store, 4, prepare=changed)
    expected = contents(islice(here.endless(), 10))
    loader = SceneLoader(store, 4, prepare=changed, workers=1)
    before = torch.get_rng_state()
    got = contents(islice(loader, 2))  # left while the worker has loaded ahead
    resumed = SceneLoader(store, 4, prepare=changed)
    resumed.load_state_dict(loader.state_dict())
    assert contents(resumed) == expected[2:5]
    older = iter(loader)
    got.append(content(next(older)))
    got += contents(loader)
    with pytest.raises(RuntimeError, match="newer one began"):
        next(older)
    assert got + contents(loader) == expected
    loader.load_state_dict(resumed.state_dict())
    assert contents(loader) == expected[5:]
    assert torch.equal(torch.get_rng_state(), before)


def test_an_error_in_a_worker_arrives_as_what_it_is(store: SceneStore) -> None:
    path = store.folders[0] / "00000.scenes"
    data = bytearray(path.read_bytes())
    for byte in range(10, 18):  # in the first scene
        data[byte] ^= 255
    path.write_bytes(data)
    with pytest.raises(SceneError, match=r"00000\.scenes, scene 0 \(scene_0\)"):
        list(SceneLoader(store, 4, workers=1))


if __name__ == "__main__":
    pytest.main([__file__])
