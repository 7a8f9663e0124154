"""Sampling distributions against a hand-made nucleus, and draws against frequencies."""

from __future__ import annotations

import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dpa.models.sampling import Decoding, draw, rollout_noise


def cut_by_hand(probs: list[float], decoding: Decoding) -> list[float]:
    """Temperature, then the k most probable tokens, then those of them that together hold ``top_p``, one by one."""
    powers = [p ** (1 / decoding.temperature) for p in probs]
    order = sorted(range(len(probs)), key=lambda i: -powers[i])[: decoding.top_k or None]
    total = sum(powers[i] for i in order)
    kept, mass = [], 0.0
    for index in order:
        kept.append(index)
        mass += powers[index] / total
        if mass >= decoding.top_p:
            break
    held = sum(powers[i] for i in kept)
    return [powers[i] / held if i in kept else 0.0 for i in range(len(probs))]


@settings(max_examples=200, deadline=None)
@given(
    weights=st.lists(st.integers(1, 1000).map(lambda n: n / 100), min_size=1, max_size=8, unique=True),
    top_p=st.floats(0.01, 1),
    temperature=st.floats(0.3, 3),
    top_k=st.integers(0, 9),
)
def test_the_distribution_is_the_one_cut_by_hand(
    weights: list[float], top_p: float, temperature: float, top_k: int
) -> None:
    probs = torch.tensor(weights, dtype=torch.float64)
    probs = probs / probs.sum()
    decoding = Decoding(top_p, temperature, top_k)
    expected = torch.tensor(cut_by_hand(probs.tolist(), decoding), dtype=torch.float64)
    nearby = (
        cut_by_hand(probs.tolist(), Decoding(p, temperature, top_k))
        for p in (top_p * 0.9999999, min(1, top_p * 1.0000001))
    )
    assume(all(torch.allclose(torch.tensor(other, dtype=torch.float64), expected) for other in nearby))  # no tie
    torch.testing.assert_close(decoding.log_probs(probs.log()).exp(), expected)


def test_nothing_is_cut_from_the_whole_distribution() -> None:
    logits = torch.randn(5, 7)
    assert torch.equal(Decoding(top_p=1.0).log_probs(logits), logits.log_softmax(-1))


@pytest.mark.parametrize("decoding", [Decoding(top_p=0.5), Decoding(top_p=1.0, top_k=3), Decoding(top_p=0.5, top_k=2)])
def test_tokens_of_equal_probability_are_kept_or_cut_together(decoding: Decoding) -> None:
    probs = torch.tensor([0.2, 0.05, 0.2, 0.2, 0.1, 0.2, 0.05])
    kept = torch.tensor([0.25, 0.0, 0.25, 0.25, 0.0, 0.25, 0.0])
    torch.testing.assert_close(decoding.log_probs(probs.log()).exp(), kept)


def test_the_cut_distribution_has_the_gradient_of_its_own_softmax() -> None:
    logits = torch.tensor([2.0, 1.0, 0.5, -1.0], requires_grad=True)
    Decoding(top_p=0.9).log_probs(logits)[0].backward()
    kept = logits.detach()[:3].requires_grad_()
    kept.log_softmax(-1)[0].backward()
    torch.testing.assert_close(logits.grad, torch.cat((kept.grad, torch.zeros(1))))


def test_draws_have_the_frequencies_of_the_distribution() -> None:
    probs = torch.tensor([0.1, 0.0, 0.6, 0.3, 0.0])
    drawn = draw(probs.log().expand(100_000, -1), torch.rand(100_000, generator=torch.Generator().manual_seed(0)))
    share = drawn.bincount(minlength=5) / 100_000
    torch.testing.assert_close(share, probs, atol=0.006, rtol=0)
    assert share[1] == share[4] == 0


@pytest.mark.parametrize("uniform", [0.0, 1 - 2**-24])
def test_the_ends_of_the_interval_draw_tokens_of_some_probability(uniform: float) -> None:
    probs = torch.tensor([0.0, 0.3, 0.7, 0.0])
    assert draw(probs.log(), torch.tensor(uniform)).item() == (1 if uniform == 0 else 2)


def test_noise_depends_on_all_that_it_is_named_by() -> None:
    def noise(seed: int = 0, scene: str = "a", rollout: int = 0, episode: int = 0) -> torch.Tensor:
        return rollout_noise(seed, scene, rollout, episode, (4, 3))

    assert torch.equal(noise(), noise())
    for other in (noise(seed=1), noise(scene="b"), noise(rollout=1), noise(episode=1)):
        assert not torch.equal(other, noise())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"top_p": 0.0}, r"top_p must lie in \(0, 1\], got 0.0"),
        ({"top_p": 1.5}, "got 1.5"),
        ({"temperature": 0.0}, "temperature must be positive, got 0.0"),
        ({"temperature": float("nan")}, "temperature must be positive, got nan"),
        ({"top_k": -1}, "top_k must be 0 .* got -1"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Decoding(**options)
