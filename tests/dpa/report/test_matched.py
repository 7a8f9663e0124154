"""A method above the reference at equal sharpness: on its line by nothing, above it by what was added."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from dpa.report.matched import _above, matched_difference
from dpa.report.statistics import paired_bootstrap

SEEDS, SCENES = 3, 8


class Made:
    """Evaluations that were never written: figures of every scene by file."""

    def __init__(self) -> None:
        self.files: dict[str, dict[str, list[float | None]]] = {}

    def __call__(self, file: str) -> dict[str, list[float | None]] | None:
        return self.files.get(file)

    def rows(self, name: str, realism: NDArray, spread: NDArray) -> list[dict[str, Any]]:
        """Rows of one decoding, with figures ``[seeds, scenes]``."""
        for seed in range(len(realism)):
            self.files[f"{name} {seed}"] = {"realism": realism[seed].tolist(), "spread": spread[seed].tolist()}
        return [{"seed": seed, "file": f"{name} {seed}"} for seed in range(len(realism))]


@pytest.fixture
def draw() -> np.random.Generator:
    return np.random.default_rng(0)


def scene_values(draw: np.random.Generator, mean: float) -> NDArray:
    return mean + draw.normal(0, 0.05, (SEEDS, SCENES))


def line(made: Made, draw: np.random.Generator) -> tuple[list[list[dict]], list[tuple[NDArray, NDArray]]]:
    """A reference at a sharp and at a wide decoding."""
    points = [(scene_values(draw, realism), scene_values(draw, spread)) for realism, spread in ((0.6, 1.0), (0.5, 3.0))]
    return [made.rows(f"reference {place}", *point) for place, point in enumerate(points)], points


@pytest.mark.parametrize("lift", [0.0, 0.03, -0.2])
def test_a_method_between_two_decodings_is_above_the_line_by_what_was_added_to_it(
    draw: np.random.Generator, lift: float
) -> None:
    made = Made()
    base, (sharp, wide) = line(made, draw)
    mine = made.rows("mine", (sharp[0] + wide[0]) / 2 + lift, (sharp[1] + wide[1]) / 2)
    for groups in (base, base[::-1]):
        found = matched_difference(mine, groups, made, num_resamples=200)
        assert found is not None and found.beyond == 0
        assert found.spread == pytest.approx((sharp[1] + wide[1]).mean() / 2)
        change = found.change
        assert (change.mean, change.low, change.high) == pytest.approx((lift, lift, lift), abs=1e-12)
        assert (change.num_seeds, change.num_scenes) == (SEEDS, SCENES)


def test_a_method_that_only_samples_more_sharply_is_not_told_apart(draw: np.random.Generator) -> None:
    """It beats the wide decoding by much; at equal sharpness that is gone."""
    made = Made()
    base, (sharp, wide) = line(made, draw)
    mine = made.rows("mine", 0.8 * sharp[0] + 0.2 * wide[0] + draw.normal(0, 0.01, (SEEDS, SCENES)), 0 * wide[1] + 1.4)
    found = matched_difference(mine, base, made)
    assert found is not None and found.change.verdict == "open" and abs(found.change.mean) < 0.01


def test_beyond_both_ends_of_the_line_the_end_is_compared_with_and_its_distance_told(draw: np.random.Generator) -> None:
    """The difference is then that of two decodings, paired by seed and scene."""
    made = Made()
    base, (sharp, wide) = line(made, draw)
    for name, (realism, spread), beyond in (("sharper", sharp, -0.5), ("wider", wide, 0.5)):
        mine = realism + draw.normal(0.02, 0.01, realism.shape)
        found = matched_difference(made.rows(name, mine, spread + beyond), base, made)
        assert found is not None and found.beyond == pytest.approx(beyond)
        expected = paired_bootstrap(mine, realism)
        for end in ("mean", "low", "high"):
            assert getattr(found.change, end) == pytest.approx(getattr(expected, end), abs=1e-12)
    assert matched_difference(made.rows("mine", *sharp), base[:1], made) is None, "one decoding makes no line"


def test_scenes_without_a_value_are_left_out_everywhere(draw: np.random.Generator) -> None:
    made = Made()
    base, (sharp, wide) = line(made, draw)
    mine = made.rows("mine", (sharp[0] + wide[0]) / 2 + 0.1, (sharp[1] + wide[1]) / 2)
    made.files["reference 1 2"]["realism"][4] = None
    made.files["mine 0"]["spread"][5] = None
    found = matched_difference(mine, base, made, num_resamples=100)
    assert found is not None and found.change.num_scenes == SCENES - 2 and found.change.low == pytest.approx(0.1)


@pytest.mark.parametrize("missing", ["file", "figure", "seed", "scene"])
def test_what_is_missing_leaves_no_difference(draw: np.random.Generator, missing: str) -> None:
    made = Made()
    base, (sharp, wide) = line(made, draw)
    mine = made.rows("mine", (sharp[0] + wide[0]) / 2, (sharp[1] + wide[1]) / 2)
    if missing == "file":
        del made.files["reference 0 1"]
    elif missing == "figure":
        del made.files["mine 2"]["spread"]
    elif missing == "seed":
        base[1] = base[1][:-1]
    else:
        made.files["reference 0 1"] = {key: each[:-1] for key, each in made.files["reference 0 1"].items()}
    assert matched_difference(mine, base, made) is None


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10_000), points=st.integers(2, 6))
def test_the_line_is_read_as_numpy_interpolates(seed: int, points: int) -> None:
    draw = np.random.default_rng(seed)
    realism, spread = draw.random((points + 1, 20)), draw.random((points + 1, 20)).round(1)
    got = _above(realism, spread)
    for place in range(20):
        xs, ys = spread[1:, place], realism[1:, place]
        if len(set(xs)) < points:
            continue  # two decodings as sharp as each other: either may be taken
        order = np.argsort(xs)
        assert got[place] == pytest.approx(realism[0, place] - np.interp(spread[0, place], xs[order], ys[order]))


if __name__ == "__main__":
    pytest.main([__file__])
