"""The picture of an experiment holds its numbers."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from dpa.report import figures
from dpa.report.experiment import Comparison, read_experiment
from dpa.report.figures import plot_comparison
from recipes.report import report


def test_the_forest_draws_each_interval_and_greys_those_with_zero(runs: Path, tmp_path: Path, drawn: list[Any]) -> None:
    report(runs, tmp_path / "c.png")
    paired = read_experiment(runs / "experiments" / "methods.json").own_best.paired
    forest = drawn[0].axes[0]
    bars = {tuple(line.get_xdata()): line.get_color() for line in forest.lines if len(set(line.get_xdata())) == 2}
    assert set(bars) == {tuple(entry["ci95"]) for entry in paired}
    for (low, high), colour in bars.items():
        assert colour == (figures.POSITIVE if low > 0 else figures.NEGATIVE if high < 0 else figures.NEUTRAL)
    assert len(set(bars.values())) == 3
    with Image.open(tmp_path / "c.png") as picture:
        assert picture.format == "PNG"


def test_the_picture_is_of_the_experiment_that_is_named(runs: Path, tmp_path: Path, drawn: list[Any]) -> None:
    mine = shutil.copytree(runs, tmp_path / "runs")
    whole = json.loads((mine / "experiments" / "methods.json").read_text())
    whole["own_best"]["paired"] = whole["own_best"]["paired"][:1]
    (mine / "experiments" / "short.json").write_text(json.dumps(whole))
    for name, bars in ((None, 3), ("methods", 3), ("short", 1)):
        report(mine, tmp_path / "c.png", name)
        assert sum(len(set(line.get_xdata())) == 2 for line in drawn[-1].axes[0].lines) == bars
    with pytest.raises(ValueError, match=r"runs has no experiment 'mine'; it has methods, scaling, short, steps\."):
        report(mine, tmp_path / "d.png", "mine")
    with pytest.raises(ValueError, match=r"--experiment=short is for a picture.png; tables.md shows all of them"):
        report(mine, tmp_path / "tables.md", "short")


def test_nothing_to_compare_is_refused(runs: Path, tmp_path: Path) -> None:
    experiment = read_experiment(runs / "experiments" / "methods.json")
    with pytest.raises(ValueError, match=r"own_best\.paired is empty"):
        plot_comparison(dataclasses.replace(experiment, own_best=Comparison([], [])), tmp_path / "c.png")
    with pytest.raises(ValueError, match=r"\.png"):
        plot_comparison(experiment, tmp_path / "c.svg")
    assert not list(tmp_path.iterdir())


if __name__ == "__main__":
    pytest.main([__file__])
