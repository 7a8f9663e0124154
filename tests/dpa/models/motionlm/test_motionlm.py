"""MotionLM: what its logits may depend on, and what they may not."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dpa.models import collate_contexts, make_context
from dpa.models.context import keep_agents
from dpa.models.motionlm import SIZES, MotionLM, SceneContext, featurize
from dpa.tokens import VerletTokenizer
from envs.episode import EpisodeOptions
from envs.scene import Scene
from envs.sources.synthetic import straight_road

CLOSE = {"atol": 1e-4, "rtol": 1e-4}


@pytest.fixture(autouse=True)
def _no_gradients() -> None:
    with torch.no_grad():
        yield


def draw(num_agents: int, rollouts: int = 2, seed: int = 0, horizon: int = 16) -> Tensor:
    """``[1, M, A, T]`` tokens of gentle changes."""
    generator = torch.Generator().manual_seed(seed)
    change = torch.randint(5, 8, (2, 1, rollouts, num_agents, horizon), generator=generator)
    return 13 * change[0] + change[1]


def all_valid(tokens: Tensor) -> Tensor:
    return torch.ones_like(tokens[:, :1], dtype=torch.bool)


def logits_of(model: MotionLM, context: SceneContext, tokens: Tensor, valid: Tensor | None = None) -> Tensor:
    return model(collate_contexts([context]), tokens, all_valid(tokens) if valid is None else valid)


def test_agents_that_are_not_valid_change_nothing(model: MotionLM, scene: Callable[..., Scene]) -> None:
    context, tokens = make_context(scene(4), featurize), draw(4)
    alone = logits_of(model, keep_agents(context, torch.arange(3)), tokens[:, :, :3])
    context = context.clone()
    context.episode.valid[3] = context.episode.controlled[3] = context.episode.logged_valid[3] = False
    context.episode.recent[3], context.episode.history[3] = 1e3, 7.0
    torch.testing.assert_close(logits_of(model, context, tokens)[:, :, :3], alone, **CLOSE)


def test_an_agent_is_seen_until_its_tokens_end(model: MotionLM, scene: Callable[..., Scene]) -> None:
    context, tokens = make_context(scene(3, leave=False), featurize), draw(3)
    valid = all_valid(tokens)
    valid[..., 2, 5:] = False
    other = tokens.clone()
    other[..., 2, 5:] = 13 * 12
    left, right = (logits_of(model, context, t, valid)[:, :, :2] for t in (tokens, other))
    assert torch.equal(left, right), "tokens after the end are not looked at"
    other[..., 2, 4] = 13 * 12
    changed = (left != logits_of(model, context, other, valid)[:, :, :2]).any(-1)
    assert changed[..., 5].all(), "where the last valid token led is looked at once"
    assert not changed[..., :5].any()


def test_agents_that_follow_the_log_are_seen_where_the_log_is(model: MotionLM, scene: Callable[..., Scene]) -> None:
    context, tokens = make_context(scene(3, leave=False), featurize, EpisodeOptions(max_controlled=2)), draw(3)
    replayed = int((~context.episode.controlled).nonzero()[0])
    other = tokens.clone()
    other[:, :, replayed] = draw(3, seed=2)[:, :, replayed]
    left = logits_of(model, context, tokens)
    assert torch.equal(left, logits_of(model, context, other)), "their tokens mean nothing"
    late = context.clone()
    late.episode.logged[replayed, 40:, :2] += 3.0
    changed = (left != logits_of(model, late, tokens)).any(-1)
    assert not changed[..., :9].any() and changed[..., context.episode.controlled, 9].all()


def test_rollouts_of_a_scene_do_not_see_each_other(model: MotionLM, scene: Callable[..., Scene]) -> None:
    context, tokens = make_context(scene(3), featurize), draw(3, rollouts=4)
    together = logits_of(model, context, tokens)
    for rollout in range(4):
        torch.testing.assert_close(
            together[:, rollout], logits_of(model, context, tokens[:, rollout : rollout + 1])[:, 0], **CLOSE
        )


@pytest.mark.parametrize("horizon", [1, 4])
def test_a_shorter_episode_is_the_beginning_of_a_longer_one(
    model: MotionLM, scene: Callable[..., Scene], horizon: int
) -> None:
    tokens = draw(3)
    logits = logits_of(model, make_context(scene(), featurize), tokens)
    short = logits_of(model, make_context(scene(), featurize, EpisodeOptions(horizon=horizon)), tokens[..., :horizon])
    torch.testing.assert_close(short, logits[..., :horizon, :], **CLOSE)


def test_fewer_tokens_than_the_context_has_decisions_see_the_log_at_the_same_times(
    model: MotionLM, scene: Callable[..., Scene]
) -> None:
    road = scene()
    road.agents.valid[1, 25:] = False
    context = make_context(road, featurize, EpisodeOptions(max_controlled=1))
    tokens = draw(3)
    whole, part = logits_of(model, context, tokens), logits_of(model, context, tokens[..., :8])
    torch.testing.assert_close(part, whole[..., :8, :], **CLOSE)


def parameters(size: str) -> int:
    return sum(p.numel() for p in MotionLM(size, VerletTokenizer()).parameters() if p.requires_grad)


def test_the_papers_size_has_a_million_parameters() -> None:
    assert parameters("paper") == pytest.approx(1e6, rel=0.05)


def test_sizes_are_ordered_as_their_names_say() -> None:
    assert parameters("nano") < parameters("small") < parameters("paper")
    assert set(SIZES) == {"nano", "small", "paper"}


def test_an_unknown_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"one of \['nano', 'paper', 'small'\], got 'huge'"):
        MotionLM("huge", VerletTokenizer())


def test_a_scene_without_lights_and_with_one_agent_works(model: MotionLM) -> None:
    assert logits_of(model, make_context(straight_road(1), featurize), draw(1)).isfinite().all()


if __name__ == "__main__":
    pytest.main([__file__])
