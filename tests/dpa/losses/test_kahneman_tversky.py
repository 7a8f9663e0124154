"""KahnemanTverskyLoss written out by hand."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dpa.losses import KahnemanTverskyLoss, Side, token_network
from tests.dpa.losses.by_hand import SHARE, VALID, divergence, gain, log_likelihood, sigmoid
from tests.dpa.losses.conftest import table


@pytest.mark.parametrize("reduction", sorted(SHARE))
@pytest.mark.parametrize(("desirable", "undesirable"), [(1.0, 1.0), (1.3, 0.4)])
@pytest.mark.parametrize("sizes", [(2, 2), (1, 3), (3, 1)])
def test_each_rollout_is_compared_with_how_far_the_policy_has_moved_in_its_scene(
    network: tuple,
    make_batch: Callable,
    trained: Callable,
    reduction: str,
    desirable: float,
    undesirable: float,
    sizes: tuple[int, int],
) -> None:
    actor, start = network
    batch = make_batch(num=sizes[0], num_unpreferred=sizes[1])
    loss = KahnemanTverskyLoss(
        actor,
        alpha=0.5,
        score_reduction=reduction,
        desirable_weight=desirable,
        undesirable_weight=undesirable,
    )
    now = trained(loss)

    def score(tokens: Tensor) -> float:
        return 0.5 * SHARE[reduction] * gain(now, start, tokens)

    anchor = 0.5 * SHARE[reduction] * divergence(now, start)
    logits = [score(tokens) - anchor for tokens in batch["preferred"][0]]
    logits += [anchor - score(tokens) for tokens in batch["unpreferred"][0]]
    shares = [desirable] * sizes[0] + [undesirable] * sizes[1]
    costs = [share * sigmoid(-logit) for share, logit in zip(shares, logits, strict=True)]
    weights = [share * sigmoid(logit) * sigmoid(-logit) for share, logit in zip(shares, logits, strict=True)]
    out = loss(batch)
    assert out["loss_preference"].item() == pytest.approx(sum(costs) / sum(sizes), abs=1e-5)
    assert out["logit_mean"].item() == pytest.approx(sum(logits) / sum(sizes), abs=1e-5)
    assert out["weight_mean"].item() == pytest.approx(sum(weights) / sum(sizes), abs=1e-5)
    likelier = [
        log_likelihood(now, p) > log_likelihood(now, u) for p in batch["preferred"][0] for u in batch["unpreferred"][0]
    ]
    assert out["pair_accuracy"].item() == pytest.approx(sum(likelier) / len(likelier)), "every two of both sides"


def test_the_anchor_is_the_drift_of_both_sides() -> None:
    def side(drift: float) -> Side:
        one = torch.ones(1, 1, 1, 1)
        return Side(0 * one, drift * one, one.bool(), 1.0, "sum")

    found = KahnemanTverskyLoss(token_network(table())).compare(side(1.0), side(3.0), None)
    assert found.logit.tolist() == [[-2.0, 2.0]]


def test_the_anchor_has_no_gradient(network: tuple, make_batch: Callable, trained: Callable) -> None:
    actor, start = network
    batch, loss = make_batch(num=1), KahnemanTverskyLoss(actor, alpha=1.0, desirable_weight=2.0)
    now = trained(loss).requires_grad_()
    loss(batch)["loss_preference"].backward()
    anchor = divergence(now.detach(), start)

    def score(side: str) -> Tensor:
        tokens = batch[side][0, 0]
        ratios = now.log_softmax(-1) - start.log_softmax(-1)
        return sum(ratios[agent, step, tokens[agent, step]] for agent, step in VALID)

    desirable, undesirable = torch.sigmoid(anchor - score("preferred")), torch.sigmoid(score("unpreferred") - anchor)
    ((2 * desirable + undesirable) / 2).backward()
    torch.testing.assert_close(loss.actor_network_params["module", "logits"].grad, now.grad)


@pytest.mark.parametrize("name", ["desirable_weight", "undesirable_weight"])
def test_weights_must_be_positive(network: tuple, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive, got 0.0"):
        KahnemanTverskyLoss(network[0], **{name: 0.0})


if __name__ == "__main__":
    pytest.main([__file__])
