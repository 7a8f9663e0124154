"""Figures come out as pictures that hold the numbers, and say what does not fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torchrl.record.loggers import CSVLogger

from dpa.report import figures
from dpa.report.figures import plot_comparison, plot_curves, plot_scenes, read_curves
from envs.sources.synthetic import straight_road, two_cars_head_on


def test_the_forest_draws_each_interval_and_greys_those_with_zero(
    comparison: dict[str, Any], tmp_path: Path, drawn: list[Any]
) -> None:
    plot_comparison(comparison, tmp_path / "c.png")
    forest = drawn[0].axes[0]
    bars = {tuple(line.get_xdata()): line.get_color() for line in forest.lines if len(set(line.get_xdata())) == 2}
    assert bars == {(0.006, 0.03): figures.POSITIVE, (-0.004, 0.01): figures.NEUTRAL}
    assert len(drawn[0].axes) == 4
    with Image.open(tmp_path / "c.png") as picture:
        assert picture.format == "PNG"


def test_nothing_to_compare_is_refused(comparison: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="paired"):
        plot_comparison({**comparison, "paired": []}, tmp_path / "c.png")
    assert not list(tmp_path.iterdir())


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


def test_a_long_curve_is_smoothed_over_its_past_and_a_short_one_is_drawn_as_it_is(
    tmp_path: Path, drawn: list[Any]
) -> None:
    value = [0.0] * 30 + [1.0] * 30
    logs = {"run": {"long": {"step": list(range(60)), "value": value}, "short": {"step": [0, 1], "value": [1.0, 2.0]}}}
    plot_curves(logs, tmp_path / "c.png", smooth=10)
    long, short = drawn[0].axes[:2]
    smooth = long.lines[1].get_ydata()
    np.testing.assert_allclose(smooth[[0, 29, 34, 39, 59]], [0, 0, 0.5, 1, 1])
    assert [line.get_ydata().tolist() for line in short.lines] == [[1.0, 2.0]]


def test_curves_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="run: loss: 2 steps but 1 values"):
        plot_curves({"run": {"loss": {"step": [0, 1], "value": [1.0]}}}, tmp_path / "c.png")
    with pytest.raises(ValueError, match="no curve"):
        plot_curves({"run": {}}, tmp_path / "c.png")


def test_scenes_are_rows_and_log_and_methods_are_columns(tmp_path: Path, drawn: list[Any]) -> None:
    scenes = [straight_road(2), two_cars_head_on()]
    one, many = [torch.zeros(2, 80, 3)] * 2, [torch.zeros(3, 2, 80, 4)] * 2
    plot_scenes(scenes, {"reference": one, "DPA-OMF": many}, tmp_path / "s.png")
    axes = drawn[0].axes
    assert [panel.get_title() for panel in axes] == ["log", "reference", "DPA-OMF", "", "", ""]
    assert [panel.get_ylabel() for panel in axes[::3]] == [scene.scene_id for scene in scenes]
    with pytest.raises(ValueError, match="DPA-OMF: 1 trajectories for 2 scenes"):
        plot_scenes(scenes, {"DPA-OMF": many[:1]}, tmp_path / "s.png")


def test_a_figure_is_a_png(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\.png"):
        plot_scenes([straight_road()], {}, tmp_path / "s.svg")


if __name__ == "__main__":
    pytest.main([__file__])
