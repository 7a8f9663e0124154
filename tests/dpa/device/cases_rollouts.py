"""From reset through every decision on a device: the same as on the CPU, and a decision reads back once."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from dpa.models import Contexts, MotionActor, MotionModel
from dpa.models.closest import ClosestActor
from dpa.tokens import MotionTokenizer, TokenAction, VerletTokenizer
from envs import keys
from envs.episode import EpisodeOptions
from envs.rewards import SignalReward
from envs.scene import Scene
from envs.signals import SIGNALS
from envs.traffic import TrafficEnv
from recipes.benchmark.pretended import DEVICE, Pretended
from tests.dpa.families import TOKENIZERS, families_and_tokens, smallest

SCENES, ROLLOUTS = 2, 3
FREE = sorted(set(SIGNALS) - {"red_light"})
"""Signals for which no decision waits; that of red lights asks which vehicles pass one."""


def environment(scenes: list[Scene], device: str, tokenizer: MotionTokenizer, **options: object) -> TransformedEnv:
    env = TrafficEnv(scenes, num_scenes=len(scenes), num_rollouts=ROLLOUTS, device=device, **options)
    return TransformedEnv(env, TokenAction(tokenizer))


def driven(
    scenes: list[Scene], model: MotionModel, device: str, decisions: int, tell: Callable[[str], None] = str, **options
) -> list[TensorDictBase]:
    """What the environment and the actor say at each decision; ``tell`` hears what has been done."""
    model = deepcopy(model).to(device)
    env = environment(scenes, device, model.tokenizer, **options)
    actor = MotionActor(model, Contexts(scenes, model.featurize), num_rollouts=ROLLOUTS)
    tell("made")
    state, told = env.reset(), []
    tell("reset")
    for _ in range(decisions):
        state = actor(state)
        tell("policy")
        whole = env.step(state)
        tell("env step")
        told.append(whole.clone(False))
        state = whole["next"].exclude(keys.REWARD)
    return told


def assert_same(here: TensorDictBase, there: TensorDictBase) -> None:
    """Equal; log-probabilities up to the rounding of another way to sort."""
    assert set(here.keys(True, True)) == set(there.keys(True, True))
    for key, value in here.items(True, True):
        other = there[key]
        assert other.device.type == DEVICE, key
        exact = "log_prob" not in key[-1]
        torch.testing.assert_close(other.cpu(), value, rtol=0, atol=0 if exact else 1e-6, msg=str(key))


@families_and_tokens
def test_rollouts_are_those_of_the_cpu_and_a_decision_reads_back_once(
    family: str, make_tokenizer: Callable, scene: Callable[..., Scene]
) -> None:
    scenes, model, heard = [scene(4, seed=0), scene(3, seed=1)], smallest(family, make_tokenizer()).eval(), []
    with torch.no_grad():
        want = driven(scenes, model, "cpu", 5)
        with Pretended() as count:

            def tell(what: str) -> None:
                heard.append((what, dict(count.read_backs), count.uploads))
                count.reset()

            got = driven(scenes, model, DEVICE, 5, tell)
            for here, there in zip(want, got, strict=True):
                assert_same(here, there)
    policies, steps = ([each for each in heard if each[0] == what] for what in ("policy", "env step"))
    # The first decision looks at the scenes.
    assert policies[1:] == [("policy", {"_to_copy": 1}, 0)] * 4
    assert steps == [("env step", {}, 0)] * 5


def test_signals_are_those_of_the_cpu_and_no_step_waits_for_them(scene: Callable[..., Scene]) -> None:
    scenes, model = [scene(4, seed=0), scene(3, seed=1)], smallest("motionlm").eval()
    waits = {}
    with torch.no_grad():
        want = driven(scenes, model, "cpu", 4, signals=tuple(SIGNALS))
        with Pretended() as count:
            got = driven(scenes, model, DEVICE, 4, signals=tuple(SIGNALS))
            for here, there in zip(want, got, strict=True):
                assert_same(here, there)

            def tell(what: str) -> None:
                waits.setdefault(what, []).append((dict(count.read_backs), count.uploads))
                count.reset()

            driven(scenes, model, DEVICE, 4, tell, signals=FREE)
    assert any(bool(step["next", "agents", "offroad"].any()) for step in want), "some signal says something"
    assert waits["env step"][1:] == [({}, 0)] * 3  # maps are made ready in the first one


def test_rows_that_begin_again_alone_do_so_on_the_device(scene: Callable[..., Scene]) -> None:
    scenes = [scene(4, seed=0), scene(3, seed=1)]

    def again(device: str) -> TensorDictBase:
        env = environment(
            scenes, device, VerletTokenizer(), signals=("offroad",), episode=EpisodeOptions(arrivals=True)
        )
        state = env.reset()
        state[keys.TOKEN] = torch.full(state[keys.KIND].shape, 84, device=device)
        state = env.step(state)["next"]
        state["_reset"] = (torch.arange(SCENES * ROLLOUTS, device=device) % 2 == 0)[:, None]
        return env.reset(state)

    with torch.no_grad():
        want = again("cpu")
        with Pretended():
            assert_same(want, again(DEVICE))


def test_an_environment_that_has_begun_may_be_moved(scene: Callable[..., Scene]) -> None:
    """TorchRL's collectors do so, and ``check_env_specs`` has begun it."""
    made = TrafficEnv([scene(4, seed=0)], num_scenes=1, num_rollouts=2, signals=("offroad",))
    want = made.reset()
    with torch.no_grad(), Pretended():
        moved = made.to(DEVICE)
        assert moved is made
        assert_same(want, moved.reset())
        moved.step(moved.rand_action(moved.reset()))


@pytest.mark.parametrize("spoken", ["verlet", "k_disks"])
def test_a_policy_that_stays_near_the_log_does_so_on_the_device(spoken: str, scene: Callable[..., Scene]) -> None:
    scenes, model = [scene(4, seed=0)], smallest("motionlm", TOKENIZERS[spoken]()).eval()

    def followed(device: str) -> TensorDictBase:
        moved = deepcopy(model).to(device)
        env = TrafficEnv(scenes, device=device, signals=("progress",))
        driven = TransformedEnv(env, TokenAction(moved.tokenizer), SignalReward({"progress": 1.0}))
        actor = ClosestActor(moved, Contexts(scenes, moved.featurize), candidates=8, recovery=0.5)
        return driven.rollout(4, actor)

    want = followed("cpu")
    with Pretended():
        assert_same(want, followed(DEVICE))


if __name__ == "__main__":
    pytest.main([__file__])
