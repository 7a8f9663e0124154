"""The picture of an experiment holds its numbers."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from dpa.report.canvas import VERDICTS
from dpa.report.experiment import Comparison, read_experiment
from dpa.report.figures import plot_comparison
from dpa.report.markup import quiet
from recipes.report import report


def test_the_colour_of_an_interval_says_what_may_be_claimed(runs: Path, tmp_path: Path, drawn: list[Any]) -> None:
    report(runs, tmp_path / "c.png")
    paired = read_experiment(runs / "experiments" / "methods.json").own_best.paired
    forest = drawn[0].axes[0]
    bars = {tuple(line.get_xdata()): line.get_color() for line in forest.lines if len(set(line.get_xdata())) == 2}
    assert set(bars) == {tuple(entry["ci95"]) for entry in paired}
    for (low, high), colour in bars.items():
        assert colour == VERDICTS["better" if low > 0 else "worse" if high < 0 else "open"]
    assert len(set(bars.values())) == 3
    with Image.open(tmp_path / "c.png") as picture:
        assert picture.format == "PNG"


def test_one_training_run_is_drawn_grey_and_not_in_bold(runs: Path, tmp_path: Path, drawn: list[Any]) -> None:
    mine = shutil.copytree(runs, tmp_path / "runs")
    whole = json.loads((mine / "experiments" / "methods.json").read_text())
    for entry in whole["own_best"]["paired"]:
        entry |= {"over": "scenes", "n_seeds": 1}
    (mine / "experiments" / "methods.json").write_text(json.dumps(whole))
    report(mine, tmp_path / "c.png")
    bars = [line for line in drawn[0].axes[0].lines if len(set(line.get_xdata())) == 2]
    assert {line.get_color() for line in bars} == {VERDICTS["open"]}
    experiment = read_experiment(mine / "experiments" / "methods.json")
    records = experiment.own_best.records()
    clear = [r for r in records if r["ci95"] is not None and not r["ci95"][0] <= 0 <= r["ci95"][1]]
    assert clear and not any("<strong>" in quiet(r["realism_difference"], r["ci95"], r["over"]) for r in clear)


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
