"""ImitationLoss: the loss of eq. 1, and the divergence from where the policy began, written out by hand."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from dpa.losses import ImitationLoss, NextTokenLoss, token_network
from dpa.losses.network import reference_logits
from dpa.models import make_context
from dpa.models.motionlm import SIZES, MotionLM, featurize
from dpa.tokens import VerletTokenizer
from dpa.training.batches import collate_items
from dpa.training.logs import log_item
from envs.sources.synthetic import straight_road


@pytest.fixture
def best(batch: TensorDict) -> TensorDict:
    """The preferred rollouts of the pairs as new labels."""
    return batch.select("context", "token_valid").set("tokens", batch["preferred"])


def test_what_is_minimised_is_the_loss_of_eq_1(network: tuple, best: TensorDict, trained: Callable) -> None:
    loss = ImitationLoss(network[0], label_smoothing=0.1)
    trained(loss)
    out = loss(best)
    plain = NextTokenLoss(loss.actor_network, label_smoothing=0.1)
    plain.actor_network_params.data.copy_(loss.actor_network_params.data)
    expected = plain(best)
    for name in plain.out_keys:
        assert torch.equal(out[name], expected[name])


def test_the_divergence_is_per_valid_token_from_where_the_policy_began(
    network: tuple, best: TensorDict, trained: Callable
) -> None:
    loss = ImitationLoss(network[0])
    assert loss(best)["kl"].item() == 0
    now, before = trained(loss).softmax(-1), network[1].softmax(-1)
    each = (now * (now / before).log()).sum(-1)
    by_hand = (each[0, 0] + each[0, 1] + each[0, 2] + each[1, 0]) / 4
    out = loss(best)
    assert out["kl"].item() == pytest.approx(by_hand.item(), abs=1e-6)
    assert not out["kl"].requires_grad


def test_the_copy_is_asked_without_dropout() -> None:
    model = MotionLM(dataclasses.replace(SIZES["nano"], dropout=0.5), VerletTokenizer()).train()
    loss = ImitationLoss(token_network(model))
    batch = collate_items([log_item(make_context(straight_road(2), featurize), VerletTokenizer())])
    with torch.no_grad():
        expected = model.eval()(batch["context"], batch["tokens"], batch["token_valid"])
    asked = reference_logits(loss, batch)
    assert torch.equal(asked, expected) and torch.equal(reference_logits(loss, batch), asked)
    assert loss.actor_network.training, "the policy keeps its dropout"


def test_a_policy_without_dropout_stays_without() -> None:
    model = MotionLM(dataclasses.replace(SIZES["nano"], dropout=0.5), VerletTokenizer()).eval()
    loss = ImitationLoss(token_network(model))
    batch = collate_items([log_item(make_context(straight_road(2), featurize), VerletTokenizer())])
    first, second = loss(batch), loss(batch)
    assert first["loss_next_token"] == second["loss_next_token"] and second["kl"] == 0
    assert not any(part.training for part in model.modules())


def test_the_copy_is_not_trained(network: tuple, best: TensorDict) -> None:
    loss = ImitationLoss(network[0])
    optimizer = torch.optim.SGD(loss.parameters(), lr=2.0)
    for _ in range(3):
        loss(best)["loss_next_token"].backward()
        optimizer.step()
        optimizer.zero_grad()
    assert loss(best)["kl"] > 0
    assert torch.equal(loss.target_actor_network_params["module", "logits"], network[1])


if __name__ == "__main__":
    pytest.main([__file__])
