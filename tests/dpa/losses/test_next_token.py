"""NextTokenLoss: eq. 1 written out by hand."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from dpa.losses import NextTokenLoss, token_network
from dpa.models import collate_contexts, make_context
from dpa.models.motionlm import MotionLM, featurize
from dpa.tokens import VerletTokenizer
from envs.sources.synthetic import straight_road
from tests.dpa.losses.conftest import pairs, table

VALID = [(0, 0), (0, 1), (0, 2), (1, 0)]


@pytest.fixture
def logs(batch: TensorDict) -> TensorDict:
    """The preferred rollouts of the pairs as the tokens to learn."""
    return batch.select("context", "token_valid").set("tokens", batch["preferred"])


def by_hand(logits: torch.Tensor, tokens: torch.Tensor, smoothing: float) -> float:
    """Mean over two rollouts and their valid tokens of the cross entropy with a smoothed target."""
    losses = []
    for rollout in tokens[0]:
        for agent, step in VALID:
            row = logits[agent, step].tolist()
            log_sum = math.log(sum(math.exp(x) for x in row))
            target = [smoothing / len(row)] * len(row)
            target[rollout[agent, step]] += 1 - smoothing
            losses.append(-sum(share * (x - log_sum) for share, x in zip(target, row, strict=True)))
    return sum(losses) / len(losses)


@pytest.mark.parametrize("smoothing", [0.0, 0.2])
def test_the_loss_is_the_cross_entropy_per_valid_token(network: tuple, logs: TensorDict, smoothing: float) -> None:
    actor, logits = network
    loss = NextTokenLoss(actor, label_smoothing=smoothing)(logs)["loss_next_token"]
    assert loss.item() == pytest.approx(by_hand(logits, logs["tokens"], smoothing), abs=1e-5)


def test_accuracy_and_entropy_are_means_over_valid_tokens(network: tuple, logs: TensorDict) -> None:
    actor, logits = network
    out = NextTokenLoss(actor)(logs)
    best = logits.argmax(-1)
    hits = [float(rollout[a, t] == best[a, t]) for rollout in logs["tokens"][0] for a, t in VALID]
    assert out["accuracy"].item() == pytest.approx(sum(hits) / len(hits))
    probs = logits.softmax(-1)
    entropy = -(probs * probs.log()).sum(-1)
    assert out["entropy"].item() == pytest.approx(sum(entropy[a, t].item() for a, t in VALID) / 4, abs=1e-5)
    assert not out["accuracy"].requires_grad and not out["entropy"].requires_grad


def test_tokens_that_are_not_valid_do_not_matter(network: tuple, logs: TensorDict) -> None:
    loss = NextTokenLoss(network[0], label_smoothing=0.1)
    other = logs.clone()
    other["tokens"][..., -1, 1:] = (other["tokens"][..., -1, 1:] + 1) % 5
    assert (loss(logs) == loss(other)).all()
    loss(logs)["loss_next_token"].backward()
    assert (loss.actor_network_params["module", "logits"].grad[-1, 1:] == 0).all()


def test_labels_may_be_other_tokens_than_those_that_are_read(network: tuple, logs: TensorDict) -> None:
    actor, logits = network
    labels = (logs["tokens"] + 2) % 5
    loss = NextTokenLoss(actor)
    loss.set_keys(labels="labels")
    out = loss(logs.set("labels", labels))
    assert out["loss_next_token"].item() == pytest.approx(by_hand(logits, labels, 0.0), abs=1e-5)
    expected = NextTokenLoss(actor)(logs.clone().set("tokens", labels))
    assert torch.equal(out["accuracy"], expected["accuracy"])


def test_no_valid_token_is_no_loss(network: tuple, logs: TensorDict) -> None:
    logs["token_valid"] = torch.zeros_like(logs["token_valid"])
    assert NextTokenLoss(network[0])(logs)["loss_next_token"].item() == 0


def test_training_makes_the_tokens_likely(network: tuple, logs: TensorDict) -> None:
    loss = NextTokenLoss(network[0])
    logs["tokens"] = logs["tokens"][:, :1]
    optimizer = torch.optim.SGD(loss.parameters(), lr=2.0)
    for _ in range(60):
        loss(logs)["loss_next_token"].backward()
        optimizer.step()
        optimizer.zero_grad()
    out = loss(logs)
    assert out["loss_next_token"] < 0.2 and out["accuracy"] == 1


def test_keys_can_be_set_to_nested_ones(network: tuple, logs: TensorDict) -> None:
    loss = NextTokenLoss(network[0])
    expected = loss(logs)
    renamed = {name: ("data", name) for name in ("context", "tokens", "token_valid")}
    loss.set_keys(**renamed, labels=renamed["tokens"], learnt=renamed["token_valid"])
    assert loss.in_keys == list(renamed.values())
    nested = TensorDict({key: logs[name] for name, key in renamed.items()}, batch_size=logs.batch_size)
    assert (loss(nested) == expected).all()
    alone = NextTokenLoss(network[0])
    alone.set_keys(**renamed)
    assert alone.in_keys == loss.in_keys, "labels are the tokens themselves by default, wherever these lie"
    assert (alone(nested) == expected).all()
    with pytest.raises(ValueError, match="targets"):
        loss.set_keys(targets="tokens")


def test_only_labels_that_are_to_be_learnt_count() -> None:
    batch = pairs().select("context", "token_valid").set("tokens", pairs()["preferred"])
    learnt = batch["token_valid"].clone()
    learnt[..., 0, 1:] = False
    loss = NextTokenLoss(token_network(table()))
    loss.set_keys(learnt="learnt")
    loss(batch.set("learnt", learnt))["loss_next_token"].backward()
    gradient = loss.actor_network_params["module", "logits"].grad
    assert (gradient[0, 1:] == 0).all() and (gradient[0, 0] != 0).any()


def test_plain_tensors_can_be_given_instead_of_a_tensordict(network: tuple, logs: TensorDict) -> None:
    loss = NextTokenLoss(network[0])
    expected = loss(logs)
    values = loss(context=logs["context"], tokens=logs["tokens"], token_valid=logs["token_valid"])
    for name, value in zip(loss.out_keys, values, strict=True):
        assert torch.equal(value, expected[name])


@pytest.mark.parametrize("smoothing", [-0.1, 1.0])
def test_a_smoothing_outside_its_range_is_refused(network: tuple, smoothing: float) -> None:
    with pytest.raises(ValueError, match=rf"\[0, 1\), got {smoothing}"):
        NextTokenLoss(network[0], label_smoothing=smoothing)


if __name__ == "__main__":
    pytest.main([__file__])


# --- linear layers in bfloat16 --------------------------------------------------------------------------------------
@pytest.fixture
def road() -> TensorDict:
    """One scene with random tokens."""
    return TensorDict(
        {
            "context": collate_contexts([make_context(straight_road(3), featurize)]),
            "tokens": torch.randint(169, (1, 2, 3, 16), generator=torch.Generator().manual_seed(0)),
            "token_valid": torch.ones(1, 1, 3, 16, dtype=torch.bool),
        },
        batch_size=[1],
    )


def learnt(model: MotionLM, road: TensorDict, precision: str) -> tuple[float, torch.Tensor]:
    """The loss, and all gradients in one row."""
    model.zero_grad()
    loss = NextTokenLoss(token_network(model, precision))(road)["loss_next_token"]
    loss.backward()
    return loss.item(), torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None])


def test_bfloat16_layers_give_nearly_the_same_loss_and_gradients_in_float32(road: TensorDict) -> None:
    torch.manual_seed(0)
    model = MotionLM("nano", VerletTokenizer())
    (exact, gradients), (rounded, others) = (learnt(model, road, precision) for precision in ("float32", "bfloat16"))
    assert exact != rounded == pytest.approx(exact, rel=1e-3)
    assert others.dtype == torch.float32
    assert torch.nn.functional.cosine_similarity(gradients, others, dim=0) > 0.999


def test_the_logits_of_bfloat16_layers_are_float32(road: TensorDict) -> None:
    assert token_network(MotionLM("nano", VerletTokenizer()), "bfloat16")(road)["logits"].dtype == torch.float32


def test_an_unknown_precision_is_refused() -> None:
    with pytest.raises(ValueError, match="precision must be one of float32, bfloat16, got 'float8'"):
        token_network(MotionLM("nano", VerletTokenizer()), "float8")
