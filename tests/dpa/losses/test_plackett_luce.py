"""PlackettLuceLoss: the probability of a ranking written out by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pytest
import torch

from dpa.losses import ContrastivePreferenceLoss, PlackettLuceLoss
from tests.dpa.losses.by_hand import SHARE, gain


def probability(scores: list[float]) -> float:
    """Of choosing items in this order, each with a probability in proportion to exp(score) among those left."""
    total = 1.0
    for k in range(len(scores)):
        total *= math.exp(scores[k]) / sum(math.exp(score) for score in scores[k:])
    return total


def test_probabilities_of_all_orders_sum_to_one() -> None:
    assert sum(probability(list(order)) for order in itertools.permutations([0.3, -1.0, 2.0])) == pytest.approx(1)


@pytest.mark.parametrize("reduction", sorted(SHARE))
@pytest.mark.parametrize("reference", [True, False])
@pytest.mark.parametrize("sizes", [(1, 1), (2, 2), (3, 1), (2, 3)])
def test_the_loss_is_the_likelihood_of_the_ranking_per_choice(
    network: tuple, make_batch: Callable, trained: Callable, reduction: str, reference: bool, sizes: tuple[int, int]
) -> None:
    actor, start = network
    batch = make_batch(num=sizes[0], num_unpreferred=sizes[1])
    loss = PlackettLuceLoss(actor, alpha=0.5, reference=reference, score_reduction=reduction)
    now = trained(loss)
    ranking = [*batch["preferred"][0], *batch["unpreferred"][0]]
    scores = [0.5 * SHARE[reduction] * gain(now, start if reference else None, tokens) for tokens in ranking]
    expected = -math.log(probability(scores)) / (sum(sizes) - 1)
    assert loss(batch)["loss_preference"].item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("reference", [True, False])
def test_a_ranking_of_two_is_a_pair(network: tuple, make_batch: Callable, trained: Callable, reference: bool) -> None:
    batch, found = make_batch(num=1), []
    for kind in (PlackettLuceLoss, ContrastivePreferenceLoss):
        with torch.no_grad():
            network[0].module.logits.copy_(network[1])
        loss = kind(network[0], reference=reference, cloning=0.2)
        trained(loss)
        found.append(loss(batch))
    for name in found[0].keys():
        torch.testing.assert_close(found[0][name], found[1][name], msg=name)


if __name__ == "__main__":
    pytest.main([__file__])
