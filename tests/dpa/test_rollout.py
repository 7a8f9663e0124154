"""Rollouts in groups: whole episodes of every scene once, whatever they are grouped with or resumed after."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from dpa.policy import ContextOptions, MotionLM, MotionLMConfig
from dpa.rollout import (
    Decoding,
    Subset,
    collect_groups,
    groups_by_size,
    lifted,
    make_collector,
    simulated_poses,
)
from dpa.tokens import VerletTokenizer
from envs import keys
from envs.scene import CURRENT_STEP, Scene
from envs.sources.synthetic import straight_road

TINY = MotionLMConfig(width=16, heads=2, feed=16, encoder_layers=1, decoder_layers=1)
SIZES = (2, 1, 3, 2)


@pytest.fixture
def model() -> MotionLM:
    torch.manual_seed(0)
    return MotionLM(TINY, VerletTokenizer())


@pytest.fixture
def scenes() -> list[Scene]:
    """Four roads of different sizes."""
    return [straight_road(size, seed=index) for index, size in enumerate(SIZES)]


def tokens_of(batches: list[TensorDictBase], num_rollouts: int) -> dict[int, TensorDict]:
    """Tokens of every scene: index -> ``[K, T, A]`` without padding."""
    found = {}
    for batch in batches:
        for row, scene in enumerate(batch[keys.SCENE][::num_rollouts, 0].tolist()):
            assert scene not in found
            group = batch[row * num_rollouts : (row + 1) * num_rollouts]
            assert (group[keys.SCENE] == scene).all()
            found[scene] = group[keys.TOKEN][..., : SIZES[scene]]
    return found


def test_a_collector_takes_the_scenes_in_turn_and_gives_whole_episodes(model: MotionLM, scenes: list[Scene]) -> None:
    collector = make_collector(scenes, model, num_rollouts=3, num_scenes=2)
    batches = list(collector)
    collector.shutdown()
    assert [batch[keys.SCENE][::3, 0].tolist() for batch in batches] == [[0, 1], [2, 3]]
    for batch in batches:
        assert batch.batch_size == (6, 16)
        assert (batch[keys.STEP][..., 0] == torch.arange(16)).all()
        assert batch["next", "done"][:, -1].all() and not batch["next", "done"][:, :-1].any()
        assert (batch[keys.SCENE] == batch[keys.SCENE][:, :1]).all()


def test_a_last_batch_that_is_not_full_goes_on_with_the_first_scenes(model: MotionLM, scenes: list[Scene]) -> None:
    collector = make_collector(scenes[:3], model, num_rollouts=1, num_scenes=2)
    assert [batch[keys.SCENE][:, 0].tolist() for batch in collector] == [[0, 1], [2, 0]]
    collector.shutdown()


def test_options_reach_environment_and_policy(model: MotionLM, scenes: list[Scene]) -> None:
    options = ContextOptions(max_controlled=1, horizon=4)
    (batch,) = collect_groups(scenes, model, [2], num_rollouts=2, options=options)
    assert batch.batch_size == (2, 4)
    assert (batch[keys.CONTROLLED].sum(-1) == 1).all()


def test_every_scene_is_rolled_out_once_in_groups_of_similar_size(scenes: list[Scene]) -> None:
    assert groups_by_size(scenes, range(4), max_rows=8, num_rollouts=2) == [[1, 0], [3], [2]]
    assert groups_by_size(scenes, range(4), max_rows=1, num_rollouts=2) == [[1], [0], [3], [2]]
    assert groups_by_size(scenes, [3, 2], max_rows=1000, num_rollouts=2) == [[3, 2]]
    assert groups_by_size(scenes, [], max_rows=1000, num_rollouts=2) == []


@pytest.mark.parametrize("max_rows", [4, 8, 1000])
def test_indices_are_those_of_the_whole_source(model: MotionLM, scenes: list[Scene], max_rows: int) -> None:
    batches = collect_groups(scenes, model, [0, 2, 3], num_rollouts=2, max_rows=max_rows)
    assert sorted(tokens_of(list(batches), 2)) == [0, 2, 3]


def test_rollouts_depend_on_the_seed_and_on_nothing_else(model: MotionLM, scenes: list[Scene]) -> None:
    def collect(seed: int) -> dict[int, TensorDict]:
        return tokens_of(list(collect_groups(scenes, model, range(4), num_rollouts=2, seed=seed, max_rows=8)), 2)

    first = collect(0)
    torch.manual_seed(99)
    again, other = collect(0), collect(1)
    assert all(torch.equal(first[scene], again[scene]) for scene in range(4))
    assert not all(torch.equal(first[scene], other[scene]) for scene in range(4))


@pytest.mark.parametrize("done", [[1], [0, 1], [0, 1, 2], [2]])
def test_what_is_left_of_an_interrupted_collection_comes_out_as_it_would_have(
    model: MotionLM, scenes: list[Scene], done: list[int]
) -> None:
    """Even where the interruption cut a group in two."""
    options = {"num_rollouts": 2, "max_rows": 8}
    whole = tokens_of(list(collect_groups(scenes, model, range(4), **options)), 2)
    rest = tokens_of(list(collect_groups(scenes, model, range(4), done=done, **options)), 2)
    assert set(rest) >= set(range(4)) - set(done)
    assert all(torch.equal(rest[scene], whole[scene]) for scene in rest)


def test_groups_that_are_done_cost_nothing(model: MotionLM, scenes: list[Scene]) -> None:
    assert list(collect_groups(scenes, model, range(4), num_rollouts=2, done=range(4))) == []


def test_the_post_processing_sees_the_scenes_of_its_group(model: MotionLM, scenes: list[Scene]) -> None:
    seen = []

    def make_postproc(part: Subset) -> Callable[[TensorDictBase], TensorDictBase]:
        def process(batch: TensorDictBase) -> TensorDictBase:
            seen.append([part[index].scene_id for index in batch[keys.SCENE][:, 0].tolist()])
            return batch

        return process

    list(collect_groups(scenes, model, range(4), num_rollouts=1, max_rows=4, make_postproc=make_postproc))
    # A collector may also show its post-processing a batch of zeros first, to learn what it makes of it.
    assert [ids for ids in seen if len(set(ids)) == len(ids)][-3:] == [
        [scenes[1].scene_id, scenes[0].scene_id],
        [scenes[3].scene_id],
        [scenes[2].scene_id],
    ]


def test_decoding_is_that_of_the_actor(model: MotionLM, scenes: list[Scene]) -> None:
    greedy = Decoding(top_p=1e-6)
    (batch,) = collect_groups(scenes, model, [0], num_rollouts=3, decoding=greedy)
    assert torch.equal(batch[keys.TOKEN][0], batch[keys.TOKEN][1])


# --- poses ----------------------------------------------------------------------------------------------------------
def test_simulated_poses_are_what_the_tokens_decode_to(model: MotionLM, scenes: list[Scene]) -> None:
    (batch,) = collect_groups(scenes, model, [0, 3], num_rollouts=2)
    poses = simulated_poses(batch, 2)
    assert poses.shape == (2, 2, 2, 80, 3)
    for row, index in enumerate((0, 3)):
        agents = scenes[index].agents
        for rollout in range(2):
            tokens = batch[keys.TOKEN][2 * row + rollout].T
            expected = model.tokenizer.decode_tracks(tokens, agents.recent(5), agents.kind)
            torch.testing.assert_close(poses[row, rollout], expected)


def test_lifted_rollouts_drop_padding_and_have_the_height_of_the_road() -> None:
    scene = straight_road(2).clone()
    scene.road.points[:, 2] = 7.0
    scene.agents.position[..., 2] = 8.0
    poses = scene.agents.poses[:, CURRENT_STEP + 1 :].expand(3, -1, -1, -1)
    trajectories = lifted(scene, torch.nn.functional.pad(poses, (0, 0, 0, 0, 0, 2)))
    assert trajectories.shape == (3, 2, 80, 4)
    torch.testing.assert_close(trajectories[..., [0, 1, 3]], poses)
    torch.testing.assert_close(trajectories[..., 2], torch.full((3, 2, 80), 8.0), atol=0.1, rtol=0)


def test_a_subset_is_a_source(scenes: list[Scene]) -> None:
    part = Subset(scenes, [2, 0])
    assert len(part) == 2
    assert [part[i].scene_id for i in range(2)] == [scenes[2].scene_id, scenes[0].scene_id]


if __name__ == "__main__":
    pytest.main([__file__])
