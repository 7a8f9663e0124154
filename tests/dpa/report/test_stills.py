"""Figures of the page as pictures: the same numbers, names and marks, and one sentence where there is none to draw."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from PIL import Image

from dpa.report.charts import Chart, Line, curves, palette
from dpa.report.experiment import read_experiment
from dpa.report.sections.compute import compute_charts
from dpa.report.stills import FIGURES, _drawn, draw_charts, experiment_charts
from dpa.report.study import read_study
from recipes.report import report
from tests.dpa.report.runs import write_runs


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_runs(tmp_path_factory.mktemp("study"))


def drawn(chart: Chart) -> Axes:
    (axes,) = _drawn([chart]).axes
    return axes


def test_an_experiment_has_the_figures_that_its_page_has(runs: Path) -> None:
    study = read_study(runs)
    found = {name: list(experiment_charts(each, runs)) for name, each in study.experiments.items()}
    assert found == {
        "methods": ["sharpness", "compute", "likelihood", "health"],
        "scaling": list(FIGURES),
        "steps": list(FIGURES),
    }


def test_realism_stands_over_the_minutes_that_a_method_took_until_then(runs: Path) -> None:
    found = read_experiment(runs / "experiments/steps.json")
    (chart,) = experiment_charts(found, runs)["compute"]
    axes = drawn(chart)
    steps = found.own_best.steps
    for line in axes.get_lines():
        base = next((m for m in found.compute if found.labels[m] == line.get_label()), None)
        if base is None:
            continue
        policies = sorted((m for m in found.methods if m.partition("@")[0] == base), key=lambda m: steps[m])
        assert line.get_xdata() == pytest.approx([5 + 10 * steps[m] / 60 for m in policies])
        gains = [found.own_best.entry(m)["realism_difference"] for m in policies]
        assert line.get_ydata() == pytest.approx(gains)
    assert {line.get_label() for line in axes.get_lines()} >= {found.labels[m] for m in found.compute}
    assert not compute_charts(replace(found, compute={}), palette(found.methods)), "of older results nothing is known"


def test_what_a_method_rolled_out_and_was_paid_has_figures_of_its_own(tmp_path: Path) -> None:
    runs = write_runs(tmp_path)
    found = read_experiment(runs / "experiments/methods.json")
    before = {chart.title for chart in experiment_charts(found, runs)["health"]}
    scalars = runs / found.curves["dpa_omf"]["0"] / "scalars/train"
    for name, values in (("rollout_spread", (7.5, 6.0)), ("reward_realism", (-0.1, 0.2))):
        (scalars / f"{name}.csv").write_text("".join(f"{step},{value}\n" for step, value in enumerate(values, 1)))
    health = {chart.title: drawn(chart) for chart in experiment_charts(found, runs)["health"]}
    assert health.keys() - before == {"Own rollouts: how far apart they end", "Reward: realism"}
    (line,) = health["Reward: realism"].get_lines()[:1]
    assert list(line.get_ydata()) == [-0.1, 0.2] and health["Reward: realism"].get_ylim()[0] < -0.1


def test_lines_have_their_values_gaps_names_and_colours() -> None:
    lines = [
        Line("a < b", [0, 1, 2], [0.5, None, 0.7], "#2a78b5", dash="dot", markers=[6, 6, 15]),
        Line("a < b", [0, 2], [0.4, 0.6], "#2a78b5", legend=False, markers=0),
        Line("other", [0, 2], [0.1, 0.2], "#d55e00"),
    ]
    axes = drawn(curves(lines, "Realism", x="step", y="realism", zero=True))
    first, second, *_ = axes.get_lines()
    np.testing.assert_array_equal(first.get_ydata(), [0.5, np.nan, 0.7])
    assert (first.get_linestyle(), first.get_color(), second.get_linestyle()) == (":", "#2a78b5", "-")
    legend = axes.get_legend()
    assert legend is not None and [text.get_text() for text in legend.get_texts()] == ["a < b", "other"]
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title(loc="left")) == ("step", "realism", "Realism")
    assert any(list(line.get_ydata()) == [0, 0] for line in axes.get_lines()), "y = 0 is marked"
    sizes = axes.collections[0].get_sizes()
    assert sizes[2] / sizes[0] == pytest.approx((15 / 6) ** 2), "markers are as large beside each other as on the page"


def test_many_figures_or_many_lines_have_one_legend_below_them_and_each_method_a_colour() -> None:
    names = [f"method {number}" for number in range(14)]
    colours = palette(["reference", *names])
    assert len(set(colours.values())) == 15
    chart = curves([Line(name, [0, 1], [0, 1], colours[name]) for name in names], "Many", x="step", y="realism")
    for charts in ([chart], [chart, chart]):
        figure = _drawn(charts)
        assert all(axes.get_legend() is None for axes in figure.axes)
        (legend,) = figure.legends
        assert [text.get_text() for text in legend.get_texts()] == names


def test_bars_reach_as_far_as_on_the_page_and_a_logarithmic_axis_has_a_tick_at_each_place() -> None:
    line = Line("r", [0.25, 1, 8], [0.1, 0.2, 0.3], "#2a78b5", error=([0.01, 0.02, 0.03], [0.04, 0.05, 0.06]))
    axes = drawn(curves([line], "Scaling", x="rankings", y="difference", log_x=True, nonnegative=True))
    (bars,) = axes.containers
    ends = [segment[:, 1].tolist() for segment in bars[2][0].get_segments()]
    np.testing.assert_allclose(ends, [[0.06, 0.11], [0.15, 0.22], [0.24, 0.33]])
    assert axes.get_xticks().tolist() == [0.25, 1, 8] and axes.get_xscale() == "log"
    assert axes.get_ylim()[0] == 0 and axes.get_legend() is None, "one line needs no legend"


def test_figures_stand_side_by_side_in_rows_of_three(tmp_path: Path) -> None:
    chart = curves([Line("a", [0, 1], [0, 1], "#2a78b5")], "A", x="x", y="y")
    sizes = []
    for count in (1, 3, 4):
        draw_charts([chart] * count, tmp_path / "charts.png")
        with Image.open(tmp_path / "charts.png") as picture:
            sizes.append(picture.size)
    assert sizes[1][0] == sizes[2][0] > sizes[0][0] and sizes[2][1] == 2 * sizes[1][1]
    with pytest.raises(ValueError, match="no figure to draw"):
        draw_charts([], tmp_path / "none.png")
    with pytest.raises(ValueError, match=r"must end in \.png"):
        draw_charts([chart], tmp_path / "charts.svg")


def test_a_figure_is_drawn_by_name_and_one_that_is_not_there_is_told(runs: Path, tmp_path: Path) -> None:
    report(runs, tmp_path / "differences.png", "methods")
    report(runs, tmp_path / "sharpness.png", "methods", "sharpness")
    assert (tmp_path / "sharpness.png").read_bytes() != (tmp_path / "differences.png").read_bytes()
    told = "--figure=scaling: experiment 'methods' in .* has differences, sharpness, compute, likelihood, health"
    with pytest.raises(ValueError, match=told):
        report(runs, tmp_path / "scaling.png", "methods", "scaling")
    with pytest.raises(ValueError, match=r"--figure=health is for a picture.png; tables.md shows all of them"):
        report(runs, tmp_path / "tables.md", figure="health")
    assert {path.name for path in tmp_path.iterdir()} == {"differences.png", "sharpness.png"}


if __name__ == "__main__":
    pytest.main([__file__])
