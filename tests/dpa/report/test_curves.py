"""Curves come onto a page in few points."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpa.report.sections.likelihood import blocks


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=50), st.integers(1, 20))
def test_blocks_keep_the_sum_of_a_curve_in_no_more_points_than_asked(value: list[float], points: int) -> None:
    step, mean = blocks(list(enumerate(value)), points)
    size = -(-len(value) // points)
    sizes = [min(size, len(value) - first) for first in range(0, len(value), size)]
    assert len(mean) == len(step) <= points
    assert sum(m * n for m, n in zip(mean, sizes, strict=True)) == pytest.approx(sum(value), abs=1e-9)


def test_a_value_that_is_not_finite_is_left_out() -> None:
    assert blocks([(1, 1.0), (2, float("nan")), (3, 3.0)], 5) == ([1.0, 3.0], [1.0, 3.0])


if __name__ == "__main__":
    pytest.main([__file__])
