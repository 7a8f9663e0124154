"""Trajeglish: whose turn it is, what is known at a turn, and that what is sampled is the distribution of the model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dpa.models import Contexts, MotionActor, Observation, collate_contexts, make_context
from dpa.models.closest import ClosestActor
from dpa.models.context import keep_agents
from dpa.models.trajeglish import SIZES, Trajeglish, TrajeglishConfig, TrajeglishContext, featurize
from dpa.models.trajeglish.context import order_of, turns_of
from dpa.tokens import KDisksTokenizer, MotionTokenizer, TokenAction, VerletTokenizer
from dpa.training.logs import log_item
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import CURRENT_STEP, Scene
from envs.sources.synthetic import straight_road
from envs.traffic import TrafficEnv

TINY = TrajeglishConfig(width=24, heads=2, feed=48, encoder_layers=1, decoder_layers=2, past=3)


@pytest.fixture(autouse=True)
def _no_gradients() -> None:
    with torch.no_grad():
        yield


def policy(tokenizer: MotionTokenizer | None = None, config: TrajeglishConfig | str = TINY) -> Trajeglish:
    """A small one whose parameters are all non-zero."""
    torch.manual_seed(0)
    model = Trajeglish(config, tokenizer or VerletTokenizer()).eval()
    for parameter in model.parameters():
        parameter.add_(0.1 * torch.randn(parameter.shape))
    return model


def cars_at(*places: float, sdc: int = 0) -> Scene:
    """Cars in file that stand at these metres at the current step."""
    scene = straight_road(len(places))
    agents = scene.agents
    agents.position[..., 0] += (torch.tensor(places) - agents.position[:, CURRENT_STEP, 0])[:, None]
    agents.sdc = torch.arange(len(places)) == sdc
    return scene


def logits_of(
    model: Trajeglish, context: TrajeglishContext, tokens: Tensor, token_valid: Tensor | None = None
) -> Tensor:
    """``[M, A, T, V]``."""
    valid = torch.ones_like(tokens[:1], dtype=torch.bool) if token_valid is None else token_valid
    return model(collate_contexts([context]), tokens[None], valid[None])[0]


def some_tokens(agents: int, horizon: int = 16) -> Tensor:
    """``[1, A, T]``."""
    return torch.randint(60, 110, (1, agents, horizon), generator=torch.Generator().manual_seed(1))


# --- the order of turns ---------------------------------------------------------------------------------------------
def test_who_is_nearest_to_the_sdc_decides_first() -> None:
    context = make_context(cars_at(90.0, 30.0, 50.0, 0.0, sdc=2), featurize)  # 40, 20, 0 and 50 m away
    assert context.rank.tolist() == [2, 1, 0, 3]
    assert order_of(collate_contexts([context])).tolist() == [[2, 1, 0, 3]]


def test_of_two_at_the_same_distance_the_first_decides_first() -> None:
    context = make_context(cars_at(20.0, 0.0, 40.0, 20.5, sdc=0), featurize)
    assert order_of(collate_contexts([context])).tolist() == [[0, 3, 1, 2]]


def test_who_follows_its_log_takes_no_turn() -> None:
    scene = cars_at(0.0, 30.0, 20.0, 10.0)
    context = make_context(scene, featurize, EpisodeOptions(control=lambda scene: ~scene.agents.sdc))
    batch = collate_contexts([context, make_context(cars_at(0.0), featurize)])
    assert order_of(batch)[0].tolist() == [3, 2, 1, 0]
    assert turns_of(batch) == 3, "as many as the scene has that has most of them"


def test_without_the_sdc_the_others_keep_their_order() -> None:
    context = keep_agents(make_context(cars_at(0.0, 30.0, 20.0, 10.0), featurize), torch.tensor([1, 3]))
    batch = collate_contexts([context])
    assert order_of(batch).tolist() == [[1, 0]] and turns_of(batch) == 2


# --- what is known at a turn ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("agent", range(4))
def test_a_token_is_known_to_those_who_decide_later_and_to_nobody_before(agent: int) -> None:
    model, context = policy(), make_context(cars_at(0.0, 30.0, 10.0, -20.0), featurize)  # ranks 0, 3, 1, 2
    tokens = some_tokens(4)
    other = tokens.clone()
    other[:, agent, 6] = 13 * 12
    changed = (logits_of(model, context, tokens) != logits_of(model, context, other)).any(-1)[0]
    assert not changed[:, :6].any()
    assert torch.equal(changed[:, 6], context.rank > context.rank[agent])
    assert changed[:, 7].all(), "everybody knows at the next decision"


def test_agents_that_decide_apart_know_each_others_tokens_from_the_next_decision_on() -> None:
    model, context = policy(config=replace(TINY, joint=False)), make_context(cars_at(0.0, 30.0, 10.0), featurize)
    tokens = some_tokens(3)
    other = tokens.clone()
    other[:, 0, 6] = 13 * 12
    changed = (logits_of(model, context, tokens) != logits_of(model, context, other)).any(-1)[0]
    assert not changed[:, :7].any() and changed[:, 7].all()


def test_agents_that_decide_apart_do_so_in_rollouts_too() -> None:
    model, scene = policy(config=replace(TINY, joint=False)), cars_at(0.0, 30.0, 10.0, -20.0)
    env = TransformedEnv(TrafficEnv([scene], num_rollouts=2), TokenAction(model.tokenizer))
    rolled = env.rollout(16, MotionActor(model, Contexts([scene], model.featurize), num_rollouts=2))
    tokens = rolled[keys.TOKEN].transpose(1, 2)
    logits = logits_of(model, make_context(scene, featurize), tokens, torch.ones(1, 4, 16, dtype=torch.bool))
    forced = logits.log_softmax(-1).gather(-1, tokens[..., None])[..., 0]
    torch.testing.assert_close(rolled[keys.LOG_PROB].transpose(1, 2), forced, atol=1e-5, rtol=0)


def test_a_token_that_is_not_valid_is_known_to_nobody() -> None:
    model, context = policy(), make_context(cars_at(0.0, 10.0, 20.0), featurize)
    tokens, valid = some_tokens(3), torch.ones(1, 3, 16, dtype=torch.bool)
    valid[:, 0, 6:] = False
    other = tokens.clone()
    other[:, 0, 6:] = 13 * 12
    left, right = (logits_of(model, context, each, valid)[:, 1:] for each in (tokens, other))
    assert torch.equal(left, right)
    other[:, 0, 5] = 13 * 12
    assert (left != logits_of(model, context, other, valid)[:, 1:]).any(-1)[..., 5].all()


def test_tokens_of_who_follows_its_log_are_known_to_nobody_and_its_log_to_all() -> None:
    model, only = policy(), EpisodeOptions(control=lambda scene: ~scene.agents.sdc)
    context, tokens = make_context(cars_at(0.0, 10.0, 20.0), featurize, only), some_tokens(3)
    left = logits_of(model, context, tokens)
    other = tokens.clone()
    other[:, 0] = 13 * 12
    assert torch.equal(left[:, 1:], logits_of(model, context, other)[:, 1:])
    context.episode.logged[0, 40:, 1] += 2.0
    changed = (left != logits_of(model, context, tokens)).any(-1)[0, 1:]
    assert not changed[:, :9].any() and changed[:, 9].all()


# --- what is sampled ------------------------------------------------------------------------------------------------
def observed(context: TrajeglishContext, rollouts: int) -> Observation:
    """The first decision of some rollouts of each scene."""
    episode = context.episode
    each = [value.repeat_interleave(rollouts, 0) for value in (episode.recent, episode.kind, episode.valid)]
    recent, kind, valid = each
    return Observation(recent, torch.full_like(kind, 169), torch.zeros_like(kind[:, 0]), 0, kind, valid)


def test_pairs_of_tokens_are_as_frequent_as_the_joint_distribution_says() -> None:
    motions = torch.tensor([[0.0, 0.0, 0.0], [8.0, 3.0, 0.5], [3.0, -4.0, 0.0]]).view(1, 3, 1, 3).expand(5, 3, 5, 3)
    model, scene = policy(KDisksTokenizer.of(motions.clone())), cars_at(0.0, 6.0)
    model.decoder.agent_vicinity.out.weight *= 16  # where others stand matters
    model.decoder.head.weight *= -1.5  # in a way that moves probabilities
    options, rollouts = EpisodeOptions(horizon=1), 10_000
    pairs = torch.cartesian_prod(torch.arange(3), torch.arange(3))[..., None]  # [9, A, T]
    context = make_context(scene, model.featurize, options)
    log_probs = logits_of(model, context, pairs).log_softmax(-1).gather(-1, pairs[..., None])
    joint = log_probs.sum((1, 2, 3)).exp().view(3, 3)
    assert joint.sum() == pytest.approx(1.0, abs=1e-5)
    assert (joint - joint.sum(1, keepdim=True) * joint.sum(0)).abs().max() > 0.03, "the second goes by the first"
    env = TransformedEnv(TrafficEnv([scene], options, num_rollouts=rollouts), TokenAction(model.tokenizer))
    actor = MotionActor(model, Contexts([scene], model.featurize, options), num_rollouts=rollouts)
    first, second = actor(env.reset())[keys.TOKEN].unbind(-1)
    found = torch.bincount(3 * first + second, minlength=9).view(3, 3) / rollouts
    torch.testing.assert_close(found, joint, atol=0.015, rtol=0)


def test_agents_are_asked_one_by_one_in_their_order_and_padding_takes_no_part() -> None:
    model = policy()
    context = collate_contexts([make_context(each, featurize) for each in (cars_at(0.0, 30.0, 10.0), cars_at(0.0))])
    memory, asked = model.remember(), []
    memory.begin(context, 2, anew=True)

    def choose(logits: Tensor, agents: Tensor) -> Tensor:
        asked.append(agents[:, 0].tolist())
        return logits.argmax(-1)

    decision = memory.step(observed(context, 2), choose)
    assert [each[0] for each in asked] == [0, 2, 1]
    assert decision.token.shape == (4, 3) and decision.logits.shape == (4, 3, 169)
    for turn, each in enumerate(asked):
        assert decision.token[0, each[0]] == decision.logits[0, each[0]].argmax(), turn


def test_the_likeliest_tokens_are_those_of_one_pass() -> None:
    model, scene = policy(), straight_road(3, seed=1)
    env = TransformedEnv(TrafficEnv([scene]), TokenAction(model.tokenizer))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        tokens = env.rollout(16, MotionActor(model, Contexts([scene], model.featurize)))[keys.TOKEN].transpose(1, 2)
    assert torch.equal(logits_of(model, make_context(scene, featurize), tokens).argmax(-1), tokens)


def test_the_log_is_followed_by_the_tokens_of_the_log() -> None:
    """CAT-K: the candidates of an agent are those of its turn."""
    model, scene = policy(), straight_road(4, seed=3)
    env = TransformedEnv(TrafficEnv([scene]), TokenAction(model.tokenizer))
    rolled = env.rollout(16, ClosestActor(model, Contexts([scene], model.featurize), candidates=169))
    assert torch.equal(rolled[keys.TOKEN], rolled[keys.LABEL])
    assert torch.equal(rolled[keys.TOKEN][0].T, log_item(make_context(scene, featurize), model.tokenizer).tokens[0])
    few = env.rollout(16, ClosestActor(model, Contexts([scene], model.featurize), candidates=2))
    logits = logits_of(model, make_context(scene, featurize), few[keys.TOKEN].transpose(1, 2))
    likely = logits.topk(2).indices[0]  # [A, T, 2]
    assert (likely == few[keys.TOKEN][0].T[..., None]).any(-1).all()


# --- sizes and cost -------------------------------------------------------------------------------------------------
def parameters(model: Trajeglish) -> int:
    return sum(parameter.numel() for parameter in model.parameters())


def test_sizes_have_the_parameters_that_are_told() -> None:
    assert set(SIZES) == {"nano", "nano_apart", "35m"}
    assert parameters(Trajeglish("nano", VerletTokenizer())) == pytest.approx(0.15e6, rel=0.1)
    assert parameters(Trajeglish("35m", KDisksTokenizer(1, 384, "none"))) == pytest.approx(35e6, rel=0.1)


def test_the_size_of_the_paper_decides_ten_times_a_second() -> None:
    tokenizer = KDisksTokenizer.of(torch.rand(5, 384, 1, 3, generator=torch.Generator().manual_seed(0)))
    model, episode = Trajeglish("35m", tokenizer).eval(), EpisodeOptions(decision_steps=1, horizon=6)
    context = make_context(straight_road(2), model.featurize, episode)
    logits = logits_of(model, context, torch.randint(384, (1, 2, 6)))
    assert logits.shape == (1, 2, 6, 384) and logits.isfinite().all()


def test_an_unknown_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"one of \['35m', 'nano', 'nano_apart'\], got 'huge'"):
        Trajeglish("huge", VerletTokenizer())


def held(value: object) -> int:
    """Bytes of the tensors in nested tuples and lists."""
    if isinstance(value, Tensor):
        return value.numel() * value.element_size()
    return sum(map(held, value)) if isinstance(value, (tuple, list)) else 0


@pytest.mark.parametrize("size", sorted(SIZES))
def test_what_a_row_holds_is_what_the_planner_is_told(size: str) -> None:
    model, agents, rollouts = Trajeglish(size, VerletTokenizer()).eval(), 12, 4
    context = collate_contexts([make_context(straight_road(agents), model.featurize)])
    memory = model.remember()
    memory.begin(context, rollouts, anew=True)
    for _ in range(2):
        memory.step(observed(context, rollouts), lambda logits, agents: logits.argmax(-1))
    kept = held((memory._past, memory._layers, memory._agents, memory._nodes)) / (agents * rollouts)
    assert 0.5 * model.bytes_per_row() < kept < model.bytes_per_row()


def test_a_decision_costs_the_same_however_many_came_before(scene: Callable[..., Scene]) -> None:
    model = policy()
    context = collate_contexts([make_context(scene(3), model.featurize)])
    memory, sizes = model.remember(), []
    memory.begin(context, 2, anew=True)
    for step in range(6):
        seen = observed(context, 2)
        memory.step(seen._replace(step=seen.step + step, latest=step), lambda logits, agents: logits.argmax(-1))
        sizes.append(held((memory._past, memory._layers)))
    assert len(set(sizes)) == 1


if __name__ == "__main__":
    pytest.main([__file__])
