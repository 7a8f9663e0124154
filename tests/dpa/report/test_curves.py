"""Curves are read as they were written, and come onto a page in few points."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from torchrl.record.loggers import CSVLogger

from dpa.report.curves import read_curves
from dpa.report.sections.likelihood import blocks


def test_curves_are_read_as_torchrl_writes_them(tmp_path: Path) -> None:
    logger = CSVLogger(exp_name="run", log_dir=str(tmp_path))
    for step in range(3):
        logger.log_scalar("train/loss", 0.5**step, step=step * 10)
    assert read_curves(tmp_path / "run") == {"train/loss": {"step": [0, 10, 20], "value": [1.0, 0.5, 0.25]}}


def test_a_broken_row_is_named_with_file_and_line(tmp_path: Path) -> None:
    (tmp_path / "scalars").mkdir()
    (tmp_path / "scalars" / "loss.csv").write_text("0,1.0\n1\n")
    with pytest.raises(ValueError, match=r"loss\.csv:2: expected 'step,value', got '1'"):
        read_curves(tmp_path)
    with pytest.raises(ValueError, match="no folder 'scalars'"):
        read_curves(tmp_path / "scalars")


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=50), st.integers(1, 20))
def test_blocks_keep_the_sum_of_a_curve_in_no_more_points_than_asked(value: list[float], points: int) -> None:
    step, mean = blocks({"step": list(range(len(value))), "value": value}, points)
    size = -(-len(value) // points)
    sizes = [min(size, len(value) - first) for first in range(0, len(value), size)]
    assert len(mean) == len(step) <= points
    assert sum(m * n for m, n in zip(mean, sizes, strict=True)) == pytest.approx(sum(value), abs=1e-9)


def test_a_value_that_is_not_finite_is_left_out() -> None:
    assert blocks({"step": [1, 2, 3], "value": [1.0, float("nan"), 3.0]}, 5) == ([1.0, 3.0], [1.0, 3.0])


if __name__ == "__main__":
    pytest.main([__file__])
