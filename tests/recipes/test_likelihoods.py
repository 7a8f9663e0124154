"""What policies think of logs and ranked rollouts, against sums written out by hand."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn

from dpa.models import make_context
from dpa.models.behaviorgpt import BehaviorGPT
from dpa.models.distribution import TOKENS
from dpa.models.motionlm import MotionLM, SceneContext, featurize
from dpa.tokens import PatchTokenizer, VerletTokenizer
from envs.episode import EpisodeOptions
from envs.sources.synthetic import straight_road
from recipes.alignment.likelihoods import SIDED, Probe, divergence, probe, probe_sides

V = 4


class Steady(nn.Module):
    """The same distribution over tokens everywhere."""

    distribution = TOKENS

    def __init__(self, probabilities: list[float]) -> None:
        super().__init__()
        self.logits = torch.tensor(probabilities).log()

    def forward(self, context: SceneContext, tokens: Tensor, valid: Tensor) -> Tensor:
        return self.logits.expand(*tokens.shape, V)


def test_a_policy_is_asked_for_the_likelihood_of_logs_and_of_both_sides() -> None:
    probabilities = [0.5, 0.25, 0.125, 0.125]
    valid = torch.tensor([[True, True, True], [True, False, False]])
    asked = Probe(
        context=make_context(straight_road(2), featurize),
        demonstration=torch.tensor([[0, 1, 2], [3, 3, 3]]),
        demonstration_valid=torch.tensor([[True, True, True], [False, False, False]]),
        preferred=torch.tensor([[[0, 0, 0], [0, 3, 3]], [[2, 2, 2], [2, 0, 0]]]),
        unpreferred=torch.tensor([[[1, 1, 1], [1, 0, 0]], [[1, 1, 1], [1, 0, 0]]]),
        valid=valid,
    )
    reference = [0.25, 0.5, 0.125, 0.125]
    found = probe(Steady(probabilities), Steady(reference), [asked])[0]
    nats = [-math.log(p) for p in probabilities]
    assert found["pair_accuracy"] == 0.5  # 0s are likelier than 1s, and 2s are not
    assert found["reward_accuracy"] == 1  # since the reference 0s gained and 1s lost; 2s are as they were
    assert found["kl"] == pytest.approx(sum(p * math.log(p / q) for p, q in zip(probabilities, reference, strict=True)))
    assert found["nll_demonstration"] == pytest.approx((nats[0] + nats[1] + nats[2]) / 3)
    assert found["nll_preferred"] == pytest.approx((4 * nats[0] + 4 * nats[2]) / 8)
    assert found["nll_unpreferred"] == pytest.approx(nats[1])
    assert found["entropy"] == pytest.approx(sum(p * n for p, n in zip(probabilities, nats, strict=True)))


def test_sides_alone_are_what_the_whole_probe_says_of_them(model: MotionLM) -> None:
    draw = torch.Generator().manual_seed(0)
    near, far = (torch.randint(60, 110, (3, 2, 16), generator=draw) for _ in range(2))
    valid = torch.ones(2, 16, dtype=torch.bool)
    valid[1, 9:] = False
    asked = Probe(make_context(straight_road(2), featurize), near[0], valid, near, far, valid)
    (whole,), (sides,) = probe(model, model, [asked]), probe_sides(model, [asked])
    assert sides == {name: whole[name] for name in SIDED}


def test_densities_tell_no_likelier_rollout() -> None:
    """One that stands has a probability and one that moves a density; what is gained over a reference can be told."""
    model = BehaviorGPT("nano", PatchTokenizer()).eval()
    context = make_context(straight_road(2), model.featurize, EpisodeOptions(decision_steps=10, horizon=8))
    patches, valid = 0.1 * torch.randn(3, 2, 8, 30), torch.ones(2, 8, dtype=torch.bool)
    asked = Probe(context, patches[0], valid, patches[:1], torch.zeros_like(patches[:1]), valid)
    (found,), (sides,) = probe(model, model, [asked]), probe_sides(model, [asked])
    assert math.isnan(found["pair_accuracy"]) and math.isnan(sides["pair_accuracy"])
    assert found["reward_accuracy"] == 0.5 and math.isfinite(found["nll_preferred"])


def test_a_log_without_tokens_has_no_likelihood() -> None:
    tokens, nothing = torch.zeros(1, 1, 2, dtype=torch.int64), torch.zeros(1, 2, dtype=torch.bool)
    asked = Probe(make_context(straight_road(1), featurize), tokens[0], nothing, tokens, tokens + 1, ~nothing)
    policy = Steady([0.4, 0.3, 0.2, 0.1])
    found = probe(policy, policy, [asked])[0]
    assert math.isnan(found["nll_demonstration"]) and found["pair_accuracy"] == 1
    assert found["reward_accuracy"] == 0.5 and found["kl"] == 0, "what has learnt nothing gains nothing"


def test_a_scene_without_tokens_ranks_nothing() -> None:
    tokens, nothing = torch.zeros(1, 1, 2, dtype=torch.int64), torch.zeros(1, 2, dtype=torch.bool)
    asked = Probe(make_context(straight_road(1), featurize), tokens[0], ~nothing, tokens, tokens + 1, nothing)
    found = probe(Steady([0.4, 0.3, 0.2, 0.1]), Steady([0.4, 0.3, 0.2, 0.1]), [asked])[0]
    unknown = {name for name, value in found.items() if math.isnan(value)}
    assert unknown == {*SIDED, "reward_accuracy", "entropy", "kl"}


@pytest.fixture(scope="module")
def model() -> MotionLM:
    torch.manual_seed(0)
    return MotionLM("nano", VerletTokenizer()).eval()


def test_a_policy_does_not_diverge_from_itself(model: MotionLM) -> None:
    scenes = [straight_road(1), straight_road(3)]
    options = EpisodeOptions()
    same = divergence(model, model, scenes, options, num_rollouts=2, seed=0)
    assert same == pytest.approx([0, 0], abs=1e-6)


def test_divergence_is_that_of_the_distributions_along_the_models_own_rollouts(model: MotionLM) -> None:
    """With a head that forgets its input, every token has the same distribution, whatever was driven before."""
    steady = [copy.deepcopy(model) for _ in range(2)]
    generator = torch.Generator().manual_seed(0)
    biases = []
    for each in steady:
        head = [layer for layer in each.modules() if isinstance(layer, nn.Linear) and layer.out_features == 169][-1]
        with torch.no_grad():
            head.weight.zero_()
            head.bias.copy_(torch.randn(169, generator=generator))
        biases.append(head.bias.detach().double())
    p, q = (bias.log_softmax(-1) for bias in biases)
    expected = (p.exp() * (p - q)).sum().item()
    found = divergence(*steady, [straight_road(2)], EpisodeOptions(), num_rollouts=2, seed=0)
    assert found == pytest.approx([expected], abs=1e-5)


if __name__ == "__main__":
    pytest.main([__file__])
