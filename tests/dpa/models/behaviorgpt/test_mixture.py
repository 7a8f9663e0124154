"""The density of patches: what it says is what it draws, and what scipy says."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from torch import Tensor

from dpa.models import Decoding
from dpa.models.behaviorgpt.mixture import (
    CONCENTRATION,
    UNIT,
    Mixture,
    PatchMixture,
    _changes,
    _log_bessel,
    _mises,
    _poses,
)
from dpa.models.registry import build_model, size_of
from dpa.tokens import PatchTokenizer, VerletTokenizer

WHOLE = Decoding(top_p=1.0)


def numbers(modes: int, frames: int, seed: int = 0, still: float = 0.5) -> Tensor:
    """A row of modes, and standing still with this logit."""
    generator = torch.Generator().manual_seed(seed)
    logits = torch.randn(modes * (1 + 6 * frames) + 1, generator=generator, dtype=torch.float64)
    logits[-1:] *= 0.1
    return torch.cat((logits[:modes], torch.tensor([still], dtype=torch.float64), logits[modes:]))


def many(mixture: PatchMixture, logits: Tensor, count: int, decoding: Decoding = WHOLE) -> tuple[Tensor, Tensor]:
    uniform = torch.rand(count, mixture.numbers, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return mixture.draw(logits.expand(count, -1), uniform, decoding)


def test_one_mode_and_frame_is_what_scipy_says() -> None:
    logits = torch.tensor(
        [0.3, 0.3 - math.log(3), 0.1 / UNIT, -0.2 / UNIT, 0.05 / UNIT, -1.0, -2.0, 3.0, 0.4], dtype=torch.float64
    )
    patch = torch.tensor([0.6, -0.1, 0.2], dtype=torch.float64)
    said = Mixture.of(logits, 1)
    along, across = said.scale[0, 0].tolist()
    assert (along, across) == pytest.approx((math.log1p(math.exp(-1.0)) + 0.001, math.log1p(math.exp(-2.0)) + 0.001))
    forwards, left = (0.6 * math.cos(0.1) - 0.1 * math.sin(0.1), -0.1 * math.cos(0.1) - 0.6 * math.sin(0.1))
    expected = (
        math.log(0.75)  # a quarter stands
        + stats.laplace.logpdf(forwards - 0.4, 0.1, along)  # the agent moved by 0.4 m in the step before
        + stats.laplace.logpdf(left, -0.2, across)
        + stats.vonmises.logpdf(0.2, math.exp(3.0) + CONCENTRATION[0], loc=0.05)
    )
    assert PatchMixture(1).log_prob(logits, patch).item() == pytest.approx(expected, abs=1e-9)
    assert PatchMixture(1).log_prob(logits, 0 * patch).exp().item() == pytest.approx(0.25)


def test_it_integrates_to_one_together_with_standing_still() -> None:
    mixture, logits = PatchMixture(1), numbers(3, 1, seed=2)
    logits[4:-1].view(3, 1, 6)[..., 3:5] = 1.0  # wider than the grid
    grid = torch.linspace(-12, 12, 241, dtype=torch.float64)
    angle = torch.linspace(-math.pi, math.pi, 101, dtype=torch.float64)[:-1]
    patches = torch.cartesian_prod(grid, grid, angle)
    density = mixture.log_prob(logits, patches + 1e-9).exp()
    still = mixture.log_prob(logits, torch.zeros(3, dtype=torch.float64)).exp()
    assert (density.sum() * 0.1 * 0.1 * 2 * math.pi / 100 + still).item() == pytest.approx(1.0, abs=2e-3)


def test_what_is_drawn_has_the_density_that_is_told_and_entropy_bounds_it() -> None:
    mixture, logits = PatchMixture(3), numbers(4, 3)
    patch, by = many(mixture, logits, 60_000)
    torch.testing.assert_close(by, mixture.log_prob(logits, patch))
    drawn = -by.mean().item()
    assert drawn - 0.05 < mixture.entropy(logits).item() < drawn + math.log(4)
    assert ((patch == 0).all(-1).double().mean() - mixture.log_prob(logits, 0 * patch[0]).exp()).abs() < 0.01
    single = numbers(1, 3)
    assert mixture.entropy(single).item() == pytest.approx(-many(mixture, single, 60_000)[1].mean().item(), abs=0.03)


@pytest.mark.parametrize("kappa", [4.0, 30.0, 1e3, 1e6])
def test_angles_are_drawn_as_scipy_says(kappa: float) -> None:
    uniform = torch.rand(40_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    drawn = _mises(uniform, torch.full_like(uniform, kappa)).numpy()
    assert stats.kstest(drawn, stats.vonmises(kappa).cdf).pvalue > 0.01


def test_normalisers_hold_for_every_concentration() -> None:
    kappa = torch.logspace(0, 6, 50, dtype=torch.float64)
    expected = np.log(np.vectorize(lambda k: stats.vonmises.pdf(0.0, k))(kappa.numpy()))
    np.testing.assert_allclose(-_log_bessel(kappa).numpy() - math.log(2 * math.pi), expected, rtol=1e-4)


def test_divergence_is_zero_of_itself_and_above_what_samples_say() -> None:
    mixture, one = PatchMixture(3), numbers(4, 3)
    other = one + 0.2 * numbers(4, 3, seed=5)
    other[-1:] = one[-1:]
    patch, by = many(mixture, one, 60_000)
    sampled = (by - mixture.log_prob(other, patch)).mean().item()
    assert mixture.divergence(one, one).item() == pytest.approx(0.0, abs=1e-12)
    assert 0 < sampled - 0.02 < mixture.divergence(one, other).item() < 2 * sampled
    single, moved = numbers(1, 3), numbers(1, 3)
    moved[1:-1] += 0.2  # standing still as well
    patch, by = many(mixture, single, 60_000)
    exact = (by - mixture.log_prob(moved, patch)).mean().item()
    assert mixture.divergence(single, moved).item() == pytest.approx(exact, rel=0.03)


@settings(max_examples=40, deadline=None)
@given(frames=st.integers(1, 10), seed=st.integers(0, 1000), spread=st.floats(0.0, 3.0))
def test_poses_and_their_changes_map_onto_each_other(frames: int, seed: int, spread: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    changes = spread * torch.rand(frames, 3, generator=generator, dtype=torch.float64) / frames
    before = torch.rand((), generator=generator, dtype=torch.float64)
    back = _changes(_poses(changes, before).unflatten(-1, (frames, 3)), before)
    torch.testing.assert_close(back, changes, atol=1e-9, rtol=0)


def test_gradients_are_finite_where_agents_stand_and_where_densities_are_narrow() -> None:
    mixture = PatchMixture(10)
    logits = torch.zeros(5, 16 * 61 + 2)
    logits[:, 17:-1] = torch.tensor([-50.0, -5.0, 0.0, 5.0, 50.0])[:, None]
    logits.requires_grad_()
    total = mixture.log_prob(logits, torch.full((5, 30), 1e-4)) + mixture.log_prob(logits, torch.zeros(5, 30))
    total = total + mixture.entropy(logits)
    (total + mixture.divergence(logits, torch.zeros(5, 16 * 61 + 2))).sum().backward()
    assert total.isfinite().all() and logits.grad.isfinite().all()


def test_a_narrow_density_pulls_at_its_mean_no_more_than_a_wide_one() -> None:
    """By hand: of a Laplace density with one over UNIT whatever its scale, where the inverse of the scale would."""
    pulls = []
    for width in (-6.0, 0.0):
        logits = torch.tensor([0.0, -50.0, 0.0, 0.0, 0.0, width, width, 3.0, 0.0], dtype=torch.float64)
        logits.requires_grad_()
        PatchMixture(1).log_prob(logits, torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)).backward()
        pulls.append(logits.grad[2].item())
    assert pulls == pytest.approx([1.0, 1.0]), "of the number that the policy gives, UNIT of which is a metre"


def test_divergence_pulls_at_a_mean_by_the_same_measure_as_the_density() -> None:
    """What a KL term holds and what an objective pulls: both times the width over UNIT, at any width."""
    for width in (-6.0, 0.0):
        logits = torch.tensor([0.0, -50.0, 3.0, 0.0, 0.0, width, width, 3.0, 0.0], dtype=torch.float64)
        logits.requires_grad_()
        reference = logits.detach().clone()
        reference[2] = 0.0
        PatchMixture(1).divergence(logits, reference).backward()
        scale = Mixture.of(reference, 1).scale[0, 0, 0].item()
        true = (1 - math.exp(-3 * UNIT / scale)) / scale * UNIT  # of exp(-x/b) + x/b - 1, by the number, UNIT a metre
        assert logits.grad[2].item() == pytest.approx(true * scale / UNIT, rel=1e-6)


def test_a_nucleus_cuts_modes_and_a_temperature_narrows_them() -> None:
    mixture, logits = PatchMixture(2), torch.zeros(2 * 13 + 2, dtype=torch.float64)
    logits[0], logits[2] = 4.0, -20.0  # 98 % of the first mode, which goes 10 m further each step
    logits[3:27].view(2, 2, 6)[0, :, 0] = 10.0 / UNIT
    first, _ = many(mixture, logits, 500, Decoding(top_p=0.9))
    assert (first[:, 0] > 4).all() and not (many(mixture, logits, 2000)[0][:, 0] > 4).all()
    calm, _ = many(mixture, logits, 500, Decoding(top_p=0.9, temperature=0.01))
    middle = mixture.likeliest(logits)
    assert (calm - middle).abs().max() < 1.0 < (first - middle).abs().max()
    assert mixture.hit(logits, middle) and not mixture.hit(logits, middle + 2.0)


def test_an_agent_that_stands_does_not_move_at_all() -> None:
    mixture, logits = PatchMixture(3), numbers(4, 3, still=20.0)
    patch, by = many(mixture, logits, 500)
    assert not patch.any() and not mixture.likeliest(logits).any()
    assert by.exp().mean().item() == pytest.approx(1.0, abs=1e-6)


def test_an_untrained_policy_goes_on_as_agents_do() -> None:
    torch.manual_seed(0)
    size = size_of("behaviorgpt", "nano")
    model = build_model({"family": "behaviorgpt", "model": size, "context": {}}, PatchTokenizer()).eval()
    recent = torch.zeros(1, 11, 3)
    recent[0, :, 0] = 0.5 * torch.arange(11)
    with torch.no_grad():
        patch = model.distribution.likeliest(model.decide(torch.randn(1, 36), recent, torch.tensor([1]))).view(10, 3)
    torch.testing.assert_close(patch[:, 0], 0.5 * torch.arange(1.0, 11.0), atol=0.3, rtol=0)


@pytest.mark.parametrize(("size", "published"), [("nano", 0.15e6), ("3m", 3e6)])
def test_sizes_have_the_parameters_that_they_are_named_for(size: str, published: float) -> None:
    config = {"family": "behaviorgpt", "model": size_of("behaviorgpt", size), "context": {}}
    model = build_model(config, PatchTokenizer())
    assert sum(parameter.numel() for parameter in model.parameters()) == pytest.approx(published, rel=0.1)


def test_a_vocabulary_is_refused_and_so_are_patches_elsewhere() -> None:
    patches = PatchTokenizer()
    refused = {"behaviorgpt": VerletTokenizer(), "motionlm": patches, "smart": patches, "trajeglish": patches}
    for family, tokenizer in refused.items():
        with pytest.raises(ValueError, match=r"tokenizer"):
            build_model({"family": family, "model": size_of(family, "nano"), "context": {}}, tokenizer)


if __name__ == "__main__":
    pytest.main([__file__])
