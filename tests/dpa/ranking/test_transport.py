"""Transport costs against POT, scipy, hand cases and the symmetries that a distance between measures must have."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import ot
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import spearmanr, wasserstein_distance
from torch import Tensor

from dpa.ranking.features import log_trajectory, occupancy_features
from dpa.ranking.transport import SOLVERS, Dense, Problems, make_solver, transport_cost
from envs.sources import SOURCES

WEIGHTS = torch.tensor([10.0, 5.0, 2.0, 1.0, 1.0])
METHODS = ["exact", "windowed", "sinkhorn", "time_aligned"]
seeds = st.integers(0, 2**31 - 1)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def clouds(seed: int, *batch: int, steps: int = 20, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    rng = generator(seed)
    return tuple(torch.randn(*batch, steps, 5, generator=rng, dtype=dtype) * 3 for _ in range(2))


def always(steps: int = 20) -> Tensor:
    return torch.ones(steps, dtype=torch.bool)


def cost_matrix(x: Tensor, y: Tensor, weights: Tensor = WEIGHTS) -> np.ndarray:
    x, y, w = (v.double().numpy() for v in (x, y, weights))
    return np.sqrt((w * (x[:, None] - y[None]) ** 2).sum(-1))


def oracle(x: Tensor, y: Tensor, far: np.ndarray | None = None) -> float:
    """POT on one problem, everything in numpy; 0 without mass."""
    if 0 in (len(x), len(y)):
        return 0.0
    cost = cost_matrix(x, y)
    cost = cost if far is None else np.where(far, 1e5, cost)
    return ot.emd2(ot.unif(len(x)), ot.unif(len(y)), np.ascontiguousarray(cost))


def masked_problems(number: int, count: int) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Batches of problems: unequal counts, single points, ties, duplicates and empty sides among them."""
    for seed in range(number):
        rng = generator(seed)
        most = 80 if seed % 10 == 0 else 16
        steps, other = torch.randint(1, most + 1, (2,), generator=rng).tolist()
        x, y = (torch.randn(count, n, 5, generator=rng, dtype=torch.float64) * 3 for n in (steps, other))
        if seed % 2:
            x, y = x.float().double(), y.float().double()
        if seed % 5 == 1:  # ties and duplicates
            x, y = x.round(), y.round()
        if seed % 5 == 2:  # standing agents: one point over and over
            x[:, :, :] = x[:, :1]
        share = torch.rand(2, count, 1, generator=rng) * 1.2  # from nothing to everything
        x_valid, y_valid = (torch.rand(count, n, generator=rng) < s for n, s in zip((steps, other), share, strict=True))
        if steps == other and seed % 4 < 2:
            y_valid = x_valid
        yield x, y, x_valid, y_valid


@pytest.mark.parametrize("batches", [40, pytest.param(200, marks=pytest.mark.slow)])
def test_exact_equals_pot_on_thousands_of_masked_problems(batches: int) -> None:
    count, kinds = 50, set()
    for seed, (x, y, x_valid, y_valid) in enumerate(masked_problems(batches, count)):
        want = np.array([oracle(x[i][x_valid[i]], y[i][y_valid[i]]) for i in range(count)])
        got = transport_cost(x, y, x_valid, y_valid, WEIGHTS)
        assert got.distance.dtype == got.parts.dtype == torch.float64
        np.testing.assert_allclose(got.distance.numpy(), want, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(got.ranked, x_valid.any(-1) & y_valid.any(-1))
        n, m = x_valid.sum(-1), y_valid.sum(-1)
        kinds |= {"equal"} if bool(((n == m) & (n > 1)).any()) else set()
        kinds |= {name for name, there in (("unequal", n != m), ("single", n == 1), ("empty", n == 0)) if there.any()}
        if seed % 2:  # numbers that float32 holds
            single = transport_cost(x.float(), y.float(), x_valid, y_valid, WEIGHTS)
            assert single.distance.dtype == single.parts.dtype == torch.float32
            np.testing.assert_allclose(single.distance.numpy(), want, rtol=1e-5, atol=1e-7)
    assert kinds == {"equal", "unequal", "single", "empty"}


def test_one_feature_gives_the_wasserstein_distance_of_scipy() -> None:
    x, y = (v[..., :1] for v in clouds(1, steps=30))
    got = transport_cost(x, y, always(30), always(30), torch.ones(1)).distance
    assert float(got) == pytest.approx(wasserstein_distance(x[:, 0].numpy(), y[:, 0].numpy()), rel=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_coupling_has_uniform_marginals_and_explains_distance_and_parts(method: str) -> None:
    x, y = clouds(2, 2, dtype=torch.float64)
    valid = torch.rand(2, 20, generator=generator(0)) < 0.7
    got = transport_cost(x, y, valid, valid, WEIGHTS, method=method, coupling=True)
    uniform = valid.double() / valid.sum(-1, keepdim=True)
    torch.testing.assert_close(got.coupling.sum(-2), uniform)
    torch.testing.assert_close(got.coupling.sum(-1), uniform, atol=0.01 if method == "sinkhorn" else 1e-12, rtol=0)
    squared = (x[:, :, None] - y[:, None]) ** 2 * WEIGHTS
    cost = squared.sum(-1).sqrt()
    torch.testing.assert_close((got.coupling * cost).sum((-1, -2)), got.distance)
    torch.testing.assert_close(((got.coupling / cost)[..., None] * squared).sum((1, 2)), got.parts)
    torch.testing.assert_close(got.parts.sum(-1), got.distance)


def test_unequal_counts_have_parts_that_sum_to_the_distance() -> None:
    x, y = clouds(12, dtype=torch.float64)
    got = transport_cost(x, y[:13], always(), always(13), WEIGHTS, coupling=True)
    torch.testing.assert_close(got.parts.sum(-1), got.distance)
    torch.testing.assert_close(got.coupling.sum(0), torch.full((13,), 1 / 13, dtype=torch.float64))


def test_parts_name_the_feature_that_differs_and_follow_the_weights() -> None:
    x, y = torch.zeros(3, 5), torch.zeros(3, 5)
    y[:, 0], y[:, 4] = 1.0, 2.0
    parts = transport_cost(x, y, always(3), always(3), WEIGHTS).parts
    torch.testing.assert_close(parts, torch.tensor([10.0, 0, 0, 0, 4]) / 14**0.5)
    assert not transport_cost(x, x, always(3), always(3), WEIGHTS).parts.any()


def test_time_aligned_is_the_mean_cost_of_the_steps_valid_on_both_sides() -> None:
    x, y = clouds(3)
    x_valid, y_valid = torch.arange(20) < 15, torch.arange(20) >= 5
    got = transport_cost(x, y, x_valid, y_valid, WEIGHTS, method="time_aligned")
    want = ((x - y) ** 2 * WEIGHTS).sum(-1).sqrt()[5:15].mean()
    torch.testing.assert_close(got.distance, want)
    nothing_shared = transport_cost(x, y, x_valid, ~x_valid, WEIGHTS, method="time_aligned")
    assert not nothing_shared.ranked and nothing_shared.distance == 0


# --- windowed -------------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(seed=seeds, steps=st.integers(0, 6), same=st.booleans())
def test_windowed_equals_pot_with_large_costs_beyond_the_window(seed: int, steps: int, same: bool) -> None:
    x, y = clouds(seed, dtype=torch.float64)
    x_valid = torch.rand(20, generator=generator(seed)) < 0.7
    y_valid = x_valid if same else torch.ones(20, dtype=torch.bool)
    x_valid[0] = True
    rows, columns = x_valid.nonzero()[:, 0].numpy(), y_valid.nonzero()[:, 0].numpy()
    reach = steps
    far = np.abs(rows[:, None] - columns) > reach
    while oracle(x[x_valid], y[y_valid], far) > 100:  # the smallest window that some coupling keeps to
        reach += 1
        far = np.abs(rows[:, None] - columns) > reach
    got = transport_cost(x, y, x_valid, y_valid, WEIGHTS, method="windowed", window=0.1 * steps, coupling=True)
    assert float(got.distance) == pytest.approx(oracle(x[x_valid], y[y_valid], far), rel=1e-9)
    moved = got.coupling.nonzero()
    assert int((moved[:, 0] - moved[:, 1]).abs().max()) <= reach
    assert reach == steps or not same


@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_a_window_leads_from_time_aligned_to_exact(seed: int) -> None:
    x, y = clouds(seed, dtype=torch.float64)
    valid = torch.rand(20, generator=generator(seed)) < 0.8
    valid[0] = True

    def distance(method: str, **options: float) -> Tensor:
        return transport_cost(x, y, valid, valid, WEIGHTS, method=method, **options).distance

    widths = [distance("windowed", window=window) for window in (0.0, 0.3, 0.8, 2.0, float("inf"))]
    assert all(narrow >= wide - 1e-12 for narrow, wide in pairwise(widths))
    torch.testing.assert_close(widths[0], distance("time_aligned"))
    torch.testing.assert_close(widths[-1], distance("exact"))


@pytest.mark.parametrize(("step", "reach"), [(0.1, 3), (0.15, 2), (0.5, 0)])
def test_a_window_in_seconds_is_as_many_whole_steps_as_fit(step: float, reach: int) -> None:
    x = torch.arange(8.0)[:, None]
    moved = transport_cost(
        x, x.flip(0), always(8), always(8), torch.ones(1), method="windowed", window=0.3, step=step, coupling=True
    ).coupling.nonzero()
    assert int((moved[:, 0] - moved[:, 1]).abs().max()) == reach


# --- sinkhorn -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("start", [None, 1.0])
def test_sinkhorn_equals_that_of_pot(start: float | None) -> None:
    x, y = clouds(20, 3, dtype=torch.float64)
    x_valid, y_valid = (torch.rand(3, 20, generator=generator(seed)) < 0.7 for seed in (1, 2))
    options = {"epsilon": 0.1, "start": start, "tolerance": 1e-10, "iterations": 10_000}
    got = transport_cost(x, y, x_valid, y_valid, WEIGHTS, method="sinkhorn", coupling=True, **options)
    for i in range(3):
        cost = cost_matrix(x[i][x_valid[i]], y[i][y_valid[i]])
        n, m = cost.shape
        plan = ot.bregman.sinkhorn_log(
            ot.unif(n), ot.unif(m), cost, reg=0.1 * cost.mean(), stopThr=1e-12, numItermax=10_000
        )
        np.testing.assert_allclose(got.coupling[i][x_valid[i]][:, y_valid[i]].numpy(), plan, atol=1e-10)
        assert float(got.distance[i]) == pytest.approx((plan * cost).sum(), rel=1e-8)


def test_sinkhorn_goes_to_exact_with_epsilon() -> None:
    x, y = clouds(21, 4, dtype=torch.float64)
    exact = transport_cost(x, y, always(), always(), WEIGHTS)
    assert exact.marginal_error is None
    errors = []
    for epsilon in (0.3, 0.1, 0.03, 0.01):
        options = {"epsilon": epsilon, "tolerance": 1e-4, "iterations": 20_000}
        got = transport_cost(x, y, always(), always(), WEIGHTS, method="sinkhorn", **options)
        errors.append(float((got.distance / exact.distance - 1).abs().max()))
        assert (got.marginal_error <= 1e-4).all()
    assert errors == sorted(errors, reverse=True) and errors[-1] < 1e-2


def test_sinkhorn_reports_the_marginal_error_that_the_iteration_limit_leaves() -> None:
    x, y = clouds(22, 3, dtype=torch.float64)
    options = {"epsilon": 0.01, "start": None, "iterations": 3}
    with pytest.warns(UserWarning, match=r"further than tolerance=0.01 from their marginals after iterations=3"):
        got = transport_cost(x, y, always(), always(), WEIGHTS, method="sinkhorn", coupling=True, **options)
    torch.testing.assert_close(got.marginal_error, (got.coupling.sum(-1) - 1 / 20).abs().sum(-1))
    assert (got.marginal_error > 1e-2).all()


def test_a_problem_of_sinkhorn_does_not_depend_on_those_beside_it() -> None:
    x, y = clouds(23, 5)
    y[3] = x[3] + 0.01  # takes another number of iterations
    together = transport_cost(x, y, always(), always(), WEIGHTS, method="sinkhorn").distance
    alone = torch.stack(
        [
            transport_cost(a, b, always(), always(), WEIGHTS, method="sinkhorn").distance
            for a, b in zip(x, y, strict=True)
        ]
    )
    torch.testing.assert_close(together, alone, rtol=1e-5, atol=0)


def test_a_coupling_by_sinkhorn_is_0_where_nothing_counts_however_far_points_are_from_the_origin() -> None:
    x, y = (cloud.float() + torch.tensor([0.0, -5.0, 30.0, 0.5, 20.0]) for cloud in clouds(5, 2))
    valid = always()
    valid[..., 8:12] = False
    got = transport_cost(x, y, valid, valid, WEIGHTS, method="sinkhorn", coupling=True)
    torch.testing.assert_close(got.coupling.sum((-1, -2)), torch.ones(2))
    assert not got.coupling[:, 8:12].any() and not got.coupling[..., 8:12].any()


def test_identical_single_points_are_at_zero_by_sinkhorn() -> None:
    x = torch.ones(1, 5)
    got = transport_cost(x, x, always(1), always(1), WEIGHTS, method="sinkhorn")
    assert got.distance == got.marginal_error == 0 and got.ranked


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")  # raised by torch's own compiler
@pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs a C++ compiler")
def test_sinkhorn_compiled_gives_the_same() -> None:
    x, y = clouds(24, 3)
    plain, compiled = (
        transport_cost(x, y, always(), always(), WEIGHTS, method="sinkhorn", compile=compile).distance
        for compile in (False, True)
    )
    torch.testing.assert_close(plain, compiled, rtol=1e-5, atol=0)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("method", METHODS)
def test_a_gpu_gives_the_same_as_the_cpu(method: str) -> None:
    x, y = clouds(25, 3)
    want = transport_cost(x, y, always(), always(), WEIGHTS, method=method)
    on_gpu = (v.cuda() for v in (x, y, always(), always(), WEIGHTS))
    got = transport_cost(*on_gpu, method=method)
    assert got.distance.is_cuda and got.parts.is_cuda
    torch.testing.assert_close(got.distance.cpu(), want.distance, rtol=1e-4, atol=0)


def test_sinkhorn_ranks_rollouts_of_a_real_scene_like_exact(shared: Path) -> None:
    scenes = SOURCES["womd"].records(str(shared / "scenes/womd/motion_data_one_scenario.tfrecord"))
    scene = next(iter(scenes)).scene()
    log = log_trajectory(scene, 80)
    noise = torch.randn(12, *log.shape, generator=generator(0)).cumsum(2) * torch.tensor([0.05, 0.05, 0.0, 0.005])
    ego = torch.arange(0, len(log), 5)
    phi, valid = occupancy_features(scene, torch.cat((log + noise, log[None])), ego=ego)
    exact, entropic = (
        transport_cost(phi[:-1], phi[-1:], valid, valid, WEIGHTS, method=method).distance.sum(-1)
        for method in ("exact", "sinkhorn")
    )
    assert spearmanr(exact, entropic).statistic >= 0.99


# --- symmetries -----------------------------------------------------------------------------------------------------


@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_exact_is_symmetric_and_never_above_time_aligned(seed: int) -> None:
    x, y = clouds(seed)
    there = transport_cost(x, y, always(), always(), WEIGHTS).distance
    back = transport_cost(y, x, always(), always(), WEIGHTS).distance
    aligned = transport_cost(x, y, always(), always(), WEIGHTS, method="time_aligned").distance
    torch.testing.assert_close(there, back)
    assert there <= aligned + 1e-6


@settings(max_examples=15, deadline=None)
@given(seed=seeds)
def test_exact_ignores_the_order_of_steps_and_a_shift_of_both_sides(seed: int) -> None:
    x, y = clouds(seed)
    valid = torch.rand(20, generator=generator(seed)) < 0.8
    order = torch.randperm(20, generator=generator(seed))
    want = transport_cost(x, y, valid, valid, WEIGHTS).distance
    torch.testing.assert_close(transport_cost(x[order], y, valid[order], valid, WEIGHTS).distance, want)
    shift = torch.tensor([0.0, 3.0, -2.0, 1.0, 5.0])
    torch.testing.assert_close(transport_cost(x + shift, y + shift, valid, valid, WEIGHTS).distance, want)


@settings(max_examples=15, deadline=None)
@given(seed=seeds, dtype=st.sampled_from([torch.float32, torch.float64]))
def test_a_measure_is_at_distance_zero_from_itself_in_any_order(seed: int, dtype: torch.dtype) -> None:
    x, _ = clouds(seed, dtype=dtype)
    order = torch.randperm(20, generator=generator(seed))
    assert transport_cost(x, x[order], always(), always(), WEIGHTS).distance == 0
    assert transport_cost(x, x, always(), always(), WEIGHTS, method="windowed").distance == 0


@settings(max_examples=10, deadline=None)
@given(seed=seeds, factor=st.floats(0.1, 10), method=st.sampled_from(METHODS))
def test_weights_times_a_square_multiply_distances(seed: int, factor: float, method: str) -> None:
    x, y = clouds(seed, dtype=torch.float64)
    valid = torch.rand(20, generator=generator(seed)) < 0.8
    one, more = (transport_cost(x, y, valid, valid, WEIGHTS.double() * w, method=method) for w in (1, factor**2))
    torch.testing.assert_close(more.distance, one.distance * factor)
    torch.testing.assert_close(more.parts, one.parts * factor)


@settings(max_examples=20, deadline=None)
@given(seed=seeds, method=st.sampled_from(METHODS), at_end=st.integers(0, 5))
def test_invalid_steps_agents_and_padding_change_nothing(seed: int, method: str, at_end: int) -> None:
    x, y = clouds(seed, 2)
    valid = torch.rand(2, 20, generator=generator(seed)) < 0.7
    valid[0, 0] = True
    want = transport_cost(x, y, valid, valid, WEIGHTS, method=method)

    x[~valid], y[~valid] = 1e6, torch.nan
    x, y = (torch.cat((v, torch.full((2, at_end, 5), 7.0)), 1) for v in (x, y))
    x, y = (torch.cat((v, torch.full((1, 20 + at_end, 5), torch.inf))) for v in (x, y))
    padded = torch.nn.functional.pad(valid, (0, at_end, 0, 1))
    got = transport_cost(x, y, padded, padded, WEIGHTS, method=method)
    torch.testing.assert_close(got.distance[:2], want.distance, rtol=1e-5 if method == "sinkhorn" else 0, atol=0)
    assert not got.ranked[2] and got.distance[2] == 0 and not got.parts[2].any()


@pytest.mark.parametrize("method", METHODS)
def test_an_empty_mask_gives_zero_and_is_not_ranked(method: str) -> None:
    x, y = clouds(6, 2)
    valid = torch.ones(2, 20, dtype=torch.bool)
    valid[1] = False
    got = transport_cost(x, y, valid, valid, WEIGHTS, method=method, coupling=True)
    assert got.ranked.tolist() == [True, False]
    assert got.distance[1] == 0 and got.coupling[1].sum() == 0 and not got.parts[1].any()


@pytest.mark.parametrize("method", METHODS)
def test_no_problems_at_all_have_the_right_shapes(method: str) -> None:
    nothing = torch.zeros(4, 0, 20, 5)
    got = transport_cost(nothing, nothing[:1], always(), always(), WEIGHTS, method=method, coupling=True)
    assert got.distance.shape == got.ranked.shape == (4, 0)
    assert got.coupling.shape == (4, 0, 20, 20) and got.parts.shape == (4, 0, 5)


def test_rollouts_broadcast_against_one_log_and_threads_change_nothing() -> None:
    x, _ = clouds(8, 40, 15)
    _, y = clouds(9, 15)
    valid = torch.rand(15, 20, generator=generator(0)) < 0.8
    got = transport_cost(x, y, valid, valid, WEIGHTS)
    assert got.distance.shape == (40, 15) and got.parts.shape == (40, 15, 5)
    torch.testing.assert_close(got.distance[37], transport_cost(x[37], y, valid, valid, WEIGHTS).distance)
    again = transport_cost(x, y, valid, valid, WEIGHTS, threads=3)
    assert torch.equal(got.distance, again.distance) and torch.equal(got.parts, again.parts)


# --- options --------------------------------------------------------------------------------------------------------


def test_a_solver_of_ones_own_is_a_class_in_the_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True)
    class Independent:
        """Every step with every step alike."""

        def __call__(self, problems: Problems) -> Dense:
            return Dense(problems.x_mass[:, :, None] * problems.y_mass[:, None])

    monkeypatch.setitem(SOLVERS, "independent", Independent)
    x, y = clouds(11)
    valid = torch.arange(20) % 3 > 0
    got = transport_cost(x, y, valid, valid, WEIGHTS, method="independent")
    assert float(got.distance) == pytest.approx(cost_matrix(x[valid], y[valid]).mean(), rel=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "nearest"}, "'nearest'; choose one of .*'exact'"),
        ({"window": 1.0}, "'exact' has no option 'window'; it takes none"),
        ({"method": "sinkhorn", "window": 1.0}, "'window'; it takes epsilon, start"),
        ({"method": "windowed", "window": -1.0}, "window must be 0 s or more, got -1.0"),
        ({"method": "sinkhorn", "epsilon": 0.0}, "epsilon of sinkhorn must be above 0, got 0.0"),
        ({"method": "sinkhorn", "iterations": 60}, "more than the 60 that lead from start .* got 60"),
        ({"method": "sinkhorn", "start": 0.01}, "start of sinkhorn .* got 0.01"),
        ({"weights": torch.tensor([1.0, -1, 1, 1, 1])}, "-1.0"),
        ({"weights": torch.ones(3)}, "5, 5 and"),
    ],
)
def test_bad_options_are_refused_with_the_value(options: dict, message: str) -> None:
    x, y = clouds(10)
    options = {"weights": WEIGHTS} | options
    with pytest.raises(ValueError, match=message):
        transport_cost(x, y, always(), always(), **options)


def test_time_aligned_refuses_sides_of_different_length() -> None:
    x, y = clouds(10)
    with pytest.raises(ValueError, match="got 20 and 5"):
        transport_cost(x, y[:5], always(), always(5), WEIGHTS, method="time_aligned")


def test_a_solver_is_made_by_name() -> None:
    assert make_solver("sinkhorn", compile=True) == make_solver("sinkhorn")  # compiling decides nothing
    assert make_solver("sinkhorn", epsilon=0.5) != make_solver("sinkhorn")
