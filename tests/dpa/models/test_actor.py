"""MotionActor: what it samples, and that decoding with a cache is decoding."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dpa.models import Contexts, MotionActor, collate_contexts
from dpa.models.context import pad_context
from dpa.models.motionlm import MotionLM, featurize
from dpa.models.sampling import Decoding
from dpa.tokens import TokenAction
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import Scene
from envs.sources.synthetic import straight_road
from envs.traffic import TrafficEnv

LIMIT = 3
"""Controlled agents: the scenes below have more, which follow their logs."""


@pytest.fixture
def scenes(scene: Callable[..., Scene]) -> list[Scene]:
    """Of different sizes, with agents whose logs end."""
    return [scene(4, seed=1), scene(2, seed=2), scene(6, seed=3)]


def drive(model: MotionLM, scenes: list[Scene], **options: Any) -> tuple[TransformedEnv, MotionActor]:
    """Environment and actor of two scenes at a time, two rollouts each."""
    env = TrafficEnv(scenes, EpisodeOptions(max_controlled=LIMIT), num_scenes=2, num_rollouts=2)
    actor = MotionActor(
        model, Contexts(scenes, featurize, EpisodeOptions(max_controlled=LIMIT)), num_rollouts=2, **options
    )
    return TransformedEnv(env, TokenAction(model.tokenizer)), actor


@torch.no_grad()
def teacher_forced(model: MotionLM, scenes: list[Scene], scene: Tensor, tokens: Tensor) -> Tensor:
    """``[B, A, T]`` log-probabilities of whole rollouts ``[B, A, T]``, each row with its scene."""
    contexts = Contexts(scenes, featurize, EpisodeOptions(max_controlled=LIMIT))
    context = pad_context(collate_contexts([contexts[i] for i in scene.tolist()]), tokens.shape[1])
    valid = context.episode.controlled[:, None, :, None].expand(-1, 1, -1, tokens.shape[-1])
    log_probs = model(context, tokens[:, None], valid).log_softmax(-1)
    return log_probs.gather(-1, tokens[:, None, ..., None])[:, 0, ..., 0]


def test_a_decision_out_of_turn_is_refused(model: MotionLM, scenes: list[Scene]) -> None:
    env, actor = drive(model, scenes)
    second = env.rollout(2, actor)["next"][:, 0].exclude(keys.TOKEN)
    with pytest.raises(ValueError, match=r"got \[1, 1, 1, 1\] where \[2, 2, 2, 2\] or 0 was due"):
        actor(second)
    _, fresh = drive(model, scenes)
    with pytest.raises(
        ValueError, match=r"got \[1, 1, 1, 1\] where \[0, 0, 0, 0\] or 0 was due; reset the environment"
    ):
        fresh(second)


def test_the_contexts_used_last_are_kept() -> None:
    contexts = Contexts([straight_road(count) for count in (1, 2, 3)], featurize, most=2)
    first, _, again = contexts[0], contexts[1], contexts[0]
    assert again is first
    contexts[2]
    assert contexts[0] is first, "used after the second one, which had to go"
    assert len(contexts._made) == 2 and len(contexts) == 3


def assert_as_teacher_forced(model: MotionLM, scenes: list[Scene], rollout: TensorDictBase) -> None:
    """One episode ``[B, T]``: the written log-probabilities are those of the model in one pass."""
    tokens = rollout[keys.TOKEN].transpose(1, 2)
    expected = teacher_forced(model, scenes, rollout[keys.SCENE][:, 0], tokens)
    controlled = rollout[keys.CONTROLLED][:, 0]
    written = rollout[keys.LOG_PROB].transpose(1, 2)
    assert controlled.any()
    torch.testing.assert_close(written[controlled], expected[controlled], atol=1e-5, rtol=1e-5)


def test_written_log_probs_are_those_of_the_model_whatever_was_sampled_from(
    model: MotionLM, scenes: list[Scene]
) -> None:
    env, actor = drive(model, scenes, decoding=Decoding(top_p=0.4, temperature=0.7))
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


@pytest.mark.parametrize("kind", [ExplorationType.DETERMINISTIC, ExplorationType.MODE])
def test_the_choice_without_chance_is_the_most_probable_token(
    model: MotionLM, scenes: list[Scene], kind: ExplorationType
) -> None:
    env, actor = drive(model, scenes)
    state = env.reset()
    logits = drive(model, scenes)[1].decide(state)[0].logits
    with set_exploration_type(kind):
        assert torch.equal(actor(state)[keys.TOKEN], logits.argmax(-1))


def test_sampling_log_probs_are_those_of_the_cut_distribution(model: MotionLM, scenes: list[Scene]) -> None:
    decoding = Decoding(top_p=0.6, temperature=0.8, top_k=20)
    env, actor = drive(model, scenes, decoding=decoding)
    state = env.reset()
    logits = drive(model, scenes)[1].decide(state)[0].logits
    out = actor(state)
    expected = decoding.log_probs(logits).gather(-1, out[keys.TOKEN][..., None])[..., 0]
    torch.testing.assert_close(out[keys.SAMPLING_LOG_PROB], expected)
    assert torch.isfinite(expected).all() and (expected > out[keys.LOG_PROB]).any()


# --- a rollout depends on (scene, k, seed) --------------------------------------------------------------------------
def tokens_of(model: MotionLM, scenes: list[Scene], order: list[int], **options: Any) -> dict[tuple[str, int], Tensor]:
    """Tokens ``[T, A]`` of all rollouts by scene and number, of scenes rolled out together in some order."""
    rollouts, first = options.pop("num_rollouts", 2), options.pop("first_rollout", 0)
    chosen = [scenes[index] for index in order]
    env = TrafficEnv(
        chosen, EpisodeOptions(max_controlled=LIMIT), num_scenes=len(chosen), num_rollouts=rollouts, **options
    )
    contexts = Contexts(chosen, featurize, EpisodeOptions(max_controlled=LIMIT))
    actor = MotionActor(model, contexts, num_rollouts=rollouts, first_rollout=first, seed=7)
    rollout = TransformedEnv(env, TokenAction(model.tokenizer)).rollout(16, actor)
    return {
        (scene.scene_id, first + k): rollout[row * rollouts + k][keys.TOKEN][:, : int(scene.agents.present.sum())]
        for row, scene in enumerate(chosen)
        for k in range(rollouts)
    }


@pytest.mark.parametrize(
    ("order", "options"),
    [
        ([2, 0, 1], {}),  # in another order
        ([1], {}),  # alone
        ([0, 2], {"num_agents": 30}),  # with more padding
        ([0, 1, 2], {"num_rollouts": 1}),  # fewer rollouts
        ([0, 1, 2], {"num_rollouts": 1, "first_rollout": 1}),  # the others of them
    ],
)
def test_a_rollout_depends_on_scene_number_and_seed_and_not_on_its_batch(
    model: MotionLM, scenes: list[Scene], order: list[int], options: dict[str, int]
) -> None:
    whole = tokens_of(model, scenes, [0, 1, 2])
    for named, tokens in tokens_of(model, scenes, order, **options).items():
        assert torch.equal(tokens, whole[named]), named


def test_a_rollout_that_is_begun_again_comes_out_anew(model: MotionLM, scenes: list[Scene]) -> None:
    env = TransformedEnv(TrafficEnv(scenes[:1], num_rollouts=2), TokenAction(model.tokenizer))
    actor = MotionActor(model, Contexts(scenes[:1], featurize), num_rollouts=2)
    first, second = (env.rollout(16, actor)[keys.TOKEN] for _ in range(2))
    assert not torch.equal(first, second)
    actor.set_seed(0)
    assert torch.equal(env.rollout(16, actor)[keys.TOKEN], first)


def test_a_scene_is_encoded_once_for_all_its_rollouts_and_decisions(model: MotionLM, scenes: list[Scene]) -> None:
    encoded = []
    model.encoder.register_forward_hook(lambda *_: encoded.append(1))
    env, actor = drive(model, scenes)
    env.rollout(16, actor)
    assert len(encoded) == 1


# --- how the model is run -------------------------------------------------------------------------------------------
@torch.no_grad()
def test_bfloat16_changes_the_distribution_by_little(model: MotionLM, scenes: list[Scene]) -> None:
    env, exact = drive(model, scenes)
    rounded = drive(model, scenes, precision="bfloat16")[1]
    state = env.reset()
    before, after = (
        actor.decide(state)[0].logits.float()[state[keys.CONTROLLED]].log_softmax(-1) for actor in (exact, rounded)
    )
    assert not torch.equal(before, after)
    assert (before.exp() * (before - after)).sum(-1).abs().max() < 1e-3


@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")  # raised by torch's own compiler
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
@torch.no_grad()
@pytest.mark.slow
def test_a_compiled_decoder_gives_the_same_log_probs_and_tokens(model: MotionLM, scenes: list[Scene]) -> None:
    ways = drive(model, scenes), drive(model, scenes, compile=True)
    expected, found = (env.rollout(16, actor) for env, actor in ways)
    seen = expected[keys.CONTROLLED]
    assert torch.equal(found[keys.TOKEN][seen], expected[keys.TOKEN][seen])
    torch.testing.assert_close(found[keys.LOG_PROB][seen], expected[keys.LOG_PROB][seen], atol=1e-5, rtol=1e-5)


# --- errors ---------------------------------------------------------------------------------------------------------
def test_another_number_of_rollouts_than_the_environment_has_is_refused(model: MotionLM) -> None:
    scenes = [straight_road()]
    env = TransformedEnv(TrafficEnv(scenes, num_rollouts=3), TokenAction(model.tokenizer))
    with pytest.raises(ValueError, match="num_rollouts must divide the batch of 3 rows, got 2"):
        MotionActor(model, Contexts(scenes, featurize), num_rollouts=2)(env.reset())


def test_groups_of_one_batch_that_show_one_scene_differ(model: MotionLM) -> None:
    scenes = [straight_road(3)]
    env = TransformedEnv(TrafficEnv(scenes, num_scenes=2, num_rollouts=2), TokenAction(model.tokenizer))
    actor = MotionActor(model, Contexts(scenes, featurize), num_rollouts=2)
    tokens = env.rollout(16, actor)[keys.TOKEN].flatten(1)
    assert len(tokens.unique(dim=0)) == 4
    again = env.rollout(16, actor)[keys.TOKEN].flatten(1)
    assert len(torch.cat((tokens, again)).unique(dim=0)) == 8


def test_contexts_of_other_agents_are_refused(model: MotionLM) -> None:
    scene = straight_road(3)
    scene.agents.valid[1, :30] = False
    env = TransformedEnv(TrafficEnv([scene], EpisodeOptions(arrivals=True)), TokenAction(model.tokenizer))
    with pytest.raises(ValueError, match="differ in 'kind' .* give both the same scenes, arrivals"):
        env.rollout(1, MotionActor(model, Contexts([scene], featurize)))


def test_contexts_of_other_scenes_are_refused(model: MotionLM) -> None:
    env = TransformedEnv(TrafficEnv([straight_road(1)]), TokenAction(model.tokenizer))
    with pytest.raises(ValueError, match="contexts hold 3 agents and the environment 1"):
        MotionActor(model, Contexts([straight_road(3)], featurize))(env.reset())


if __name__ == "__main__":
    pytest.main([__file__])
