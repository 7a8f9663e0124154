"""What every family must do: the same decision by decision as in one pass, wherever a scene lies, whoever is padded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dpa.models import Contexts, MotionActor, MotionModel, collate_contexts, make_context
from dpa.models.context import keep_agents, pad_context
from dpa.models.words import TokenEmbedding, TokenHead
from dpa.tokens import KDisksTokenizer, MotionTokenizer, TokenAction
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import AgentKind, MapKind, Scene
from envs.sources.synthetic import build_scene
from envs.traffic import TrafficEnv
from tests.dpa.families import TOKENIZERS, families, families_of_tokens, smallest, tokens_of


def make(family: str, tokenizer: MotionTokenizer | None = None, horizon: int = 16) -> MotionModel:
    """A small policy whose parameters are all non-zero."""
    model = smallest(family, tokenizer, horizon).eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
    return model


def drive(model: MotionModel, scenes: list[Scene], episode: EpisodeOptions, rollouts: int = 2) -> TensorDictBase:
    env = TrafficEnv(scenes, episode, num_scenes=len(scenes), num_rollouts=rollouts)
    actor = MotionActor(model, Contexts(scenes, model.featurize, episode), num_rollouts=rollouts)
    return TransformedEnv(env, TokenAction(model.tokenizer)).rollout(episode.horizon, actor)


def assert_as_near(model: MotionModel, one: Tensor, other: Tensor) -> None:
    """Log-probabilities to 1e-5; a density, which a millimetre changes by a nat, to 1e-4 of its size."""
    atol, rtol = (1e-5, 0.0) if model.distribution.discrete else (2e-3, 1e-4)
    torch.testing.assert_close(one, other, atol=atol, rtol=rtol)


@torch.no_grad()
def forced(model: MotionModel, scenes: list[Scene], episode: EpisodeOptions, rolled: TensorDictBase) -> Tensor:
    """``[B, A, T]`` log-probabilities, or log-densities, of the tokens of rollouts, of one teacher-forced pass."""
    contexts = collate_contexts([make_context(scene, model.featurize, episode) for scene in scenes])
    tokens = rolled[keys.TOKEN].transpose(1, 2).unflatten(0, (len(scenes), -1))
    context = pad_context(contexts, tokens.shape[2])
    for mine, key in ((context.episode.controlled, keys.CONTROLLED), (context.episode.valid, keys.VALID)):
        assert torch.equal(mine.repeat_interleave(tokens.shape[1], 0), rolled[key][:, 0]), "the same agents"
    valid = context.episode.controlled[:, None, :, None].expand(-1, 1, -1, tokens.shape[3])
    return model.distribution.log_prob(model(context, tokens, valid), tokens).flatten(0, 1)


OPTIONS = {
    "plain": EpisodeOptions(),
    "two controlled": EpisodeOptions(max_controlled=2),
    "arrivals": EpisodeOptions(arrivals=True),
    "arrivals, two controlled": EpisodeOptions(arrivals=True, max_controlled=2),
    "only the SDC": EpisodeOptions(control="sdc"),
    "predicted agents, and arrivals": EpisodeOptions(control="predict", arrivals=True),
    "a mask, and arrivals": EpisodeOptions(control=lambda scene: scene.agents.track_id % 2 == 1, arrivals=True),
    "short": EpisodeOptions(horizon=5),
}


@families
@pytest.mark.parametrize("episode", OPTIONS.values(), ids=OPTIONS)
def test_decision_by_decision_is_as_in_one_pass(family: str, episode: EpisodeOptions, arriving: list[Scene]) -> None:
    model = make(family)
    rolled = drive(model, arriving, episode)
    written, controlled = (rolled[key].transpose(1, 2) for key in (keys.LOG_PROB, keys.CONTROLLED))
    assert controlled[..., 0].any(-1).all()
    expected = forced(model, arriving, episode, rolled)
    assert_as_near(model, written[controlled], expected[controlled])
    assert written[controlled].std() > 0.1, "tokens differ in how likely they are"


@families
@pytest.mark.parametrize("steps", [2, 4, 10])
def test_decisions_of_any_length_are_as_in_one_pass(family: str, steps: int, arriving: list[Scene]) -> None:
    episode = EpisodeOptions(decision_steps=steps, horizon=min(80 // steps, 12), arrivals=True)
    model, scenes = make(family, tokens_of(family, steps), episode.horizon), arriving[:1]
    rolled = drive(model, scenes, episode)
    written, controlled = (rolled[key].transpose(1, 2) for key in (keys.LOG_PROB, keys.CONTROLLED))
    expected = forced(model, scenes, episode, rolled)
    assert_as_near(model, written[controlled], expected[controlled])


@families_of_tokens
def test_tokens_of_logged_motions_are_as_in_one_pass(family: str, scene: Callable) -> None:
    motions = torch.rand(5, 30, 5, 3, generator=torch.Generator().manual_seed(0)) - 0.3
    model, scenes = make(family, KDisksTokenizer.of(motions)), [scene(3, seed=1)]
    rolled = drive(model, scenes, EpisodeOptions())
    written, controlled = (rolled[key].transpose(1, 2) for key in (keys.LOG_PROB, keys.CONTROLLED))
    expected = forced(model, scenes, EpisodeOptions(), rolled)
    torch.testing.assert_close(written[controlled], expected[controlled], atol=1e-5, rtol=0)


def with_a_head(model: MotionModel) -> None:
    """A family may have another one than those of the package share."""
    if not any(isinstance(each, TokenHead) for each in model.modules()):
        pytest.skip("tokens have a head of the family's own")


def logits_of(model: MotionModel, context: object, tokens: Tensor) -> Tensor:
    valid = torch.ones(1, 1, *tokens.shape[2:4], dtype=torch.bool)
    with torch.no_grad():
        return model(collate_contexts([context]), tokens, valid)


def tokens_for(model: MotionModel, agents: int, rollouts: int = 2) -> Tensor:
    """Some motions forwards, of every agent."""
    generator = torch.Generator().manual_seed(1)
    shape = (1, rollouts, agents, 16)
    if model.tokenizer.vocab_size:
        return torch.randint(60, 110, shape, generator=generator)
    moves = torch.rand(*shape, 5, 3, generator=generator) * torch.tensor([0.5, 0.02, 0.02])
    return moves.cumsum(-2).flatten(-2)


@families
@pytest.mark.parametrize("motion", [(300.0, -80.0, 0.0), (0.0, 0.0, 2.5), (-40.0, 120.0, -1.2)])
def test_where_a_scene_lies_changes_nothing(family: str, motion: tuple, scene: Callable, move: Callable) -> None:
    model = make(family)
    tokens = tokens_for(model, 3)
    here, there = scene(3), move(scene(3), torch.tensor(motion))
    mine, other = (logits_of(model, make_context(each, model.featurize), tokens) for each in (here, there))
    torch.testing.assert_close(other, mine, atol=2e-4, rtol=0)


@families_of_tokens
def test_where_a_token_means_another_motion_for_each_class_each_has_its_own_logits_and_embeddings(family: str) -> None:
    model = make(family, TOKENIZERS["k_disks"]())
    with_a_head(model)
    words, (head,) = model.tokenizer.vocab_size, [each for each in model.modules() if isinstance(each, TokenHead)]
    kinds, rows = torch.arange(len(AgentKind)), [0, 0, 1, 2, 0]  # neither of three: as vehicles
    with torch.no_grad():
        head.bias.copy_(torch.arange(len(head.bias)).float())
    logits = head(torch.zeros(len(kinds), head.in_features), kinds)
    assert logits.tolist() == [[float(row * words + word) for word in range(words)] for row in rows]
    for embedding in [each for each in model.modules() if isinstance(each, TokenEmbedding)]:
        with torch.no_grad():
            embedding.weight.copy_(torch.arange(len(embedding.weight))[:, None].expand_as(embedding.weight))
        said = embedding(torch.tensor([[0], [words]]).expand(2, len(kinds)), kinds)[..., 0]
        assert said.tolist() == [[float(row * (words + 1) + token) for row in rows] for token in (0, words)]


@families_of_tokens
def test_where_a_token_means_the_same_for_all_they_share_logits_and_embeddings(family: str) -> None:
    model = make(family)
    with_a_head(model)
    (head,) = [each for each in model.modules() if isinstance(each, TokenHead)]
    (embedding,) = [each for each in model.modules() if isinstance(each, TokenEmbedding)]
    assert head.out_features == model.tokenizer.vocab_size == embedding.num_embeddings - 1


@families
def test_a_stop_sign_turns_with_its_scene(family: str, move: Callable) -> None:
    model, tokens = make(family), tokens_for(make(family), 2)
    lane = torch.stack((torch.linspace(-20, 38, 30), torch.zeros(30)), -1)
    lines = [(MapKind.LANE_SURFACE_STREET, lane), (MapKind.STOP_SIGN, torch.tensor([[9.0, 4.0]]))]
    positions = torch.zeros(2, 91, 3)
    positions[..., 0] = torch.arange(91) * 0.5 - torch.tensor([[0.0], [12.0]])
    here = build_scene(positions, lines)
    there = move(here, torch.tensor((30.0, -5.0, 1.1)))
    mine, other = (logits_of(model, make_context(each, model.featurize), tokens) for each in (here, there))
    torch.testing.assert_close(other, mine, atol=2e-3, rtol=0)


def nobody(context: Any, agent: int) -> Tensor:
    return torch.zeros_like(context.episode.valid)


def those_farther_from_the_sdc(context: Any, agent: int) -> Tensor:
    places = context.episode.recent[:, -1, :2]
    away = (places - places[0]).norm(dim=-1)  # the SDC of these scenes is their first agent
    return away > away[agent]


SEEN_AT_ONCE = {"trajeglish": those_farther_from_the_sdc}
"""Who sees the token of an agent in the decision that it is of, where anybody does; all may from the next one on."""


SEE_THEMSELVES_ALONE: frozenset[str] = frozenset()
"""Families whose agents look at nobody else; none of the package."""


@families
@pytest.mark.parametrize("decision", [0, 6, 15])
def test_a_token_is_seen_by_those_who_decide_after_it(family: str, decision: int, scene: Callable) -> None:
    model = make(family)
    tokens = tokens_for(model, 4)
    context, other = make_context(scene(4, leave=False), model.featurize), tokens.clone()
    other[:, :, 1, decision] = 13 * 12 if model.tokenizer.vocab_size else tokens[:, :, 1, decision] / 2
    changed = (logits_of(model, context, tokens) != logits_of(model, context, other)).any(-1)
    assert not changed[..., :decision].any()
    assert torch.equal(changed[..., decision], SEEN_AT_ONCE.get(family, nobody)(context, 1).expand(1, 2, 4))
    later = changed[..., decision + 1 :]
    assert later[:, :, 1].all() if family in SEE_THEMSELVES_ALONE else later.all(), "everybody is near"


@families
def test_padding_and_the_order_of_agents_change_nothing(family: str, scene: Callable) -> None:
    model = make(family)
    tokens = tokens_for(model, 6)
    small, large = (make_context(scene(count, seed=count), model.featurize) for count in (2, 6))
    alone = logits_of(model, small, tokens[:, :, :2])
    with torch.no_grad():
        valid = torch.ones(2, 1, 6, 16, dtype=torch.bool)
        both = model(collate_contexts([small, large]), tokens.expand(2, *tokens.shape[1:]), valid)
    torch.testing.assert_close(both[:1, :, :2], alone, atol=1e-5, rtol=0)
    whole, order = logits_of(model, large, tokens), torch.tensor([3, 0, 5, 1, 4, 2])
    torch.testing.assert_close(both[1:], whole, atol=1e-5, rtol=0)
    shuffled = logits_of(model, keep_agents(large, order), tokens[:, :, order])
    torch.testing.assert_close(shuffled, whole[:, :, order], atol=1e-5, rtol=0)


@families
def test_a_scene_without_a_map_and_gradients_of_all_parameters(family: str, scene: Callable) -> None:
    model = make(family).train()
    tokens = tokens_for(model, 4)
    contexts = collate_contexts([make_context(scene(4), model.featurize)])
    model(contexts, tokens, torch.ones(1, 1, 4, 16, dtype=torch.bool)).square().mean().backward()
    without = [name for name, parameter in model.named_parameters() if parameter.grad is None]
    assert not without
    assert all(parameter.grad.isfinite().all() for parameter in model.parameters())
    empty = scene(2)
    empty.road.count[:] = 0
    assert logits_of(model.eval(), make_context(empty, model.featurize), tokens_for(model, 2)).isfinite().all()


@families
def test_rows_that_begin_again_have_no_past(family: str, scene: Callable) -> None:
    model, scenes = make(family), [scene(3, seed=1), scene(4, seed=2)]
    episode = EpisodeOptions(horizon=6)
    model.config = replace(model.config, horizon=6) if hasattr(model.config, "horizon") else model.config
    env = TransformedEnv(TrafficEnv(scenes, episode, num_scenes=2, num_rollouts=2), TokenAction(model.tokenizer))
    actor = MotionActor(model, Contexts(scenes, model.featurize, episode), num_rollouts=2)
    # Agents that take turns see what those before them chose, which two rollouts draw otherwise.
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        for _ in range(3):
            state = env.step(actor(state))["next"].exclude("reward")
        rows = torch.tensor([True, False, False, False])[:, None]
        again = env.reset(state.set("_reset", rows))
        logits = actor.decide(again.clone())[0].logits
        fresh = MotionActor(model, Contexts(scenes, model.featurize, episode), num_rollouts=2)
        expected = fresh.decide(env.reset())[0].logits
    torch.testing.assert_close(logits[0, :3], expected[0, :3], atol=1e-5, rtol=0)


@families
def test_rows_may_stand_at_different_decisions_of_scenes_of_different_size(family: str, scene: Callable) -> None:
    model, scenes = make(family), [scene(4, seed=1), scene(2, seed=2), scene(6, seed=3)]
    episode = EpisodeOptions(max_controlled=3)
    env = TrafficEnv(scenes, episode, num_scenes=2, num_rollouts=2, num_agents=6)
    env = TransformedEnv(env, TokenAction(model.tokenizer))
    actor = MotionActor(model, Contexts(scenes, model.featurize, episode), num_rollouts=2)
    state, steps = env.reset(), []
    # At 3 a row starts again; a group moves on at 6, from two agents to six, and at 9, to four; at 12 both do.
    alone, second, both = [True, False, False, False], [False, False, True, True], [True] * 4
    resets = {3: alone, 6: second, 9: second, 12: both}
    for step in range(15):
        if step in resets:
            state = env.reset(state.set("_reset", torch.tensor(resets[step])[:, None])).exclude("_reset")
        steps.append(env.step(actor(state)))
        state = steps[-1]["next"].exclude("reward", keys.REWARD)
    rolled = torch.stack(steps, 1)
    assert rolled[keys.SCENE][2:, ::3].tolist() == [[1, 1, 2, 0, 2]] * 2
    spans = ((0, 0, 3), (0, 3, 12), (1, 0, 12), (2, 0, 6), (2, 6, 9), (3, 9, 12), (1, 12, 15), (2, 12, 15))
    for row, first, last in spans:
        part = rolled[row : row + 1, first:last]
        played, controlled = [scenes[int(part[keys.SCENE][0, 0])]], part[keys.CONTROLLED].transpose(1, 2)
        expected = forced(model, played, episode, part)
        written = part[keys.LOG_PROB].transpose(1, 2)
        torch.testing.assert_close(written[controlled], expected[controlled], atol=1e-5, rtol=0)


if __name__ == "__main__":
    pytest.main([__file__])
