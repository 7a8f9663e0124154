"""PolicyGradientLoss: REINFORCE and PPO's surrogate written out by hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import LossModule

from dpa.losses import PolicyGradientLoss, token_network
from dpa.models import collate_contexts, make_context
from dpa.models.motionlm import MotionLM, featurize
from dpa.tokens import VerletTokenizer
from envs.sources.synthetic import straight_road

VALID = [(0, 0), (0, 1), (0, 2), (1, 0)]
"""Agents and decisions whose tokens count, of the scene of the fixture."""
ADVANTAGE = [[1.5, -0.5], [-1.5, 0.5]]
"""Of two rollouts and their two agents."""


@pytest.fixture
def groups(batch: TensorDict) -> TensorDict:
    """Two rollouts of a scene with advantages of each agent, drawn by a policy to which all tokens are alike."""
    found = batch.select("context", "token_valid").set("tokens", batch["preferred"][:, :2])
    agents = found["tokens"].shape[2]
    advantage = torch.zeros(1, 2, agents, 1)
    advantage[0, :, :2, 0] = torch.tensor(ADVANTAGE)
    found["advantage"] = advantage
    return found.set("sample_log_prob", torch.full(found["tokens"].shape, -math.log(5.0)))


def likelihoods(logits: torch.Tensor, tokens: torch.Tensor) -> list[list[float]]:
    """Log-probabilities of each rollout's valid tokens."""
    log_probs = logits.log_softmax(-1)
    return [[log_probs[a, t, rollout[a, t]].item() for a, t in VALID] for rollout in tokens[0]]


def test_without_a_clip_it_is_minus_advantage_times_log_likelihood(network: tuple, groups: TensorDict) -> None:
    actor, logits = network
    found = PolicyGradientLoss(actor)(groups)
    each = [
        -ADVANTAGE[k][agent] * likely
        for k, row in enumerate(likelihoods(logits, groups["tokens"]))
        for (agent, _), likely in zip(VALID, row, strict=True)
    ]
    assert found["loss_objective"].item() == pytest.approx(sum(each) / len(each), abs=1e-5)
    assert found["kl"].item() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("clip", [0.05, 0.2, 10.0])
def test_with_a_clip_it_is_the_surrogate_of_ppo(network: tuple, groups: TensorDict, clip: float) -> None:
    actor, logits = network
    found = PolicyGradientLoss(actor, clip=clip)(groups)
    costs, held = [], []
    for k, row in enumerate(likelihoods(logits, groups["tokens"])):
        for (agent, _), likely in zip(VALID, row, strict=True):
            ratio, advantage = 5 * math.exp(likely), ADVANTAGE[k][agent]
            clipped = advantage * min(max(ratio, 1 - clip), 1 + clip)
            costs.append(-min(ratio * advantage, clipped))
            held.append(clipped < ratio * advantage)
    assert found["loss_objective"].item() == pytest.approx(sum(costs) / len(costs), abs=1e-5)
    assert found["clip_fraction"].item() == pytest.approx(sum(held) / len(held))


def test_divergence_and_entropy_are_sums_over_the_vocabulary(
    network: tuple, groups: TensorDict, trained: Callable[[LossModule], torch.Tensor]
) -> None:
    actor, before = network
    loss = PolicyGradientLoss(actor, kl=0.3, entropy=0.02)
    now = trained(loss).log_softmax(-1)
    drift, entropy = [], []
    for place in VALID:
        ours, theirs = now[place].tolist(), before.log_softmax(-1)[place].tolist()
        drift.append(sum(math.exp(p) * (p - q) for p, q in zip(ours, theirs, strict=True)))
        entropy.append(-sum(math.exp(p) * p for p in ours))
    found = loss(groups)
    assert found["kl"].item() == pytest.approx(sum(drift) / len(drift), abs=1e-5)
    assert found["entropy"].item() == pytest.approx(sum(entropy) / len(entropy), abs=1e-5)
    assert found["loss_kl_to_ref"].item() == pytest.approx(0.3 * sum(drift) / len(drift), abs=1e-5)
    assert found["loss_entropy"].item() == pytest.approx(-0.02 * sum(entropy) / len(entropy), abs=1e-5)


@pytest.fixture
def drawn() -> TensorDict:
    """Four rollouts of a scene of two agents."""
    generator = torch.Generator().manual_seed(0)
    tokens = torch.randint(169, (1, 4, 2, 16), generator=generator)
    return TensorDict(
        {
            "context": collate_contexts([make_context(straight_road(2), featurize)]),
            "tokens": tokens,
            "token_valid": torch.ones(1, 1, 2, 16, dtype=torch.bool),
            "advantage": torch.tensor([1.0, -1.0, 0.5, -0.5])[None, :, None, None],
        },
        batch_size=[1],
    )


def model_of(seed: int) -> MotionLM:
    torch.manual_seed(seed)
    return MotionLM("nano", VerletTokenizer())


def gradients(model: MotionLM, loss: PolicyGradientLoss, batch: TensorDict) -> dict[str, torch.Tensor]:
    model.zero_grad()
    out = loss(batch)
    sum(value for key, value in out.items() if key.startswith("loss_")).backward()
    return {name: value.grad.clone() for name, value in model.named_parameters() if value.grad is not None}


def test_in_the_first_pass_both_forms_have_the_same_gradient(drawn: TensorDict) -> None:
    model = model_of(0)
    logits = model(drawn["context"], drawn["tokens"], drawn["token_valid"])
    drawn["sample_log_prob"] = logits.log_softmax(-1).gather(-1, drawn["tokens"][..., None])[..., 0].detach()
    free, clipped = (
        gradients(model, PolicyGradientLoss(token_network(model), clip=clip), drawn) for clip in (None, 0.2)
    )
    assert free and all(torch.allclose(value, clipped[name], atol=1e-6) for name, value in free.items())


def test_a_step_makes_good_rollouts_likelier_and_bad_ones_less_likely(drawn: TensorDict) -> None:
    model = model_of(0)
    loss = PolicyGradientLoss(token_network(model))

    def likelihood() -> torch.Tensor:
        logits = model(drawn["context"], drawn["tokens"], drawn["token_valid"])
        return logits.log_softmax(-1).gather(-1, drawn["tokens"][..., None]).sum((0, 2, 3, 4))

    before = likelihood().detach()
    optimizer = torch.optim.SGD(model.parameters(), 0.05)
    loss(drawn)["loss_objective"].backward()
    optimizer.step()
    gained = (likelihood() - before).tolist()
    assert gained[0] > 0 > gained[1] and gained[0] > gained[2] > gained[3] > gained[1]


def test_the_divergence_pulls_back_to_the_reference_and_entropy_flattens(drawn: TensorDict) -> None:
    model = model_of(0)
    drawn["advantage"] = torch.zeros_like(drawn["advantage"])
    loss = PolicyGradientLoss(token_network(model), kl=1.0)
    with torch.no_grad():
        for value in model.decoder.head.parameters():
            value.add_(0.1 * torch.randn_like(value))
    away = loss(drawn)["kl"].item()
    optimizer = torch.optim.SGD(model.parameters(), 0.05)
    gradients(model, loss, drawn)
    optimizer.step()
    assert 0 < loss(drawn)["kl"].item() < away
    flat = PolicyGradientLoss(token_network(model), entropy=1.0)
    before = flat(drawn)["entropy"].item()
    gradients(model, flat, drawn)
    optimizer.step()
    assert flat(drawn)["entropy"].item() > before


@pytest.mark.parametrize("options", [{"clip": 0.0}, {"kl": -1.0}, {"entropy": -0.1}])
def test_options_outside_their_range_are_refused(options: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        PolicyGradientLoss(token_network(model_of(0)), **options)


if __name__ == "__main__":
    pytest.main([__file__])
