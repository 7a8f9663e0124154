"""TrafficEnv: the log replayed, scenes handed out in groups, and TorchRL's contract."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from envs import keys
from envs.episode import EpisodeOptions
from envs.geometry.frames import to_local
from envs.participants import choose_controlled, largest_scene
from envs.scene import CURRENT_STEP, AgentKind, MapKind, Scene
from envs.sources.synthetic import build_scene, straight_road, two_cars_head_on
from envs.traffic import TrafficEnv

EDGE = [(MapKind.EDGE_BOUNDARY, torch.tensor([[50.0, 5.0], [-50.0, 5.0]]))]


class FollowLog(TensorDictModuleBase):
    """Writes the action that reproduces the log."""

    def __init__(self, env: TrafficEnv) -> None:
        super().__init__()
        self.env, self.in_keys, self.out_keys = env, [keys.SCENE, keys.STEP, keys.RECENT], [keys.ACTION]

    def forward(self, state: TensorDictBase) -> TensorDictBase:
        return follow_log(self.env, state)


class Stand(TensorDictModuleBase):
    """Writes the action that goes nowhere."""

    in_keys, out_keys = [keys.RECENT], [keys.ACTION]

    def forward(self, state: TensorDictBase) -> TensorDictBase:
        return stand(state)


def follow_log(env: TrafficEnv, state: TensorDictBase) -> TensorDictBase:
    scenes = [env._padded(index) for index in state[keys.SCENE].tolist()]
    poses = torch.stack([scene.agents.poses for scene in scenes])
    first = CURRENT_STEP + 1 + state[keys.STEP] * env.episode.decision_steps
    index = first + torch.arange(env.episode.decision_steps)  # [B, F]
    target = poses[torch.arange(len(poses))[:, None], :, index].transpose(1, 2)
    return state.set(keys.ACTION, to_local(target, state[keys.RECENT][..., -1:, :]))


def stand(state: TensorDictBase) -> TensorDictBase:
    *agents, length, _ = state[keys.RECENT].shape
    return state.set(keys.ACTION, torch.zeros(*agents, length - 1, 3))


def steps(env: TrafficEnv, state: TensorDictBase, num: int, act: Callable = stand) -> TensorDictBase:
    """The state after some steps, nothing reset."""
    for _ in range(num):
        state = env.step(act(state))["next"].exclude("reward", ("agents", "reward"))
    return state


def observed(env: TrafficEnv, state: TensorDictBase) -> TensorDict:
    """What a policy sees of a state."""
    return state.select(*env.observation_spec.keys(True, True))


def reset_rows(env: TrafficEnv, state: TensorDictBase, rows: list[bool]) -> TensorDictBase:
    """Partial reset, as collectors do it."""
    asked = state.clone().set("_reset", torch.tensor(rows)[:, None])
    return env.reset(asked)


def wavy(num_agents: int, seed: int = 0) -> Scene:
    """Agents on smooth random tracks that turn."""
    generator = torch.Generator().manual_seed(seed)
    turn = torch.rand(num_agents, 1, generator=generator) - 0.5
    speed = 2 + 8 * torch.rand(num_agents, 1, generator=generator)
    heading = turn * torch.arange(91) * 0.1
    moves = 0.1 * speed[..., None] * torch.stack((heading.cos(), heading.sin()), -1)
    xy = moves.cumsum(1) + 40 * torch.randn(num_agents, 1, 2, generator=generator)
    return build_scene(torch.cat((xy, heading[..., None]), -1), EDGE, scene_id=f"wavy_{num_agents}_{seed}")


# --- the log --------------------------------------------------------------------------------------------------------
def test_an_episode_starts_with_the_last_half_second_of_the_log() -> None:
    scene = wavy(3)
    state = TrafficEnv([scene], num_rollouts=2).reset()
    torch.testing.assert_close(state[keys.RECENT][1], scene.agents.poses[:, CURRENT_STEP - 5 : CURRENT_STEP + 1])
    assert state[keys.VALID].all() and state[keys.CONTROLLED].all()
    assert (state[keys.KIND] == AgentKind.VEHICLE).all()
    assert state[keys.STEP].tolist() == [[0], [0]]


@pytest.mark.parametrize("decision_steps", [1, 5, 10])
def test_an_action_that_reproduces_the_log_costs_nothing(decision_steps: int) -> None:
    scenes = [wavy(3), wavy(2, seed=1)]
    env = TrafficEnv(scenes, EpisodeOptions(decision_steps=decision_steps, horizon=80 // decision_steps), num_scenes=2)
    rollout = env.rollout(80, FollowLog(env))
    poses = rollout["next", *keys.RECENT][..., 1:, :].movedim(1, 2).flatten(2, 3)
    for row, scene in enumerate(scenes):
        logged = scene.agents.poses[:, CURRENT_STEP + 1 :]
        moved = poses[row, : len(logged)]
        torch.testing.assert_close(moved[..., :2], logged[..., :2], atol=1e-3, rtol=0)
        torch.testing.assert_close(moved[..., 2].cos(), logged[..., 2].cos(), atol=1e-4, rtol=0)
    assert rollout["next", *keys.REWARD].abs().max() < 1e-3
    assert rollout["next", *keys.REWARD].shape == (2, 80 // decision_steps, 3, 1)
    assert rollout["next", "done"][:, -1].all() and not rollout["next", "done"][:, :-1].any()
    assert torch.equal(rollout["next", "truncated"], rollout["next", "done"])
    assert not rollout["next", "terminated"].any()


def test_the_reward_is_minus_the_mean_distance_from_the_log() -> None:
    env = TrafficEnv([straight_road(1, speed=10.0)])
    state = env.step(stand(env.reset()))["next"]
    # The log moves 1 m a step and the agent stands: it is 1, 2, 3, 4 and 5 m away.
    torch.testing.assert_close(state[keys.REWARD], torch.full((1, 1, 1), -3.0))
    state = env.step(stand(state.exclude("reward")))["next"]
    torch.testing.assert_close(state[keys.REWARD], torch.full((1, 1, 1), -8.0))


def test_steps_that_the_log_misses_do_not_count_in_the_reward() -> None:
    valid = torch.ones(1, 91, dtype=torch.bool)
    valid[0, [11, 15]] = False
    valid[0, 16:] = False
    scene = build_scene(straight_road(1, speed=10.0).agents.poses, EDGE, valid=valid)
    env = TrafficEnv([scene])
    state = env.step(stand(env.reset()))["next"]
    torch.testing.assert_close(state[keys.REWARD], torch.full((1, 1, 1), -3.0))  # 2, 3 and 4 m
    assert state[keys.VALID].all(), "a controlled agent stays to the end"
    state = env.step(stand(state.exclude("reward")))["next"]
    assert state[keys.REWARD].item() == 0


def test_actions_are_in_the_agents_own_frames() -> None:
    env = TrafficEnv([two_cars_head_on()])
    state = env.reset()
    ahead = torch.zeros(1, 2, 5, 3)
    ahead[..., 0] = torch.arange(1, 6)
    after = env.step(state.clone().set(keys.ACTION, ahead))["next"]
    moved = (after[keys.RECENT][0, :, -1] - state[keys.RECENT][0, :, -1])[:, :2]
    torch.testing.assert_close(moved, torch.tensor([[5.0, 0.0], [-5.0, 0.0]]), atol=1e-4, rtol=0)


# --- who is controlled ----------------------------------------------------------------------------------------------
def crowd() -> Scene:
    """Six agents: the SDC in the middle, agent 5 far away and to be predicted, agent 2 leaves the log."""
    poses = torch.zeros(6, 91, 3)
    poses[:, :, 0] = torch.tensor([50.0, 0.0, 10.0, 30.0, 20.0, 90.0])[:, None] + torch.arange(91) * 0.1
    valid = torch.ones(6, 91, dtype=torch.bool)
    valid[3, 30:] = False
    scene = build_scene(poses, EDGE, valid=valid)
    scene.agents.sdc[:] = torch.tensor([False, True, False, False, False, False])
    scene.agents.predict[:] = torch.tensor([False, False, False, False, False, True])
    return scene


@pytest.mark.parametrize(
    ("limit", "expected"), [(1, [1]), (2, [1, 5]), (3, [1, 2, 5]), (4, [1, 2, 4, 5]), (6, [0, 1, 2, 3, 4, 5])]
)
def test_evaluated_agents_are_controlled_first_and_then_the_nearest_to_the_sdc(limit: int, expected: list[int]) -> None:
    chosen = choose_controlled(crowd(), limit)
    assert chosen.nonzero()[:, 0].tolist() == expected
    assert (
        TrafficEnv([crowd()], EpisodeOptions(max_controlled=limit)).reset()[keys.CONTROLLED][0].tolist()
        == chosen.tolist()
    )


def test_agents_that_are_not_there_are_never_controlled() -> None:
    scene = crowd()
    scene.agents.valid[2, CURRENT_STEP] = False
    assert choose_controlled(scene, 3).nonzero()[:, 0].tolist() == [1, 4, 5]
    assert TrafficEnv([scene]).num_agents == 5


def test_the_rest_follow_the_log_and_leave_with_it() -> None:
    scene = crowd()
    env = TrafficEnv([scene], EpisodeOptions(max_controlled=2))
    rollout = env.rollout(16, Stand())
    replayed = [0, 2, 3, 4]
    poses = rollout["next", *keys.RECENT][0, :, :, 1:].movedim(0, 1).flatten(1, 2)
    expected = scene.agents.poses[:, CURRENT_STEP + 1 :].clone()
    expected[3, 30 - CURRENT_STEP - 1 :] = scene.agents.poses[3, 29]  # it stays where it left, and is not at the origin
    assert torch.equal(poses[replayed], expected[replayed])
    ends = scene.agents.valid[:, CURRENT_STEP + 5 :: 5].clone()
    assert ends.shape[1] == 16 and not ends[3, 4:].any(), "agent 3 leaves the log after 2 s"
    ends[[1, 5]] = True
    assert torch.equal(rollout["next", *keys.VALID][0], ends.T)
    assert (rollout["next", *keys.REWARD][0, :, replayed] == 0).all()


def test_an_agent_in_a_hole_of_its_log_moves_on_and_is_not_there() -> None:
    scene = crowd()
    hole = slice(20, 31)
    scene.agents.position[3, :, 0] = 30.0 + 0.1 * torch.arange(91)
    scene.agents.valid[3] = True
    scene.agents.position[3, hole], scene.agents.valid[3, hole] = 0.0, False
    scene.agents.velocity[3] = torch.tensor([1.0, 0.0])
    rollout = TrafficEnv([scene], EpisodeOptions(max_controlled=2)).rollout(16, Stand())
    x = rollout["next", *keys.RECENT][0, :, 3, 1:, 0].flatten()
    torch.testing.assert_close(x, 30.0 + 0.1 * torch.arange(CURRENT_STEP + 1, 91), atol=1e-4, rtol=0)
    assert rollout["next", *keys.VALID][0, :, 3].tolist() == [True, False, False, False, *[True] * 12]


def test_what_lies_where_the_log_has_nothing_does_not_move_anybody() -> None:
    scene, other = crowd(), crowd()
    other.agents.position[3, 30:] = torch.tensor([-500.0, 0.0, 0.0])
    poses, moved = (
        TrafficEnv([each], EpisodeOptions(max_controlled=2)).rollout(16, Stand())["next", *keys.RECENT]
        for each in (scene, other)
    )
    assert torch.equal(poses, moved)


def test_more_agents_than_the_limit_of_the_challenge() -> None:
    env = TrafficEnv([wavy(140)], num_rollouts=2)
    state = env.reset()
    assert state[keys.CONTROLLED].shape == (2, 140)
    assert state[keys.CONTROLLED].sum(1).tolist() == [128, 128]
    rollout = env.rollout(2, FollowLog(env))
    torch.testing.assert_close(rollout["next", *keys.REWARD], torch.zeros(2, 2, 140, 1), atol=1e-3, rtol=0)


# --- seeds and resets -----------------------------------------------------------------------------------------------
def test_seeding_anew_starts_over() -> None:
    env = TrafficEnv([straight_road(2, seed=seed) for seed in range(5)], num_scenes=2)
    assert [env.reset()[keys.SCENE].tolist() for _ in range(3)] == [[0, 1], [2, 3], [4, 0]]
    env.set_seed(0)
    assert env.reset()[keys.SCENE].tolist() == [0, 1]


def test_the_rollouts_of_a_scene_are_contiguous() -> None:
    env = TrafficEnv([straight_road(2), straight_road(3)], num_scenes=2, num_rollouts=3)
    assert env.reset()[keys.SCENE].tolist() == [0, 0, 0, 1, 1, 1]


def test_a_group_that_is_reset_as_a_whole_moves_on_and_leaves_the_others_alone() -> None:
    scenes = [wavy(2), wavy(3, seed=1), wavy(1, seed=2)]
    env = TrafficEnv(scenes, num_scenes=2, num_rollouts=2)
    state = steps(env, env.reset(), 3)
    after = reset_rows(env, state, [True, True, False, False])
    assert after[keys.SCENE].tolist() == [2, 2, 1, 1]
    assert after[keys.STEP][:, 0].tolist() == [0, 0, 3, 3]
    assert torch.equal(after[keys.RECENT][0, :1], scenes[2].agents.recent(5))
    assert after[keys.VALID][0].tolist() == [True, False, False]
    assert (observed(env, after)[2:] == observed(env, state)[2:]).all()
    ahead = steps(env, after.exclude("_reset"), 1, lambda s: follow_log(env, s))
    torch.testing.assert_close(ahead[keys.RECENT][0, 0, -1], scenes[2].agents.poses[0, CURRENT_STEP + 5])


def test_rows_end_when_their_own_horizon_is_reached() -> None:
    env = TrafficEnv([wavy(2)], EpisodeOptions(horizon=4), num_rollouts=2)
    state = reset_rows(env, steps(env, env.reset(), 2), [False, True])
    step = env.step(stand(state.exclude("_reset")))
    assert step["next", "done"][:, 0].tolist() == [False, False]
    step = env.step(stand(step["next"].exclude("reward")))
    assert step["next", "done"][:, 0].tolist() == [True, False]


def test_an_endless_rollout_goes_through_all_scenes() -> None:
    env = TrafficEnv([straight_road(n) for n in (1, 2, 3)], EpisodeOptions(horizon=2), num_rollouts=2)
    seen = env.rollout(6, break_when_any_done=False)[keys.SCENE]
    assert seen.tolist() == [[0, 0, 1, 1, 2, 2]] * 2


# --- sizes and errors -----------------------------------------------------------------------------------------------
def test_padding_agents_are_invalid_and_cost_nothing() -> None:
    env = TrafficEnv([straight_road(2)], num_agents=5)
    rollout = env.rollout(16)
    padding: Tensor = rollout["next", *keys.VALID][..., 2:]
    assert not padding.any() and not rollout[keys.CONTROLLED][..., 2:].any()
    assert (rollout["next", *keys.REWARD][..., 2:, :] == 0).all()


def test_a_source_that_knows_its_sizes_is_not_read_for_them() -> None:
    class Counted(list):
        num_agents = (7, 9)

        def __getitem__(self, index: int) -> Scene:
            raise AssertionError("read")

    assert largest_scene(Counted([1, 2])) == 9


def test_an_environment_without_a_scene_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one scene"):
        TrafficEnv([])


if __name__ == "__main__":
    pytest.main([__file__])
