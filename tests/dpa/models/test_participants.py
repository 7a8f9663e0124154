"""The policy sees the agents that the environment simulates, whoever is controlled and whoever arrives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from dpa.models import Contexts, MotionActor, collate_contexts, make_context
from dpa.models.context import pad_context
from dpa.models.motionlm import MotionLM, featurize
from dpa.ranking.transform import RankRollouts
from dpa.tokens import TokenAction
from dpa.training.logs import log_item
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import CURRENT_STEP, Scene
from envs.traffic import TrafficEnv

OPTIONS = {
    "arrivals": {"arrivals": True},
    "arrivals in the first and in the last decision": {"arrivals": True, "max_controlled": 2},
    "only the SDC": {"control": "sdc"},
    "predicted agents, and arrivals": {"control": "predict", "arrivals": True},
    "a mask": {"control": lambda scene: scene.agents.track_id % 2 == 1, "arrivals": True},
    "decisions of 0.4 s": {"arrivals": True, "decision_steps": 4, "horizon": 20},
}


def with_arrivals(scene: Scene, first_steps: dict[int, int]) -> Scene:
    """The scene with some agents' logs beginning at later steps."""
    for agent, step in first_steps.items():
        for name in ("position", "heading", "velocity", "valid"):
            getattr(scene.agents, name)[agent, :step] = 0
    scene.agents.predict[1::3] = False
    return scene


@pytest.fixture
def scenes(scene: Callable[..., Scene]) -> list[Scene]:
    """Of different sizes, some with agents that come in the middle of a decision, at its end, or never in time."""
    return [
        with_arrivals(scene(5, seed=1, leave=False), {1: 23, 3: 15}),
        scene(2, seed=2),
        with_arrivals(scene(6, seed=3), {2: 11, 4: 88}),
    ]


def drive(model: MotionLM, scenes: list[Scene], **options: object) -> TensorDictBase:
    episode = EpisodeOptions(**options)
    env = TrafficEnv(scenes, episode, num_scenes=3, num_rollouts=2)
    actor = MotionActor(model, Contexts(scenes, featurize, episode), num_rollouts=2)
    return TransformedEnv(env, TokenAction(model.tokenizer)).rollout(episode.horizon, actor)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@torch.no_grad()
def test_cached_log_probs_equal_those_of_one_teacher_forced_pass(
    model: MotionLM, scenes: list[Scene], options: dict
) -> None:
    steps, horizon = options.get("decision_steps", 5), options.get("horizon", 16)
    if steps != model.tokenizer.steps:
        model = MotionLM(replace(model.config, horizon=horizon), type(model.tokenizer)(steps=steps))
    rollout = drive(model.eval(), scenes, **options)
    contexts = Contexts(scenes, featurize, EpisodeOptions(**options))
    context = pad_context(
        collate_contexts([contexts[i] for i in rollout[keys.SCENE][:, 0].tolist()]), rollout[keys.TOKEN].shape[-1]
    )
    assert torch.equal(context.episode.controlled, rollout[keys.CONTROLLED][:, 0])
    assert torch.equal(context.episode.valid, rollout[keys.VALID][:, 0])
    tokens = rollout[keys.TOKEN].transpose(1, 2)
    valid = context.episode.controlled[:, None, :, None].expand(-1, 1, -1, horizon)
    log_probs = model(context, tokens[:, None], valid).log_softmax(-1)
    expected = log_probs.gather(-1, tokens[:, None, ..., None])[:, 0, ..., 0]
    written, controlled = rollout[keys.LOG_PROB].transpose(1, 2), context.episode.controlled
    assert controlled.any(-1).all()
    torch.testing.assert_close(written[controlled], expected[controlled], atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_an_arrival_is_seen_from_its_first_decision_on_and_not_before(model: MotionLM, scenes: list[Scene]) -> None:
    options = EpisodeOptions(arrivals=True)
    seen, unseen = (make_context(scene, featurize, options) for scene in (scenes[0], scenes[0].clone()))
    late = int((~seen.episode.valid).nonzero()[0])
    first = int(seen.episode.logged_valid[late].int().argmax()) // 5
    unseen.episode.logged_valid[late] = False
    tokens, valid = torch.full((1, 1, len(seen.episode.kind), 16), 84), torch.ones(1, 1, 1, 16, dtype=torch.bool)
    left, right = (
        model(collate_contexts([each]), tokens, valid)[0, 0, seen.episode.controlled] for each in (seen, unseen)
    )
    differs = (left - right).abs().amax((0, 2)) > 0
    assert first == 2, "at step 23, in the decision that begins with step 21 and ends with step 25"
    assert not differs[: first + 1].any() and differs[first + 1]


def test_arrivals_take_nothing_from_the_context_of_those_who_are_there(scenes: list[Scene]) -> None:
    without, with_them = (
        make_context(scenes[0], featurize),
        make_context(scenes[0], featurize, EpisodeOptions(arrivals=True)),
    )
    present = len(without.episode.kind)
    assert len(with_them.episode.kind) == present + 2
    for name in ("map_pose", "map_points", "light_pose"):
        assert torch.equal(getattr(with_them, name), getattr(without, name))
    for name in ("history", "recent", "logged", "controlled", "valid"):
        assert torch.equal(getattr(with_them.episode, name)[:present], getattr(without.episode, name))


def test_arrivals_are_no_labels(model: MotionLM, scenes: list[Scene]) -> None:
    item = log_item(make_context(scenes[2], featurize, EpisodeOptions(arrivals=True)), model.tokenizer)
    assert item.context.episode.logged_valid[-1].any() and not item.token_valid[-2:].any()
    assert not scenes[2].agents.valid[[2, 4], CURRENT_STEP].any()


def test_arrivals_take_no_part_in_the_ranking(model: MotionLM, scenes: list[Scene]) -> None:
    ranked = []
    for arrivals in (False, True):
        env = TrafficEnv(scenes, EpisodeOptions(arrivals=arrivals), num_scenes=3, num_rollouts=2)
        env = TransformedEnv(env, TokenAction(model.tokenizer))
        generator, state, steps = torch.Generator().manual_seed(0), env.reset(), []
        for _ in range(16):
            token = torch.zeros_like(state[keys.VALID], dtype=torch.int64)
            token[:, :4] = torch.randint(70, 100, (6, 4), generator=generator)
            step, state = env.step_and_maybe_reset(state.set(keys.TOKEN, token))
            steps.append(step)
        ranked.append(RankRollouts(scenes, num_rollouts=2)(torch.stack(steps, 1)))
    without, with_them = ranked
    assert with_them[keys.AGENT_RANKED].shape[1] > without[keys.AGENT_RANKED].shape[1]
    for key in (keys.DISTANCE, keys.ADE):
        torch.testing.assert_close(with_them[key], without[key])


def test_a_control_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"control must be one of \['all', 'sdc', 'predict'\] .*, got 'ego'"):
        EpisodeOptions(control="ego")


if __name__ == "__main__":
    pytest.main([__file__])
