"""Transport costs against POT, scipy, hand cases and the symmetries that a distance between measures must have."""

from __future__ import annotations

import numpy as np
import ot
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import wasserstein_distance

from dpa.ranking.transport import feature_shares, transport_cost

WEIGHTS = torch.tensor([10.0, 5.0, 2.0, 1.0, 1.0])


def clouds(seed: int, *batch: int, steps: int = 20) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    return tuple(torch.randn(*batch, steps, 5, generator=rng) * 3 for _ in range(2))


def oracle(x: torch.Tensor, y: torch.Tensor, weights: torch.Tensor) -> float:
    """POT on one problem, everything in numpy."""
    x, y, w = (v.double().numpy() for v in (x, y, weights))
    cost = np.sqrt((w * (x[:, None] - y[None]) ** 2).sum(-1))
    return ot.emd2(ot.unif(len(x)), ot.unif(len(y)), cost)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31 - 1), share=st.floats(0.1, 1.0), same=st.booleans())
def test_exact_cost_equals_pot_on_masked_problems(seed: int, share: float, same: bool) -> None:
    x, y = clouds(seed, 3)
    rng = torch.Generator().manual_seed(seed + 1)
    x_valid = torch.rand(3, 20, generator=rng) < share
    y_valid = x_valid if same else torch.rand(3, 20, generator=rng) < share
    x_valid[:, 0] = y_valid[:, 0] = True
    got = transport_cost(x, y, x_valid, y_valid, WEIGHTS)
    want = [oracle(x[i][x_valid[i]], y[i][y_valid[i]], WEIGHTS) for i in range(3)]
    assert got.ranked.all()
    np.testing.assert_allclose(got.distance.numpy(), want, rtol=1e-6)


def test_one_feature_gives_the_wasserstein_distance_of_scipy() -> None:
    x, y = (v[..., :1] for v in clouds(1, steps=30))
    always = torch.ones(30, dtype=torch.bool)
    got = transport_cost(x, y, always, always, torch.ones(1)).distance
    assert float(got) == pytest.approx(wasserstein_distance(x[:, 0].numpy(), y[:, 0].numpy()), rel=1e-6)


def test_coupling_has_uniform_marginals_and_explains_the_distance() -> None:
    x, y = clouds(2, 2)
    valid = torch.rand(2, 20, generator=torch.Generator().manual_seed(0)) < 0.7
    got = transport_cost(x, y, valid, valid, WEIGHTS, coupling=True)
    uniform = valid.float() / valid.sum(-1, keepdim=True)
    torch.testing.assert_close(got.coupling.sum(-1), uniform)
    torch.testing.assert_close(got.coupling.sum(-2), uniform)
    cost = ((x[:, :, None] - y[:, None]) ** 2 * WEIGHTS).sum(-1).sqrt()
    torch.testing.assert_close((got.coupling * cost).sum((-1, -2)), got.distance)


def test_time_aligned_is_the_mean_cost_of_the_steps_valid_on_both_sides() -> None:
    x, y = clouds(3)
    x_valid, y_valid = torch.arange(20) < 15, torch.arange(20) >= 5
    got = transport_cost(x, y, x_valid, y_valid, WEIGHTS, method="time_aligned")
    want = ((x - y) ** 2 * WEIGHTS).sum(-1).sqrt()[5:15].mean()
    torch.testing.assert_close(got.distance, want)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31 - 1))
def test_exact_is_symmetric_and_never_above_time_aligned(seed: int) -> None:
    x, y = clouds(seed)
    always = torch.ones(20, dtype=torch.bool)
    there = transport_cost(x, y, always, always, WEIGHTS).distance
    back = transport_cost(y, x, always, always, WEIGHTS).distance
    aligned = transport_cost(x, y, always, always, WEIGHTS, method="time_aligned").distance
    torch.testing.assert_close(there, back)
    assert there <= aligned + 1e-6


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31 - 1))
def test_exact_ignores_the_order_of_steps_and_a_shift_of_both_sides(seed: int) -> None:
    x, y = clouds(seed)
    always = torch.ones(20, dtype=torch.bool)
    order = torch.randperm(20, generator=torch.Generator().manual_seed(seed))
    want = transport_cost(x, y, always, always, WEIGHTS).distance
    torch.testing.assert_close(transport_cost(x[order], y, always, always, WEIGHTS).distance, want)
    shift = torch.tensor([0.0, 3.0, -2.0, 1.0, 5.0])
    torch.testing.assert_close(transport_cost(x + shift, y + shift, always, always, WEIGHTS).distance, want)


def test_a_measure_is_at_distance_zero_from_itself_reversed() -> None:
    x, _ = clouds(4)
    always = torch.ones(20, dtype=torch.bool)
    assert transport_cost(x, x.flip(0), always, always, WEIGHTS).distance == 0


@pytest.mark.parametrize("method", ["exact", "time_aligned"])
def test_masked_steps_do_not_change_the_distance(method: str) -> None:
    x, y = clouds(5)
    valid = torch.arange(20) % 3 > 0
    want = transport_cost(x, y, valid, valid, WEIGHTS, method=method).distance
    x[~valid], y[~valid] = 1e6, torch.nan
    assert transport_cost(x, y, valid, valid, WEIGHTS, method=method).distance == want


@pytest.mark.parametrize("method", ["exact", "time_aligned"])
def test_an_empty_mask_gives_zero_and_is_not_ranked(method: str) -> None:
    x, y = clouds(6, 2)
    valid = torch.ones(2, 20, dtype=torch.bool)
    valid[1] = False
    got = transport_cost(x, y, valid, valid, WEIGHTS, method=method, coupling=True)
    assert got.ranked.tolist() == [True, False]
    assert got.distance[1] == 0 and got.coupling[1].sum() == 0


def test_rollouts_broadcast_against_one_log_and_threads_change_nothing() -> None:
    x, _ = clouds(8, 40, 15)
    _, y = clouds(9, 15)
    valid = torch.rand(15, 20, generator=torch.Generator().manual_seed(0)) < 0.8
    got = transport_cost(x, y, valid, valid, WEIGHTS)
    assert got.distance.shape == (40, 15)
    torch.testing.assert_close(got.distance[37], transport_cost(x[37], y, valid, valid, WEIGHTS).distance)
    assert torch.equal(got.distance, transport_cost(x, y, valid, valid, WEIGHTS, threads=2).distance)


def test_shares_name_the_feature_that_differs_and_follow_the_weights() -> None:
    x, y = torch.zeros(3, 5), torch.zeros(3, 5)
    y[:, 0], y[:, 4] = 1.0, 2.0
    shares = feature_shares(x, y, torch.eye(3) / 3, WEIGHTS)
    torch.testing.assert_close(shares, torch.tensor([10 / 14, 0, 0, 0, 4 / 14]))
    assert feature_shares(x, x, torch.eye(3) / 3, WEIGHTS).sum() == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "sinkhorn"}, "exact"),
        ({"weights": torch.tensor([1.0, -1, 1, 1, 1])}, "-1.0"),
        ({"weights": torch.ones(3)}, "5, 5 and"),
    ],
)
def test_bad_options_are_refused_with_the_value(options: dict, message: str) -> None:
    x, y = clouds(10)
    always = torch.ones(20, dtype=torch.bool)
    options = {"weights": WEIGHTS} | options
    with pytest.raises(ValueError, match=message):
        transport_cost(x, y, always, always, **options)
