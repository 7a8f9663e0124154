"""Intervals cover what they promise, pair what belongs together, and name what is missing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpa.report.statistics import (
    SCENES,
    SEEDS_AND_SCENES,
    paired_bootstrap,
    summary,
    unpaired_bootstrap,
)


def simulated(
    rng: np.random.Generator, num_seeds: int, seed_sd: float, gain: float = 0.01, num_scenes: int = 54
) -> np.ndarray:
    """``[seeds, scenes]`` differences with an effect of the scene (shared by seeds), of the run, and noise."""
    scene, run = rng.normal(0, 0.03, (1, num_scenes)), rng.normal(0, seed_sd, (num_seeds, 1))
    return gain + scene + run + rng.normal(0, 0.03, (num_seeds, num_scenes))


def coverage(num_seeds: int, seed_sd: float, trials: int, num_scenes: int = 54, num_resamples: int = 500) -> float:
    """Share of simulated experiments whose interval holds the true gain."""
    rng, held = np.random.default_rng(5), 0
    for trial in range(trials):
        values = simulated(rng, num_seeds, seed_sd, num_scenes=num_scenes)
        found = paired_bootstrap(values, np.zeros((1, num_scenes)), num_resamples, seed=trial)
        held += found.low <= 0.01 <= found.high
    return held / trials


def test_identical_methods_differ_by_exactly_nothing() -> None:
    scores = np.random.default_rng(0).random((3, 20))
    found = paired_bootstrap(scores, scores)
    assert (found.mean, found.low, found.high) == (0, 0, 0)
    assert found.verdict == "open"


@settings(max_examples=20, deadline=None)
@given(shift=st.floats(-1, 1), seeds=st.integers(1, 4), scenes=st.integers(1, 10))
def test_a_constant_shift_has_no_uncertainty(shift: float, seeds: int, scenes: int) -> None:
    scores = np.random.default_rng(1).random((seeds, scenes))
    found = paired_bootstrap(scores + shift, scores, num_resamples=200)
    assert (found.mean, found.low, found.high) == pytest.approx((shift, shift, shift), abs=1e-12)
    assert found.over == (SCENES if seeds == 1 else SEEDS_AND_SCENES)
    assert (found.num_seeds, found.num_scenes) == (seeds, scenes)


def test_resampling_scenes_agrees_with_the_standard_error_of_the_mean() -> None:
    values = np.random.default_rng(2).normal(0.5, 0.1, (1, 400))
    found = summary(values)
    error = values.std(ddof=1) / math.sqrt(400)
    assert found.high - found.low == pytest.approx(2 * 1.96 * error, rel=0.05)


def test_pairing_takes_the_spread_between_scenes_away() -> None:
    rng = np.random.default_rng(3)
    easy_and_hard = rng.normal(0.6, 0.2, (1, 54))
    better = easy_and_hard + 0.01 + rng.normal(0, 0.01, (1, 54))
    assert paired_bootstrap(better, easy_and_hard).low > 0
    assert summary(better).high - summary(better).low > 0.05


def test_a_claim_needs_two_training_runs_and_an_interval_that_leaves_out_zero() -> None:
    better, worse, open_ = (np.full((2, 4), mean) for mean in (0.1, -0.1, 0.0))
    nothing = np.zeros((2, 4))
    told = [paired_bootstrap(values, nothing, num_resamples=10).verdict for values in (better, worse, open_)]
    assert told == ["better", "worse", "open"]
    assert paired_bootstrap(better[:1], nothing[:1], num_resamples=10).verdict == "open"


def test_seeds_that_disagree_widen_the_interval() -> None:
    rng = np.random.default_rng(4)
    alike, apart = (simulated(rng, 3, sd) for sd in (0.0, 0.05))
    zero = np.zeros((1, 54))
    narrow, wide = paired_bootstrap(alike, zero), paired_bootstrap(apart, zero)
    assert wide.high - wide.low > 1.5 * (narrow.high - narrow.low)


@pytest.mark.parametrize(("seeds", "seed_sd", "least"), [(1, 0.0, 0.88), (3, 0.01, 0.85), (5, 0.01, 0.88)])
def test_the_interval_holds_the_true_gain_about_as_often_as_it_says(seeds: int, seed_sd: float, least: float) -> None:
    assert least <= coverage(seeds, seed_sd, trials=200)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seeds", "scenes", "told"),
    [(1, 54, 0.67), (2, 54, 0.86), (3, 54, 0.91), (5, 54, 0.93), (3, 400, 0.80), (5, 400, 0.88)],
)
def test_how_often_few_runs_hold_the_true_gain_is_as_documented(seeds: int, scenes: int, told: float) -> None:
    assert f"{told:.0%}".replace("%", " %") in " ".join(str(paired_bootstrap.__doc__).split())
    assert coverage(seeds, 0.01, trials=2000, num_scenes=scenes) == pytest.approx(told, abs=0.01)


def test_runs_that_are_not_paired_are_drawn_for_themselves_and_scenes_for_both() -> None:
    rng = np.random.default_rng(7)
    mine, theirs = simulated(rng, 4, 0.02), simulated(rng, 3, 0.01)
    found = unpaired_bootstrap(mine, theirs)
    draws = []
    for _ in range(4000):  # the same, drawn one by one
        scenes = rng.integers(54, size=54)
        one, other = mine[rng.integers(4, size=4)][:, scenes], theirs[rng.integers(3, size=3)][:, scenes]
        draws.append(one.mean() - other.mean())
    assert found.mean == pytest.approx(mine.mean() - theirs.mean())
    assert (found.low, found.high) == pytest.approx(tuple(np.quantile(draws, [0.025, 0.975])), abs=0.002)
    assert (found.num_seeds, found.num_scenes, found.over) == (3, 54, SEEDS_AND_SCENES)


def test_what_a_scene_does_to_both_sides_cancels_and_one_run_of_a_side_carries_no_claim() -> None:
    scene = np.random.default_rng(8).normal(0, 0.1, (1, 60))
    found = unpaired_bootstrap(np.repeat(scene + 0.25, 2, 0), scene)
    assert (found.mean, found.low, found.high) == pytest.approx((0.25, 0.25, 0.25))
    assert found.over == SCENES and found.verdict == "open"
    with pytest.raises(ValueError, match=r"values \[1, 60\] and others \[1, 59\] must have the same scenes"):
        unpaired_bootstrap(scene, scene[:, :59])


def test_one_seed_knows_nothing_of_the_spread_between_runs() -> None:
    assert coverage(1, 0.01, trials=200) < 0.8
    assert summary([[0.1, 0.2]]).over == SCENES


def test_draws_are_reproducible_and_one_reference_serves_all_seeds() -> None:
    rng = np.random.default_rng(7)
    values, reference = rng.random((3, 30)), rng.random((1, 30))
    assert paired_bootstrap(values, reference, seed=1) == paired_bootstrap(values, reference, seed=1)
    assert paired_bootstrap(values, reference) == paired_bootstrap(values, reference.repeat(3, 0))


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_score_that_is_not_finite_is_named(bad: float) -> None:
    values, reference = np.zeros((2, 5)), np.zeros((2, 5))
    reference[1, 3] = bad
    with pytest.raises(ValueError, match=rf"reference: row \(seed\) 1, column \(scene\) 3 is {bad}"):
        paired_bootstrap(values, reference)


@pytest.mark.parametrize("shape", [(2, 4), (3, 5)])
def test_what_does_not_pair_is_refused(shape: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=r"\[2, 5\] and reference \[\d, \d\] do not pair"):
        paired_bootstrap(np.zeros((2, 5)), np.zeros(shape))


def test_a_row_of_scores_without_seeds_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\[seeds, scenes\].*got shape \[5\]"):
        summary(np.zeros(5))


if __name__ == "__main__":
    pytest.main([__file__])
