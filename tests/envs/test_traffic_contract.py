"""TrafficEnv keeps TorchRL's contract whatever its options: specs, seeds, resets, devices, wrappers, transforms."""

from __future__ import annotations

from dataclasses import fields
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import (
    Compose,
    EnvBase,
    InitTracker,
    ParallelEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from dpa.tokens import TokenAction, VerletTokenizer
from envs import keys
from envs.episode import EpisodeOptions
from envs.rewards import SignalReward
from envs.scene import Scene
from envs.sources.synthetic import red_light, straight_road, two_cars_head_on
from envs.traffic import TrafficEnv


def not_the_first(scene: Scene) -> torch.Tensor:
    """A control that is a function at the top of a module, so that it can be sent to another process."""
    return scene.agents.track_id != 1


SIGNALS = ("collision", "offroad", "progress", "red_light")
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "SDC only": {"control": "sdc"},
    "predicted": {"control": "predict"},
    "a mask": {"control": not_the_first, "signals": ("collision",)},
    "two controlled": {"max_controlled": 2},
    "arrivals": {"arrivals": True},
    "signals": {"signals": SIGNALS},
    "everything": {"control": "sdc", "arrivals": True, "signals": SIGNALS, "decision_steps": 3, "order": "random"},
    "wide": {"num_agents": 7, "signals": ("progress", "offroad")},
}
options = pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)


def scenes() -> list[Scene]:
    """Of different size, one with an agent that arrives and one that leaves."""
    late = straight_road(4, seed=1)
    late.agents.valid[2, :17] = False
    late.agents.valid[3, 25:] = False
    late.agents.predict[1] = False
    return [late, two_cars_head_on(), red_light(), straight_road(3, seed=2)]


def make(horizon: int = 4, num_rollouts: int = 2, **options: Any) -> TrafficEnv:
    episode, rest = told_apart({"horizon": horizon, **options})
    return TrafficEnv(scenes(), EpisodeOptions(**episode), num_scenes=2, num_rollouts=num_rollouts, **rest)


def told_apart(options: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Options of the episode, and the others."""
    names = {field.name for field in fields(EpisodeOptions)}
    episode = {name: value for name, value in options.items() if name in names}
    return episode, {name: value for name, value in options.items() if name not in names}


def gentle(env: EnvBase, state: TensorDictBase, seed: int) -> TensorDictBase:
    """The state with a small random motion of every agent."""
    shape = env.full_action_spec[keys.ACTION].shape
    action = 0.3 * torch.randn(shape, generator=torch.Generator().manual_seed(seed))
    action[..., 0] += 0.8 * torch.arange(1, shape[-2] + 1)
    return state.set(keys.ACTION, action.to(state.device))


def play(env: EnvBase, num: int, seed: int = 0) -> TensorDict:
    """``[B, num]`` steps, done rows reset, the actions of a generator of its own."""
    state, steps = env.reset(), []
    for step in range(num):
        step, state = env.step_and_maybe_reset(gentle(env, state, 1000 * seed + step))
        steps.append(step)
    return torch.stack(steps, 1)


def observed(env: EnvBase, state: TensorDictBase) -> TensorDictBase:
    """What a policy sees of a state."""
    return state.select(*env.observation_spec.keys(True, True))


def equal(first: TensorDictBase, second: TensorDictBase) -> bool:
    return set(first.keys(True, True)) == set(second.keys(True, True)) and bool((first == second).all())


# --- specs ----------------------------------------------------------------------------------------------------------
@options
def test_the_specs_say_what_the_environment_does(options: dict[str, Any]) -> None:
    check_env_specs(make(**options), break_when_any_done="both")


@options
def test_a_rollout_goes_on_or_stops_at_the_end_of_an_episode(options: dict[str, Any]) -> None:
    env = make(**options)
    assert env.rollout(10, break_when_any_done=True).shape == (4, 4)
    rollout = env.rollout(10, break_when_any_done=False)
    assert rollout.shape == (4, 10)
    assert rollout["next", keys.DONE][..., 0].tolist() == [[False, False, False, True] * 2 + [False] * 2] * 4
    assert rollout[keys.STEP][0, :, 0].tolist() == [0, 1, 2, 3] * 2 + [0, 1]


@options
def test_no_controlled_agent_is_absent_and_no_absent_agent_is_controlled(options: dict[str, Any]) -> None:
    rollout = make(**options).rollout(12, break_when_any_done=False)
    for state in (rollout, rollout["next"]):
        assert not (state[keys.CONTROLLED] & ~state[keys.VALID]).any()
    assert (rollout[keys.CONTROLLED].sum(-1) <= options.get("max_controlled", 128)).all()


# --- seeds and resets -----------------------------------------------------------------------------------------------
@options
def test_one_seed_gives_one_rollout(options: dict[str, Any]) -> None:
    first, second = make(**options), make(**options)
    for env in (first, second):
        env.set_seed(7)
    rollout = play(first, 9)
    assert equal(rollout, play(second, 9))
    first.set_seed(7)
    assert equal(rollout, play(first, 9)), "seeding anew starts over"


def test_seeds_draw_the_order_of_scenes() -> None:
    orders = set()
    for seed in range(8):
        env = make(order="random", horizon=1)
        env.set_seed(seed)
        orders.add(tuple(play(env, 6)[keys.SCENE].flatten().tolist()))
    assert len(orders) > 4


@options
def test_a_row_that_is_reset_alone_starts_again_and_the_others_go_on(options: dict[str, Any]) -> None:
    alone, env = make(**options), make(**options)
    undisturbed, state = play(alone, 4), env.reset()
    for step in range(2):
        state = env.step_and_maybe_reset(gentle(env, state, step))[1]
    start = env.reset(state.clone().set("_reset", torch.tensor([[False], [True], [False], [False]])))
    state = start.exclude("_reset")
    assert state[keys.STEP][:, 0].tolist() == [2, 0, 2, 2]
    assert equal(observed(env, state)[[1]], observed(env, undisturbed[:, 0])[[1]])
    for step in range(2, 4):
        after, state = env.step_and_maybe_reset(gentle(env, state, step))
        others = [0, 2, 3]
        assert equal(after["next"][others], undisturbed["next"][:, step][others])


@options
def test_a_group_that_is_reset_takes_the_next_scene(options: dict[str, Any]) -> None:
    env = make(**{**options, "order": "sequential"})
    state = env.step_and_maybe_reset(gentle(env, env.reset(), 0))[1]
    after = env.reset(state.clone().set("_reset", torch.tensor([[False], [False], [True], [True]])))
    assert after[keys.SCENE].tolist() == [0, 0, 2, 2]
    assert after[keys.STEP][:, 0].tolist() == [1, 1, 0, 0]
    assert equal(observed(env, after)[:2], observed(env, state)[:2])


# --- devices --------------------------------------------------------------------------------------------------------
CUDA = pytest.param(
    "cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")]
)


@pytest.mark.parametrize("device", ["cpu", CUDA])
@options
def test_every_entry_lives_on_the_device(device: str, options: dict[str, Any]) -> None:
    env = make(**options, device=device)
    check_env_specs(env)
    env.set_seed(3)
    rollout = play(env, 5)
    assert all(value.device.type == device for value in rollout.values(True, True))
    reference = make(**options)
    reference.set_seed(3)
    expected = play(reference, 5)
    torch.testing.assert_close(rollout["next", *keys.RECENT].cpu(), expected["next", *keys.RECENT])
    assert torch.equal(rollout["next", *keys.VALID].cpu(), expected["next", *keys.VALID])


# --- wrappers and transforms ----------------------------------------------------------------------------------------
def wrapped(**options: Any) -> TransformedEnv:
    return TransformedEnv(make(**options), TokenAction(VerletTokenizer(steps=options.get("decision_steps", 5))))


@options
def test_in_a_serial_environment(options: dict[str, Any]) -> None:
    check_env_specs(SerialEnv(2, partial(wrapped, **options)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plain", "a mask", "everything"])
def test_in_a_parallel_environment(name: str) -> None:
    serial, parallel = SerialEnv(2, partial(make, **OPTIONS[name])), ParallelEnv(2, partial(make, **OPTIONS[name]))
    try:
        check_env_specs(parallel)
        rollouts = []
        for env in (serial, parallel):
            env.set_seed(1)
            torch.manual_seed(0)
            rollouts.append(env.rollout(6, break_when_any_done=False))
        assert equal(*rollouts)
    finally:
        parallel.close()


WEIGHTS = {"progress": 1.0, "collision": -2.0}


@options
def test_transforms_of_torchrl_can_be_appended(options: dict[str, Any]) -> None:
    env = make(**options)
    sums = RewardSum(in_keys=[env.reward_key], out_keys=[(keys.AGENTS, "episode_reward")])
    env = TransformedEnv(env, Compose(InitTracker(), StepCounter(), sums))
    check_env_specs(env)
    rollout = play(env, 8)
    reward, total = rollout["next", keys.REWARD], rollout["next", keys.AGENTS, "episode_reward"]
    torch.testing.assert_close(total[:, [3, 7]], reward.unflatten(1, (2, 4)).sum(2))
    assert rollout["is_init"][0, :, 0].tolist() == [True, False, False, False] * 2
    assert rollout["next", "step_count"][0, :, 0].tolist() == [1, 2, 3, 4] * 2


# --- options --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"control": "ego"}, r"control must be one of \['all', 'sdc', 'predict'\] or a function .*, got 'ego'"),
        ({"decision_steps": 0}, "decision_steps must be a whole number of 1 or more, got 0"),
        ({"decision_steps": 2.5}, "decision_steps must be a whole number of 1 or more, got 2.5"),
        ({"decision_steps": 11, "horizon": 1}, "at most the 10 steps of 0.1 s of the history, got 11"),
        ({"decision_steps": 10, "horizon": 9}, r"at most 80 steps of 0.1 s, got 9 \* 10"),
        ({"horizon": -1}, "horizon must be a whole number of 1 or more, got -1"),
        ({"num_scenes": 0}, "num_scenes must be a whole number of 1 or more, got 0"),
        ({"num_rollouts": True}, "num_rollouts must be a whole number of 1 or more, got True"),
        ({"num_agents": 0}, "num_agents must be a whole number of 1 or more, got 0"),
        ({"max_controlled": 0}, "max_controlled must be a whole number of 1 or more, got 0"),
        ({"order": "shuffled"}, "order must be 'sequential' or 'random', got 'shuffled'"),
        ({"signals": ("speed",)}, r"signals must be different names of .*, got \['speed'\]"),
    ],
    ids=str,
)
def test_options_that_make_no_sense_are_refused(wrong: dict[str, Any], message: str) -> None:
    episode, rest = told_apart(wrong)
    with pytest.raises(ValueError, match=message):
        TrafficEnv(scenes(), EpisodeOptions(**episode), **rest)


@pytest.mark.parametrize(("mask", "got"), [(torch.ones(2, dtype=torch.bool), r"\(2,\) torch.bool"), ([True], "True")])
def test_a_control_that_gives_no_mask_of_the_agents_is_refused(mask: object, got: str) -> None:
    with pytest.raises(
        ValueError, match=f"straight_road_3_None: control must give a bool mask of its 3 present .*{got}"
    ):
        TrafficEnv([straight_road(3)], EpisodeOptions(control=lambda scene: mask)).reset()


# --- rewards --------------------------------------------------------------------------------------------------------
def test_a_reward_is_the_weighted_sum_of_signals_for_controlled_agents() -> None:
    env = make(signals=SIGNALS, max_controlled=2, horizon=16)
    own = play(env, 16)["next"]
    weights = {"progress": 0.5, "collision": -3.0, "offroad": -2.0, "red_light": -7.0}
    weighted = TransformedEnv(make(signals=SIGNALS, max_controlled=2, horizon=16), SignalReward(weights, imitation=0.1))
    check_env_specs(weighted)
    weighted.set_seed(0)
    got = play(weighted, 16)["next"]
    expected = 0.1 * own[keys.REWARD][..., 0]
    for name, weight in weights.items():
        expected += weight * own[keys.AGENTS, name]
    expected[~own[keys.CONTROLLED]] = 0
    torch.testing.assert_close(got[keys.REWARD][..., 0], expected)
    assert (expected != 0).any() and all(own[keys.AGENTS, name].any() for name in ("collision", "offroad"))


def test_a_reward_and_its_sum_in_any_wrapper() -> None:
    def rewarded() -> TransformedEnv:
        transforms = (SignalReward(WEIGHTS), RewardSum(in_keys=[keys.REWARD], out_keys=[(keys.AGENTS, "total")]))
        return TransformedEnv(make(signals=tuple(WEIGHTS)), Compose(TokenAction(VerletTokenizer()), *transforms))

    check_env_specs(rewarded())
    check_env_specs(SerialEnv(2, rewarded))
    rollout = rewarded().rollout(4)["next"]
    torch.testing.assert_close(rollout[keys.AGENTS, "total"][:, -1], rollout[keys.REWARD].sum(1))


def test_a_reward_of_signals_that_nobody_asked_for_is_refused() -> None:
    with pytest.raises(ValueError, match=r"gives no signal \['progress'\]; set TrafficEnv\(signals=\('progress', 'col"):
        TransformedEnv(make(signals=("collision",)), SignalReward(WEIGHTS)).observation_spec  # noqa: B018
    with pytest.raises(ValueError, match="SignalReward needs a weight, got none"):
        SignalReward({})


# --- arrivals -------------------------------------------------------------------------------------------------------
def test_arrivals_follow_the_present_agents_and_are_there_while_they_are_logged() -> None:
    scene = straight_road(4)
    valid = torch.zeros(4, 91, dtype=torch.bool)
    valid[0], valid[1, 23:61], valid[2, :31], valid[3, :5] = True, True, True, True
    scene.agents.valid = valid
    env = TrafficEnv([scene], EpisodeOptions(arrivals=True))
    rollout = env.rollout(16)
    assert env.num_agents == 3, "agent 3 is gone before the episode begins"
    state = torch.cat((rollout[keys.VALID][0, :1], rollout["next", keys.VALID][0]))  # at the steps 10, 15, 20, ...
    assert state[:, 0].all() and state[:, 1].all(), "controlled agents stay"
    assert state[:, 2].nonzero()[:, 0].tolist() == [3, 4, 5, 6, 7, 8, 9, 10], "from step 25 to step 60"
    assert rollout[keys.CONTROLLED][0, 0].tolist() == [True, True, False]
    poses = rollout["next", keys.RECENT][0, :, 2, 1:].flatten(0, 1)
    logged = scene.agents.poses[1, 11:]
    torch.testing.assert_close(poses[12:50], logged[12:50])
    torch.testing.assert_close(poses[:12, 0], logged[12, 0] - torch.arange(12, 0, -1) * 1.0), "at constant velocity"


def test_agents_that_arrive_after_the_horizon_take_no_part() -> None:
    scene = straight_road(3)
    scene.agents.valid[1, :31], scene.agents.valid[2, :30] = False, False
    assert TrafficEnv([scene], EpisodeOptions(arrivals=True, horizon=4)).num_agents == 2
    assert TrafficEnv([scene], EpisodeOptions(arrivals=True, horizon=16)).num_agents == 3
    assert TrafficEnv([scene], EpisodeOptions(horizon=16)).num_agents == 1
    with pytest.raises(ValueError, match="has 3 agents in the episode and the environment holds 2; raise num_agents"):
        TrafficEnv([scene], EpisodeOptions(arrivals=True), num_agents=2).reset()


def test_a_mask_is_of_the_present_agents_whatever_is_appended() -> None:
    scene = straight_road(4)
    scene.agents.valid[1, :17] = False

    def last_two(scene: Scene) -> torch.Tensor:
        assert scene.agents.present.all()
        return torch.tensor([False, True, True])

    for arrivals in (False, True):
        state = TrafficEnv([scene], EpisodeOptions(control=last_two, arrivals=arrivals), num_agents=6).reset()
        assert state[keys.CONTROLLED][0].tolist() == [False, True, True, False, False, False]


def test_a_simulation_leaves_its_scene_alone() -> None:
    scene = scenes()[0]
    before = scene.clone()
    TrafficEnv([scene], EpisodeOptions(arrivals=True), signals=SIGNALS).rollout(16)
    assert (scene == before).all()


if __name__ == "__main__":
    pytest.main([__file__])
