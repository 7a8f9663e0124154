"""ContrastivePreferenceLoss: eq. 4 written out by hand, and what it must not depend on."""

from __future__ import annotations

import copy
import math
import warnings

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from dpa.losses import ContrastivePreferenceLoss, token_network
from dpa.policy import MotionLM, collate_contexts, make_context
from dpa.tokens import VerletTokenizer
from dpa.training.checkpoint import capture
from envs.sources.synthetic import straight_road

REDUCTIONS = ("sum", "agent_mean", "token_mean")
VALID = [(0, 0), (0, 1), (0, 2), (1, 0)]
"""(agent, decision) of the batch's valid tokens."""
TOKENS_OF_A_ROLLOUT, AGENTS = len(VALID), 2


def log_likelihood(logits: Tensor, tokens: Tensor) -> float:
    """Of one rollout's valid tokens ``[A, T]``, one at a time."""
    total = 0.0
    for agent, step in VALID:
        row = logits[agent, step].tolist()
        total += row[tokens[agent, step]] - math.log(sum(math.exp(x) for x in row))
    return total


def by_hand(
    logits: Tensor, batch: TensorDict, *, alpha: float, conservative: float, reference: Tensor | None, reduction: str
) -> tuple[float, list[float]]:
    """The mean loss over pairs, and the logit of every pair."""
    share = {"sum": 1.0, "agent_mean": 1 / AGENTS, "token_mean": 1 / TOKENS_OF_A_ROLLOUT}[reduction]
    pairs = []
    for preferred, unpreferred in zip(batch["preferred"][0], batch["unpreferred"][0], strict=True):
        scores = []
        for tokens in (preferred, unpreferred):
            score = log_likelihood(logits, tokens)
            if reference is not None:
                score -= log_likelihood(reference, tokens)
            scores.append(alpha * share * score)
        pairs.append(scores[0] - conservative * scores[1])
    losses = [-math.log(1 / (1 + math.exp(-logit))) for logit in pairs]
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


def test_diagnostics_are_means_over_valid_tokens(network: tuple, batch: TensorDict) -> None:
    actor, logits = network
    out = ContrastivePreferenceLoss(actor)(batch)
    for name, side in zip(("nll_preferred", "nll_unpreferred"), sides(batch), strict=True):
        expected = -sum(log_likelihood(logits, tokens) for tokens in side) / (2 * TOKENS_OF_A_ROLLOUT)
        assert out[name].item() == pytest.approx(expected, abs=1e-5)
    probs = logits.softmax(-1)
    entropy = -(probs * probs.log()).sum(-1)
    assert out["entropy"].item() == pytest.approx(sum(entropy[a, t].item() for a, t in VALID) / len(VALID), abs=1e-5)


def test_the_divergence_is_measured_from_the_reference(network: tuple, batch: TensorDict) -> None:
    actor, start = network
    loss = ContrastivePreferenceLoss(actor)
    now = start + torch.randn(start.shape, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        loss.actor_network_params["module", "logits"].copy_(now)
    divergence = (now.softmax(-1) * (now.log_softmax(-1) - start.log_softmax(-1))).sum(-1)
    expected = sum(divergence[a, t].item() for a, t in VALID) / len(VALID)
    assert loss(batch)["kl"].item() == pytest.approx(expected, abs=1e-5)


def test_pairs_far_apart_are_saturated(network: tuple, batch: TensorDict) -> None:
    actor, logits = network
    out = ContrastivePreferenceLoss(actor, alpha=100.0, reference=False)(batch)
    _, pairs = by_hand(logits, batch, alpha=100.0, conservative=1.0, reference=None, reduction="sum")
    assert all(abs(logit) > math.log(99) for logit in pairs)
    assert out["saturated"].item() == 1


def test_the_cloning_term_is_the_likelihood_of_the_preferred_rollouts(network: tuple, batch: TensorDict) -> None:
    out = ContrastivePreferenceLoss(network[0], cloning=0.3)(batch)
    assert out["loss_cloning"].item() == pytest.approx(0.3 * out["nll_preferred"].item(), abs=1e-6)
    assert ContrastivePreferenceLoss(network[0])(batch)["loss_cloning"].item() == 0


@pytest.mark.parametrize("reference", [True, False])
@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_tokens_that_are_not_valid_do_not_matter(
    network: tuple, batch: TensorDict, reduction: str, reference: bool
) -> None:
    loss = ContrastivePreferenceLoss(network[0], reference=reference, score_reduction=reduction, cloning=1.0)
    other = batch.clone()
    for side in ("preferred", "unpreferred"):
        other[side][..., -1, 1:] = (other[side][..., -1, 1:] + 1) % 5
    assert (loss(batch) == loss(other)).all()
    loss(batch)["loss_preference"].backward()
    assert (loss.actor_network_params["module", "logits"].grad[-1, 1:] == 0).all()


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_a_step_makes_preferred_rollouts_likelier_and_unpreferred_ones_less_likely(
    network: tuple, batch: TensorDict, reduction: str
) -> None:
    loss = ContrastivePreferenceLoss(network[0], score_reduction=reduction)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.5)
    before = loss(batch)
    before["loss_preference"].backward()
    optimizer.step()
    after = loss(batch)
    assert after["loss_preference"] < before["loss_preference"]
    assert after["nll_preferred"] < before["nll_preferred"]
    assert after["nll_unpreferred"] > before["nll_unpreferred"]
    assert after["kl"] > 0


def test_the_reference_stays_as_it_is(network: tuple, batch: TensorDict) -> None:
    actor, start = network
    loss = ContrastivePreferenceLoss(actor, cloning=1.0)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.5)
    for _ in range(3):
        out = loss(batch)
        (out["loss_preference"] + out["loss_cloning"]).backward()
        optimizer.step()
    assert torch.equal(loss.target_actor_network_params["module", "logits"], start)
    assert not torch.equal(loss.actor_network_params["module", "logits"], start)


def test_a_frozen_reference_is_no_missing_update(network: tuple, batch: TensorDict) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss = ContrastivePreferenceLoss(network[0])
        loss(batch)
        assert loss.target_actor_network_params is not None


def test_the_reference_is_no_parameter_to_train(network: tuple) -> None:
    for reference in (True, False):
        loss = ContrastivePreferenceLoss(network[0], reference=reference)
        assert sum(parameter.requires_grad for parameter in loss.parameters()) == 1


# --- keys -----------------------------------------------------------------------------------------------------------
def test_keys_can_be_set_to_nested_ones(network: tuple, batch: TensorDict) -> None:
    loss = ContrastivePreferenceLoss(network[0])
    expected = loss(batch)
    renamed = {name: ("data", "pairs", name) for name in ("context", "preferred", "unpreferred", "token_valid")}
    nested = TensorDict({key: batch[name] for name, key in renamed.items()}, batch_size=batch.batch_size)
    loss.set_keys(**renamed)
    assert loss.in_keys == list(renamed.values())
    assert (loss(nested) == expected).all()


def test_a_key_that_does_not_exist_is_refused(network: tuple) -> None:
    with pytest.raises(ValueError, match="winner"):
        ContrastivePreferenceLoss(network[0]).set_keys(winner="preferred")


def test_plain_tensors_can_be_given_instead_of_a_tensordict(network: tuple, batch: TensorDict) -> None:
    loss = ContrastivePreferenceLoss(network[0])
    expected = loss(batch)
    values = loss(**{name: batch[name] for name in ("context", "preferred", "unpreferred", "token_valid")})
    assert len(values) == len(loss.out_keys)
    for name, value in zip(loss.out_keys, values, strict=True):
        assert torch.equal(value, expected[name])


@pytest.mark.parametrize("reference", [True, False])
def test_out_keys_are_what_comes_out(network: tuple, batch: TensorDict, reference: bool) -> None:
    loss = ContrastivePreferenceLoss(network[0], reference=reference)
    out = loss(batch)
    assert set(out.keys()) == set(loss.out_keys)
    assert {key for key in out.keys() if out[key].requires_grad} == {"loss_preference", "loss_cloning"}


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
            "context": collate_contexts([make_context(straight_road(2))]),
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
        ({"alpha": 0.0}, "alpha must be positive, got 0.0"),
        ({"conservative": 0.0}, r"lambda\) must lie in \(0, 1\], got 0.0"),
        ({"conservative": 1.5}, "got 1.5"),
        ({"score_reduction": "mean"}, "'sum', 'agent_mean' or 'token_mean', got 'mean'"),
        ({"cloning": -0.1}, "cloning must not be negative, got -0.1"),
    ],
)
def test_options_outside_their_range_are_refused(
    network: tuple[TensorDictModule, Tensor], options: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        ContrastivePreferenceLoss(network[0], **options)


if __name__ == "__main__":
    pytest.main([__file__])
