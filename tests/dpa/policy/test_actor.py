"""MotionActor: what it samples, and that decoding with a cache is decoding."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dpa.policy import ContextOptions, MotionActor, MotionLM, collate_contexts
from dpa.policy.actor import Contexts, nucleus, pad_context
from dpa.tokens import TokenAction
from envs import keys
from envs.scene import Scene
from envs.sources.synthetic import straight_road
from envs.traffic import TrafficEnv

LIMIT = 3
"""Controlled agents: the scenes below have more, which follow their logs."""


@pytest.fixture
def scenes(scene: Callable[..., Scene]) -> list[Scene]:
    """Of different sizes, with agents whose logs end."""
    return [scene(4, seed=1), scene(2, seed=2), scene(6, seed=3)]


def drive(model: MotionLM, scenes: list[Scene], **options: float) -> tuple[TransformedEnv, MotionActor]:
    """Environment and actor of two scenes at a time, two rollouts each."""
    env = TrafficEnv(scenes, num_scenes=2, num_rollouts=2, max_controlled=LIMIT)
    actor = MotionActor(model, Contexts(scenes, ContextOptions(max_controlled=LIMIT)), num_rollouts=2, **options)
    return TransformedEnv(env, TokenAction(model.tokenizer)), actor


@torch.no_grad()
def teacher_forced(model: MotionLM, scenes: list[Scene], scene: Tensor, tokens: Tensor) -> Tensor:
    """``[B, A, T]`` log-probabilities of whole rollouts ``[B, A, T]``, each row with its scene."""
    contexts = Contexts(scenes, ContextOptions(max_controlled=LIMIT))
    context = pad_context(collate_contexts([contexts[i] for i in scene.tolist()]), tokens.shape[1])
    valid = context.controlled[:, None, :, None].expand(-1, 1, -1, tokens.shape[-1])
    log_probs = model(context, tokens[:, None], valid).log_softmax(-1)
    return log_probs.gather(-1, tokens[:, None, ..., None])[:, 0, ..., 0]


def assert_as_teacher_forced(model: MotionLM, scenes: list[Scene], rollout: TensorDictBase) -> None:
    """One episode ``[B, T]``: the written log-probabilities are those of the model in one pass."""
    tokens = rollout[keys.TOKEN].transpose(1, 2)
    expected = teacher_forced(model, scenes, rollout[keys.SCENE][:, 0], tokens)
    controlled = rollout[keys.CONTROLLED][:, 0]
    written = rollout[keys.LOG_PROB].transpose(1, 2)
    assert controlled.any()
    torch.testing.assert_close(written[controlled], expected[controlled], atol=1e-5, rtol=1e-5)


def test_cached_log_probs_equal_those_of_one_teacher_forced_pass(model: MotionLM, scenes: list[Scene]) -> None:
    env, actor = drive(model, scenes)
    rollout = env.rollout(16, actor)
    assert (~rollout[keys.CONTROLLED] & rollout[keys.VALID]).any(), "some agents follow their logs"
    assert_as_teacher_forced(model, scenes, rollout)


def test_the_cache_is_right_episode_after_episode(model: MotionLM, scenes: list[Scene]) -> None:
    env, actor = drive(model, scenes)
    rollout = env.rollout(48, actor, break_when_any_done=False)
    for episode in rollout.split(16, 1):
        assert_as_teacher_forced(model, scenes, episode)
    assert rollout[keys.SCENE][::2, ::16].tolist() == [[0, 2, 1], [1, 0, 2]]


def run_with_resets(env: TransformedEnv, actor: MotionActor, resets: dict[int, list[bool]], num: int) -> TensorDict:
    """Roll ``[B, num]`` out; before some steps some rows are reset."""
    state, steps = env.reset(), []
    for step in range(num):
        if step in resets:
            state = env.reset(state.set("_reset", torch.tensor(resets[step])[:, None])).exclude("_reset")
        steps.append(env.step(actor(state)))
        state = steps[-1]["next"].exclude("reward", keys.REWARD)
    return torch.stack(steps, 1)


def test_rows_may_stand_at_different_decisions(model: MotionLM, scenes: list[Scene]) -> None:
    env, actor = drive(model, scenes)
    # At 5 one row starts again, at 8 a whole group moves on, at 10 another row starts again.
    resets = {5: [False, True, False, False], 8: [False, False, True, True], 10: [True, False, False, False]}
    rollout = run_with_resets(env, actor, resets, 16)
    assert rollout[keys.SCENE][:, -1].tolist() == [0, 0, 2, 2]
    for row, start in ((0, 10), (1, 5), (2, 8), (3, 8)):
        part = rollout[row : row + 1, start:]
        assert part[keys.STEP][0, :, 0].tolist() == list(range(16 - start))
        whole = torch.nn.functional.pad(part[keys.TOKEN].transpose(1, 2), (0, start), value=84)
        expected = teacher_forced(model, scenes, part[keys.SCENE][:, 0], whole)[..., : 16 - start]
        controlled = part[keys.CONTROLLED][:, 0]
        written = part[keys.LOG_PROB].transpose(1, 2)
        torch.testing.assert_close(written[controlled], expected[controlled], atol=1e-5, rtol=1e-5)


def test_written_log_probs_are_those_of_the_model_whatever_was_sampled_from(
    model: MotionLM, scenes: list[Scene]
) -> None:
    env, actor = drive(model, scenes, top_p=0.4, temperature=0.7)
    assert_as_teacher_forced(model, scenes, env.rollout(16, actor))


def test_equal_seeds_sample_equal_tokens(model: MotionLM, scenes: list[Scene]) -> None:
    def sample(seed: int) -> Tensor:
        env, actor = drive(model, scenes, seed=seed)
        return env.rollout(4, actor)[keys.TOKEN]

    first = sample(1)
    torch.manual_seed(123)
    assert torch.equal(sample(1), first), "the global generator has no say"
    assert not torch.equal(sample(2), first)


def test_an_actor_can_be_seeded_anew(model: MotionLM, scenes: list[Scene]) -> None:
    env, actor = drive(model, scenes, seed=5)
    env.set_seed(0)
    first = env.rollout(4, actor)[keys.TOKEN]
    actor.set_seed(5)
    env.set_seed(0)
    assert torch.equal(env.rollout(4, actor)[keys.TOKEN], first)


def test_rollouts_of_one_scene_differ(model: MotionLM, scenes: list[Scene]) -> None:
    env, actor = drive(model, scenes)
    tokens = env.rollout(4, actor)[keys.TOKEN]
    assert not torch.equal(tokens[0], tokens[1])


def test_the_deterministic_choice_is_the_most_probable_token(model: MotionLM, scenes: list[Scene]) -> None:
    env, actor = drive(model, scenes)
    state = env.reset()
    logits = drive(model, scenes)[1].logits(state)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(actor(state)[keys.TOKEN], logits.argmax(-1))


def test_a_scene_is_encoded_once_for_all_its_rollouts_and_decisions(model: MotionLM, scenes: list[Scene]) -> None:
    encoded = []
    model.encoder.register_forward_hook(lambda *_: encoded.append(1))
    env, actor = drive(model, scenes)
    env.rollout(16, actor)
    assert len(encoded) == 1


# --- nucleus --------------------------------------------------------------------------------------------------------
def nucleus_by_hand(probs: list[float], top_p: float) -> list[float]:
    """Take the most probable tokens one by one until they hold ``top_p``."""
    kept, total = set(), 0.0
    for index in sorted(range(len(probs)), key=lambda i: -probs[i]):
        kept.add(index)
        total += probs[index]
        if total >= top_p:
            break
    return [p / total if i in kept else 0.0 for i, p in enumerate(probs)]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(0.01, 10), min_size=1, max_size=8, unique=True), st.floats(0.01, 0.99))
def test_the_nucleus_is_the_smallest_set_that_holds_top_p(weights: list[float], top_p: float) -> None:
    probs = torch.tensor(weights, dtype=torch.float64)
    probs = probs / probs.sum()
    if (probs.sort(descending=True).values.cumsum(-1) - top_p).abs().min() < 1e-9:
        return  # a tie is a matter of rounding
    expected = torch.tensor(nucleus_by_hand(probs.tolist(), top_p), dtype=torch.float64)
    torch.testing.assert_close(nucleus(probs, top_p), expected)


def test_a_nucleus_of_one_is_the_whole_distribution() -> None:
    probs = torch.tensor([0.2, 0.5, 0.3])
    assert torch.equal(nucleus(probs, 1.0), probs)


def test_a_tiny_nucleus_is_the_most_probable_token(model: MotionLM, scenes: list[Scene]) -> None:
    env, actor = drive(model, scenes, top_p=1e-6)
    state = env.reset()
    logits = drive(model, scenes)[1].logits(state)
    assert torch.equal(actor(state)[keys.TOKEN], logits.argmax(-1))


# --- errors ---------------------------------------------------------------------------------------------------------
def test_options_that_make_no_sense_are_refused(model: MotionLM) -> None:
    contexts = Contexts([straight_road()])
    for options, message in (
        ({"top_p": 0.0}, r"top_p must lie in \(0, 1\], got 0.0"),
        ({"top_p": 1.5}, "got 1.5"),
        ({"temperature": 0.0}, "temperature must be positive, got 0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            MotionActor(model, contexts, **options)


def test_another_number_of_rollouts_than_the_environment_has_is_refused(model: MotionLM) -> None:
    scenes = [straight_road()]
    env = TransformedEnv(TrafficEnv(scenes, num_rollouts=3), TokenAction(model.tokenizer))
    with pytest.raises(ValueError, match="num_rollouts must divide the batch of 3 rows, got 2"):
        MotionActor(model, Contexts(scenes), num_rollouts=2)(env.reset())


def test_contexts_of_other_scenes_are_refused(model: MotionLM) -> None:
    env = TransformedEnv(TrafficEnv([straight_road(1)]), TokenAction(model.tokenizer))
    with pytest.raises(ValueError, match="contexts hold 3 agents and the environment 1"):
        MotionActor(model, Contexts([straight_road(3)]))(env.reset())


if __name__ == "__main__":
    pytest.main([__file__])
