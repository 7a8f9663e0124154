"""ContrastivePreferenceLoss: eq. 4 written out by hand, and what it must not depend on."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from dpa.losses import ContrastivePreferenceLoss, token_network
from dpa.losses.contrastive import LINKS
from dpa.models import collate_contexts, make_context
from dpa.models.motionlm import MotionLM, featurize
from dpa.tokens import VerletTokenizer
from dpa.training.checkpoint import capture
from envs.sources.synthetic import straight_road
from tests.dpa.losses.by_hand import SHARE, TOKENS_OF_A_ROLLOUT, gain, log_likelihood, sigmoid

REDUCTIONS = ("sum", "agent_mean", "token_mean")


def by_hand(
    logits: Tensor, batch: TensorDict, *, alpha: float, conservative: float, reference: Tensor | None, reduction: str
) -> tuple[float, list[float]]:
    """The mean loss over pairs, and the logit of every pair."""
    pairs = []
    for preferred, unpreferred in zip(*sides(batch), strict=True):
        scores = [alpha * SHARE[reduction] * gain(logits, reference, tokens) for tokens in (preferred, unpreferred)]
        pairs.append(scores[0] - conservative * scores[1])
    losses = [-math.log(sigmoid(logit)) for logit in pairs]
    return sum(losses) / len(losses), pairs


@pytest.mark.parametrize("reduction", REDUCTIONS)
@pytest.mark.parametrize(("alpha", "conservative"), [(1.0, 1.0), (0.1, 1.0), (0.5, 0.5)])
@pytest.mark.parametrize("reference", [True, False])
def test_the_loss_is_equation_4(
    network: tuple, batch: TensorDict, reduction: str, alpha: float, conservative: float, reference: bool
) -> None:
    actor, start = network
    loss = ContrastivePreferenceLoss(
        actor, alpha=alpha, conservative=conservative, reference=reference, score_reduction=reduction
    )
    now = start + torch.randn(start.shape, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        loss.actor_network_params["module", "logits"].copy_(now)  # as after some training
    out = loss(batch)
    expected, logits = by_hand(
        now,
        batch,
        alpha=alpha,
        conservative=conservative,
        reference=start if reference else None,
        reduction=reduction,
    )
    assert out["loss_preference"].item() == pytest.approx(expected, abs=1e-5)
    assert out["logit_mean"].item() == pytest.approx(sum(logits) / 2, abs=1e-5)
    assert out["logit_std"].item() == pytest.approx(abs(logits[0] - logits[1]) / 2, abs=1e-5)
    weights = [1 / (1 + math.exp(logit)) for logit in logits]
    assert out["weight_mean"].item() == pytest.approx(sum(weights) / 2, abs=1e-5)
    assert out["weight_std"].item() == pytest.approx(abs(weights[0] - weights[1]) / 2, abs=1e-5)
    likelier = [log_likelihood(now, p) > log_likelihood(now, u) for p, u in zip(*sides(batch), strict=True)]
    assert out["pair_accuracy"].item() == pytest.approx(sum(likelier) / 2)


def sides(batch: TensorDict) -> tuple[Tensor, Tensor]:
    return batch["preferred"][0], batch["unpreferred"][0]


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_with_a_reference_every_pair_starts_with_the_same_weight(
    network: tuple, batch: TensorDict, reduction: str
) -> None:
    out = ContrastivePreferenceLoss(network[0], score_reduction=reduction)(batch)
    assert out["loss_preference"].item() == pytest.approx(math.log(2), abs=1e-6)
    assert out["weight_mean"].item() == pytest.approx(0.5, abs=1e-6)
    assert out["logit_std"].item() == pytest.approx(0, abs=1e-6)
    assert out["saturated"].item() == 0 and out["kl"].item() == pytest.approx(0, abs=1e-6)


def test_pairs_far_apart_are_saturated(network: tuple, batch: TensorDict) -> None:
    actor, logits = network
    out = ContrastivePreferenceLoss(actor, alpha=100.0, reference=False)(batch)
    _, pairs = by_hand(logits, batch, alpha=100.0, conservative=1.0, reference=None, reduction="sum")
    assert all(abs(logit) > math.log(99) for logit in pairs)
    assert out["saturated"].item() == 1


def test_a_frozen_reference_is_no_missing_update(network: tuple, batch: TensorDict) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss = ContrastivePreferenceLoss(network[0])
        loss(batch)
        assert loss.target_actor_network_params is not None


# --- links ----------------------------------------------------------------------------------------------------------
def logits_of(now: Tensor, start: Tensor | None, batch: TensorDict, alpha: float) -> list[float]:
    """Of the pairs, lambda 1, plain sums."""
    return by_hand(now, batch, alpha=alpha, conservative=1.0, reference=start, reduction="sum")[1]


def test_the_squared_link_is_ipo_up_to_a_factor(network: tuple, batch: TensorDict, trained: Callable) -> None:
    actor, start = network
    beta = 0.3
    loss = ContrastivePreferenceLoss(actor, link="squared", alpha=beta)
    now = trained(loss)
    gaps = [h / beta for h in logits_of(now, start, batch, beta)]  # of log ratios, as Azar et al. write them
    ipo = sum((gap - 1 / (2 * beta)) ** 2 for gap in gaps) / 2
    out = loss(batch)
    assert out["loss_preference"].item() == pytest.approx(beta**2 * ipo, rel=1e-5)
    assert out["weight_mean"].item() == pytest.approx(sum(1 - 2 * beta * gap for gap in gaps) / 2, abs=1e-5)


COSTS: dict[str, Callable[[float], float]] = {
    "logistic": lambda h: -math.log(sigmoid(h)),
    "squared": lambda h: (h - 0.5) ** 2,
    "hinge": lambda h: max(0.0, 1 - h),
}


@pytest.mark.parametrize("link", sorted(COSTS))
def test_label_smoothing_is_the_cost_with_some_pairs_the_wrong_way_round(
    network: tuple, batch: TensorDict, trained: Callable, link: str
) -> None:
    actor, start = network
    loss = ContrastivePreferenceLoss(actor, link=link, alpha=0.5, label_smoothing=0.2)
    logits = logits_of(trained(loss), start, batch, 0.5)
    expected = sum(0.8 * COSTS[link](h) + 0.2 * COSTS[link](-h) for h in logits) / 2
    assert loss(batch)["loss_preference"].item() == pytest.approx(expected, abs=1e-5)


def test_label_smoothing_is_conservative_dpo(network: tuple, batch: TensorDict, trained: Callable) -> None:
    actor, start = network
    loss = ContrastivePreferenceLoss(actor, alpha=0.5, label_smoothing=0.2)
    logits = logits_of(trained(loss), start, batch, 0.5)
    costs = [-0.8 * math.log(sigmoid(h)) - 0.2 * math.log(sigmoid(-h)) for h in logits]
    out = loss(batch)
    assert out["loss_preference"].item() == pytest.approx(sum(costs) / 2, abs=1e-5)
    assert out["weight_mean"].item() == pytest.approx(sum(sigmoid(-h) - 0.2 for h in logits) / 2, abs=1e-5)


def test_token_means_without_a_reference_and_a_margin_are_simpo(network: tuple, batch: TensorDict) -> None:
    actor, logits = network
    loss = ContrastivePreferenceLoss(actor, reference=False, score_reduction="token_mean", alpha=2.0, margin=0.7)
    costs = []
    for preferred, unpreferred in zip(*sides(batch), strict=True):
        per_token = [log_likelihood(logits, tokens) / TOKENS_OF_A_ROLLOUT for tokens in (preferred, unpreferred)]
        costs.append(-math.log(sigmoid(2.0 * (per_token[0] - per_token[1]) - 0.7)))
    assert loss(batch)["loss_preference"].item() == pytest.approx(sum(costs) / 2, abs=1e-5)


def test_the_hinge_pulls_only_those_that_are_not_ahead_by_one(
    network: tuple, batch: TensorDict, trained: Callable
) -> None:
    actor, start = network
    loss = ContrastivePreferenceLoss(actor, link="hinge", alpha=1.5)
    logits = logits_of(trained(loss), start, batch, 1.5)
    assert min(logits) < 1 < max(logits), "one on either side"
    out = loss(batch)
    assert out["loss_preference"].item() == pytest.approx(sum(max(0.0, 1 - h) for h in logits) / 2, abs=1e-5)
    assert out["weight_mean"].item() == 0.5


@pytest.mark.parametrize("link", sorted(LINKS))
def test_a_weight_is_the_slope_of_the_cost(link: str) -> None:
    logit = torch.linspace(-3, 3, 12, requires_grad=True)
    LINKS[link].cost(logit).sum().backward()
    torch.testing.assert_close(LINKS[link].weight(logit.detach()), -logit.grad)


def test_pairs_of_unequal_sides_are_refused(network: tuple, make_batch: Callable) -> None:
    with pytest.raises(ValueError, match="as many preferred as unpreferred rollouts of a scene, got 2 and 3"):
        ContrastivePreferenceLoss(network[0])(make_batch(num=2, num_unpreferred=3))


# --- credit by agent ------------------------------------------------------------------------------------------------
def by_agents(
    now: Tensor,
    start: Tensor | None,
    batch: TensorDict,
    say: list[list[int]],
    conservative: float = 1.0,
    margin: float = 0.0,
    share: tuple[float, ...] = (1.0, 1.0),
) -> list[float]:
    """What each pair costs with alpha 1: the mean over its agents that have a say; ``share`` of each one's sum."""
    costs = []
    for preferred, unpreferred, voices in zip(*sides(batch), say, strict=True):
        terms = []
        for agent, voice in enumerate(voices):
            better, worse = (preferred, unpreferred) if voice > 0 else (unpreferred, preferred)
            ahead = gain(now, start, better, agent) - conservative * gain(now, start, worse, agent)
            terms += [-math.log(sigmoid(share[agent] * ahead - margin))] if voice else []
        costs.append(sum(terms) / max(len(terms), 1))
    return costs


@pytest.mark.parametrize("conservative", [1.0, 0.5])
@pytest.mark.parametrize("say", [[[1, 1], [1, 1]], [[1, -1], [-1, 0]], [[0, 1], [0, 0]]])
def test_each_agent_is_compared_in_its_own_direction(
    network: tuple, batch: TensorDict, trained: Callable, say: list[list[int]], conservative: float
) -> None:
    actor, start = network
    loss = ContrastivePreferenceLoss(actor, credit="agent", alpha=1.0, conservative=conservative)
    now = trained(loss)
    out = loss(batch.set("agent_preference", torch.tensor([say])))
    expected = by_agents(now, start, batch, say, conservative)
    assert out["loss_preference"].item() == pytest.approx(sum(expected) / 2, abs=1e-5)


@pytest.mark.parametrize("reference", [True, False])
@pytest.mark.parametrize(
    ("reduction", "share"), [("sum", (1, 1)), ("agent_mean", (1, 1)), ("token_mean", (1 / 3, 1))]
)  # three decisions of the first agent count, one of the second
def test_an_agents_own_score_is_reduced_over_its_own_tokens(
    network: tuple, batch: TensorDict, trained: Callable, reduction: str, share: tuple[float, ...], reference: bool
) -> None:
    actor, start = network
    loss = ContrastivePreferenceLoss(
        actor, credit="agent", alpha=1.0, margin=0.3, reference=reference, score_reduction=reduction
    )
    now, say = trained(loss), [[1, -1], [-1, 0]]
    out = loss(batch.set("agent_preference", torch.tensor([say])))
    expected = by_agents(now, start if reference else None, batch, say, margin=0.3, share=share)
    assert out["loss_preference"].item() == pytest.approx(sum(expected) / 2, abs=1e-5)


def test_an_agent_without_a_say_gets_no_gradient(network: tuple, batch: TensorDict) -> None:
    loss = ContrastivePreferenceLoss(network[0], credit="agent")
    loss(batch.set("agent_preference", torch.tensor([[[0, 1], [0, -1]]])))["loss_preference"].backward()
    gradient = loss.actor_network_params["module", "logits"].grad
    assert (gradient[0] == 0).all() and (gradient[1, 0] != 0).any()


def test_where_nobody_has_a_say_nothing_is_learnt(network: tuple, batch: TensorDict) -> None:
    loss = ContrastivePreferenceLoss(network[0], credit="agent")
    out = loss(batch.set("agent_preference", torch.zeros(1, 2, 2, dtype=torch.int64)))
    out["loss_preference"].backward()
    assert out["loss_preference"].item() == 0 and out["logit_std"].item() == 0
    assert (loss.actor_network_params["module", "logits"].grad == 0).all()


def test_an_agent_without_tokens_has_no_say(network: tuple, batch: TensorDict) -> None:
    batch["token_valid"][:, :, 1] = False
    loss = ContrastivePreferenceLoss(network[0], credit="agent")
    outs = [loss(batch.set("agent_preference", torch.tensor([[[1, v], [1, v]]])))["loss_preference"] for v in (0, 1)]
    assert outs[0] == outs[1]


def test_agents_that_agree_with_a_pair_of_their_own_are_the_pair(network: tuple, batch: TensorDict) -> None:
    batch["token_valid"][:, :, 1] = False  # one agent: the scene is the agent
    whole = ContrastivePreferenceLoss(network[0], reference=False)(batch)
    alone = ContrastivePreferenceLoss(network[0], reference=False, credit="agent")(
        batch.set("agent_preference", torch.tensor([[[1, 0], [1, 0]]]))
    )
    assert alone["loss_preference"].item() == pytest.approx(whole["loss_preference"].item(), abs=1e-6)
    assert alone["logit_mean"].item() == pytest.approx(whole["logit_mean"].item(), abs=1e-6)


def test_credit_by_agent_without_preferences_of_agents_is_told(network: tuple, batch: TensorDict) -> None:
    with pytest.raises(ValueError, match="credit='agent' reads 'agent_preference', which the batch lacks"):
        ContrastivePreferenceLoss(network[0], credit="agent")(batch)


def test_preferences_of_agents_may_have_another_key(network: tuple, batch: TensorDict) -> None:
    loss, say = ContrastivePreferenceLoss(network[0], credit="agent"), torch.tensor([[[1, -1], [0, 1]]])
    expected = loss(batch.clone().set("agent_preference", say))
    loss.set_keys(agent_preference=("data", "say"))
    assert ("data", "say") in loss.in_keys
    assert (loss(batch.set(("data", "say"), say)) == expected).all()


# --- keys -----------------------------------------------------------------------------------------------------------
def test_a_key_that_does_not_exist_is_refused(network: tuple) -> None:
    with pytest.raises(ValueError, match="winner"):
        ContrastivePreferenceLoss(network[0]).set_keys(winner="preferred")


def test_the_input_stays_as_it_is(network: tuple, batch: TensorDict) -> None:
    before = batch.clone()
    ContrastivePreferenceLoss(network[0])(batch)
    assert set(batch.keys()) == set(before.keys()) and (batch == before).all()


# --- with the model -------------------------------------------------------------------------------------------------
def test_it_trains_a_motion_model() -> None:
    torch.manual_seed(0)
    model = MotionLM("nano", VerletTokenizer())
    loss = ContrastivePreferenceLoss(token_network(model))
    optimizer = torch.optim.AdamW(model.parameters(), lr=1e-3)
    generator = torch.Generator().manual_seed(0)
    rollouts = torch.randint(60, 100, (2, 1, 4, 2, 16), generator=generator)
    batch = TensorDict(
        {
            "context": collate_contexts([make_context(straight_road(2), featurize)]),
            "preferred": rollouts[0],
            "unpreferred": rollouts[1],
            "token_valid": torch.ones(1, 1, 2, 16, dtype=torch.bool),
        },
        batch_size=[1],
    )
    before = copy.deepcopy(capture({"model": model})["parts"]["model"])
    for _ in range(4):
        out = loss(batch)
        out["loss_preference"].backward()
        optimizer.step()
        optimizer.zero_grad()
    assert loss(batch)["loss_preference"] < math.log(2)
    assert any(not torch.equal(before[name], value) for name, value in model.state_dict().items()), "the model itself"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"conservative": 0.0}, r"lambda\) must lie in \(0, 1\], got 0.0"),
        ({"conservative": 1.5}, "got 1.5"),
        ({"link": "cubic"}, "link must be 'logistic', 'squared' or 'hinge', got 'cubic'"),
        ({"credit": "step"}, "credit must be 'scene' or 'agent', got 'step'"),
        ({"margin": -1.0}, "margin must not be negative, got -1.0"),
        ({"label_smoothing": 0.5}, r"label_smoothing must lie in \[0, 0.5\), got 0.5"),
        ({"label_smoothing": -0.1}, "got -0.1"),
    ],
)
def test_options_outside_their_range_are_refused(
    network: tuple[TensorDictModule, Tensor], options: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        ContrastivePreferenceLoss(network[0], **options)


if __name__ == "__main__":
    pytest.main([__file__])
