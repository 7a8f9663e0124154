"""What holds for every preference loss, whatever it makes of the scores."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from dpa.losses import Comparison, ContrastivePreferenceLoss, KahnemanTverskyLoss, PlackettLuceLoss, PreferenceLoss
from dpa.training.optim import accumulate_gradients
from tests.dpa.losses.by_hand import TOKENS_OF_A_ROLLOUT, VALID, divergence, log_likelihood, log_softmax

KINDS: dict[str, Callable[..., PreferenceLoss]] = {
    "logistic": ContrastivePreferenceLoss,
    "squared": lambda network, **options: ContrastivePreferenceLoss(network, link="squared", **options),
    "hinge": lambda network, **options: ContrastivePreferenceLoss(network, link="hinge", **options),
    "by agent": lambda network, **options: ContrastivePreferenceLoss(network, credit="agent", **options),
    "kto": lambda network, reference=True, **options: KahnemanTverskyLoss(network, **options),
    "listwise": PlackettLuceLoss,
}
REDUCTIONS = ("sum", "agent_mean", "token_mean")
pytestmark = pytest.mark.parametrize("kind", sorted(KINDS))


@pytest.fixture
def said(make_batch: Callable) -> TensorDict:
    """Two pairs, in which agents have their say too; one of them disagrees."""
    return make_batch().set("agent_preference", torch.tensor([[[1, 1], [1, -1]]]))


def gradient_of(loss: PreferenceLoss) -> Tensor:
    return loss.actor_network_params["module", "logits"].grad


@pytest.mark.parametrize("reference", [True, False])
def test_diagnostics_are_means_over_valid_tokens_of_a_scene(
    kind: str, network: tuple, said: TensorDict, trained: Callable, reference: bool
) -> None:
    actor, start = network
    loss = KINDS[kind](actor, reference=reference)
    now = trained(loss)
    out = loss(said)
    for side in ("preferred", "unpreferred"):
        expected = -sum(log_likelihood(now, tokens) for tokens in said[side][0]) / (2 * TOKENS_OF_A_ROLLOUT)
        assert out[f"nll_{side}"].item() == pytest.approx(expected, abs=1e-5)
    rows = [log_softmax(now[i, t].tolist()) for i, t in VALID]
    entropy = -sum(sum(x * torch.tensor(x).exp().item() for x in row) for row in rows) / len(VALID)
    assert out["entropy"].item() == pytest.approx(entropy, abs=1e-5)
    assert out["kl"].item() == pytest.approx(divergence(now, start) / len(VALID), abs=1e-5), "without reference too"


@pytest.mark.parametrize("reference", [True, False])
def test_out_keys_are_what_comes_out_and_only_losses_have_gradients(
    kind: str, network: tuple, said: TensorDict, reference: bool
) -> None:
    loss = KINDS[kind](network[0], reference=reference)
    out = loss(said)
    assert set(out.keys()) == set(loss.out_keys)
    assert {key for key in out.keys() if out[key].requires_grad} == {"loss_preference", "loss_cloning"}
    assert all(value.shape == () for value in out.values())


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_tokens_that_are_not_valid_do_not_matter(kind: str, network: tuple, said: TensorDict, reduction: str) -> None:
    loss = KINDS[kind](network[0], score_reduction=reduction, cloning=1.0)
    other = said.clone()
    for side in ("preferred", "unpreferred"):
        other[side][..., -1, 1:] = (other[side][..., -1, 1:] + 1) % 5
    assert (loss(said) == loss(other)).all()
    loss(said)["loss_preference"].backward()
    assert (gradient_of(loss)[-1, 1:] == 0).all()


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_a_step_makes_preferred_rollouts_likelier_and_unpreferred_ones_less_likely(
    kind: str, network: tuple, make_batch: Callable, reduction: str
) -> None:
    batch = make_batch(num=1).set("agent_preference", torch.ones(1, 1, 2, dtype=torch.int64))
    loss = KINDS[kind](network[0], score_reduction=reduction)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.2)
    before = loss(batch)
    before["loss_preference"].backward()
    optimizer.step()
    after = loss(batch)
    assert after["loss_preference"] < before["loss_preference"]
    assert after["nll_preferred"] < before["nll_preferred"]
    assert after["nll_unpreferred"] > before["nll_unpreferred"]
    assert after["kl"] > 0


@pytest.mark.parametrize("reduction", REDUCTIONS)
def test_a_step_is_the_same_however_its_scenes_are_split(
    kind: str, make_batch: Callable, reduction: str, split_network: Callable
) -> None:
    batch = make_batch(scenes=4, num=3)
    say = torch.randint(-1, 2, (4, 3, 2), generator=torch.Generator().manual_seed(5))
    say[2] = 0  # a scene in which nobody has a say
    batch["agent_preference"] = say
    batch["token_valid"][1, :, 0, 1:] = False  # scenes of unequal sizes
    found = []
    for parts in ([4], [1, 3], [1, 1, 2]):
        loss = split_network(KINDS[kind], alpha=0.7, score_reduction=reduction, cloning=0.1)
        figures = accumulate_gradients(loss, [(part, len(part) / 4) for part in batch.split(parts)])
        found.append((figures, gradient_of(loss).clone()))
    for figures, gradient in found[1:]:
        for name, value in figures.items():
            torch.testing.assert_close(value, found[0][0][name], atol=1e-5, rtol=1e-4, msg=name)
        torch.testing.assert_close(gradient, found[0][1], atol=1e-6, rtol=1e-4)
    assert found[0][0]["logit_std"] > 0.01


@pytest.fixture
def split_network(network: tuple, trained: Callable) -> Callable[..., PreferenceLoss]:
    """A loss away from its reference, always at the same place, without gradients."""

    def make(kind: Callable, **options: object) -> PreferenceLoss:
        with torch.no_grad():
            network[0].module.logits.copy_(network[1])
        loss = kind(network[0], **options)
        trained(loss)
        loss.zero_grad(set_to_none=True)
        return loss

    return make


def test_the_reference_stays_as_it_is_and_is_nothing_to_train(kind: str, network: tuple, said: TensorDict) -> None:
    actor, start = network
    loss = KINDS[kind](actor, reference=False, cloning=1.0)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.5)
    for _ in range(3):
        out = loss(said)
        (out["loss_preference"] + out["loss_cloning"]).backward()
        optimizer.step()
    assert torch.equal(loss.target_actor_network_params["module", "logits"], start)
    assert not torch.equal(loss.actor_network_params["module", "logits"], start)
    assert sum(parameter.requires_grad for parameter in loss.parameters()) == 1


def test_the_cloning_term_is_the_likelihood_of_the_preferred_rollouts(
    kind: str, network: tuple, said: TensorDict
) -> None:
    out = KINDS[kind](network[0], cloning=0.3)(said)
    assert out["loss_cloning"].item() == pytest.approx(0.3 * out["nll_preferred"].item(), abs=1e-6)


def test_keys_can_be_set_to_nested_ones(kind: str, network: tuple, said: TensorDict) -> None:
    loss = KINDS[kind](network[0])
    expected = loss(said)
    renamed = {name: ("data", "sides", name) for name in loss.in_keys}
    loss.set_keys(**renamed)
    assert loss.in_keys == list(renamed.values())
    nested = TensorDict({key: said[name] for name, key in renamed.items()}, batch_size=said.batch_size)
    assert (loss(nested) == expected).all()


def test_plain_tensors_can_be_given_instead_of_a_tensordict(kind: str, network: tuple, said: TensorDict) -> None:
    loss = KINDS[kind](network[0])
    expected = loss(said)
    values = loss(**{name: said[name] for name in loss.in_keys})
    for name, value in zip(loss.out_keys, values, strict=True):
        assert torch.equal(value, expected[name])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"alpha": 0.0}, "alpha must be positive, got 0.0"),
        ({"alpha": float("nan")}, "alpha must be positive, got nan"),
        ({"score_reduction": "mean"}, "'sum', 'agent_mean' or 'token_mean', got 'mean'"),
        ({"cloning": -0.1}, "cloning must not be negative, got -0.1"),
    ],
)
def test_options_outside_their_range_are_refused(
    kind: str, network: tuple[TensorDictModule, Tensor], options: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        KINDS[kind](network[0], **options)


class Distance(PreferenceLoss):
    """A loss of a user: preferred scores are drawn to 1."""

    sides = "sets"

    def compare(self, preferred: object, unpreferred: object, tensordict: TensorDict) -> Comparison:
        away = preferred.score - 1
        return Comparison(away**2, -away.detach(), -2 * away.detach())


def test_a_loss_of_ones_own_is_one_method(kind: str, network: tuple, make_batch: Callable) -> None:
    out = Distance(network[0])(make_batch(num=2, num_unpreferred=3))
    assert out["loss_preference"].item() == pytest.approx(1) and out["weight_mean"].item() == pytest.approx(2)
    assert 0 <= out["pair_accuracy"].item() <= 1
    with pytest.raises(TypeError, match="abstract"):
        PreferenceLoss(network[0])


if __name__ == "__main__":
    pytest.main([__file__])
