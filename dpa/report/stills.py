"""Figures of the page as pictures, for loggers and documents: the same traces, drawn by Matplotlib."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import unescape
from pathlib import Path

import plotly.graph_objects as go
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from dpa.report.canvas import INK, QUIET, blank_figure, calm, save_figure
from dpa.report.charts import Chart, palette
from dpa.report.experiment import Experiment
from dpa.report.sections.compute import compute_charts
from dpa.report.sections.likelihood import training_charts
from dpa.report.sections.results import matched_curves
from dpa.report.sections.scaling import scaling_charts
from dpa.report.study import Evaluations

FIGURES = ("sharpness", "scaling", "compute", "likelihood", "health")
"""Names of :func:`experiment_charts`."""
DASHES = {None: "-", "solid": "-", "dot": ":", "dash": "--"}
POINT = 0.75
"""Points of Matplotlib in a pixel of the page."""
WITHIN = 6
"""Most entries of a legend that stands within the axes."""


def experiment_charts(experiment: Experiment, folder: Path) -> dict[str, list[Chart]]:
    """The figures of an experiment that have lines, by name (:data:`FIGURES`); one that it does not have is left out.

    Args:
        experiment: to show.
        folder: of the study.

    Returns:
        ``sharpness``: realism over the spread of rollouts; ``scaling``: figure 7 of the paper; ``compute``: realism
        over minutes; ``likelihood``: its figures 4 and 6; ``health``: logits, saturation, KL, entropy and pair accuracy
        along training.
    """
    colours = palette(experiment.methods)
    likelihood, health = training_charts(experiment, folder, colours)
    charts = (
        matched_curves(experiment, colours, Evaluations(folder)),
        scaling_charts(experiment, colours),
        compute_charts(experiment, colours),
        likelihood,
        health,
    )
    return {name: found for name, found in zip(FIGURES, charts, strict=True) if found}


def draw_charts(charts: Sequence[Chart], path: str | Path) -> None:
    """Draw figures of lines side by side, as they stand on the page.

    Args:
        charts: from :func:`dpa.report.charts.curves`.
        path: PNG to write.

    Raises:
        ValueError: no chart, or the path is no PNG.

    Examples:
        >>> import tempfile
        >>> from dpa.report.charts import Line, curves
        >>> chart = curves([Line("a", [0, 1], [0.5, 0.6], "#2a78b5")], "Realism", x="step", y="realism")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     draw_charts([chart], Path(folder) / "realism.png")
        ...     [path.name for path in Path(folder).iterdir()]
        ['realism.png']
    """
    if not charts:
        raise ValueError(f"{path}: there is no figure to draw.")
    save_figure(_drawn(charts), path)


def _drawn(charts: Sequence[Chart]) -> Figure:
    columns = min(len(charts), 3)
    rows = math.ceil(len(charts) / columns)
    width, height = (8.0, 4.4) if len(charts) == 1 else (4.4 * columns, 3.4 * rows)
    figure = blank_figure(width, height)
    places = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, chart in zip(places, charts, strict=False):
        _draw(axes, chart)
    for axes in places[len(charts) :]:
        axes.set_visible(False)
    named = [axes for axes, chart in zip(places, charts, strict=False) if chart.figure.layout.showlegend]
    entries = {label: line for axes in named for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    look = {"frameon": False, "fontsize": 7, "labelcolor": INK}
    if len(charts) == 1 and 1 < len(entries) <= WITHIN:
        places[0].legend(**look)
    elif entries:  # of all figures, below them
        columns = min(len(entries), round(figure.get_figwidth() / 2.6))
        figure.legend(entries.values(), entries, loc="outside lower left", ncols=columns, **look)
    return figure


def _draw(axes: Axes, chart: Chart) -> None:
    for trace in chart.figure.data:
        _trace(axes, trace)
    layout = chart.figure.layout
    calm(axes, grid="both")
    axes.set_title(chart.title, fontsize=9, color=INK, loc="left")
    axes.set_xlabel(_plain(layout.xaxis.title.text), fontsize=8, color=INK)
    axes.set_ylabel(_plain(layout.yaxis.title.text), fontsize=8, color=INK)
    if layout.xaxis.type == "log":
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(FixedLocator(layout.xaxis.tickvals))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_locator(NullLocator())
    if layout.yaxis.zeroline:
        axes.axhline(0, color=QUIET, lw=0.8, zorder=1)
    if layout.yaxis.rangemode == "nonnegative":
        axes.set_ylim(bottom=0)


def _trace(axes: Axes, trace: go.Scatter) -> None:
    named = _plain(trace.name) if trace.showlegend is not False and trace.name else None
    if trace.fill == "toself":
        axes.fill(trace.x, trace.y, color=trace.fillcolor, alpha=trace.opacity, lw=0)
        return
    y = [math.nan if value is None else value for value in trace.y]
    look: Mapping[str, object] = {"color": trace.line.color, "alpha": trace.opacity}
    mode = trace.mode or ""
    style = DASHES[trace.line.dash] if "lines" in mode else "none"
    axes.plot(trace.x, y, ls=style, lw=POINT * (trace.line.width or 0), label=named, **look)
    if "markers" in mode:
        size = trace.marker.size
        sizes = [size] * len(y) if isinstance(size, (int, float)) else list(size)
        areas = [(POINT * each) ** 2 for each in sizes]
        axes.scatter(trace.x, y, areas, color=trace.line.color, edgecolors="white", linewidths=0.6, zorder=3)
    if trace.error_y.array is not None:
        reach = [trace.error_y.arrayminus, trace.error_y.array]
        axes.errorbar(trace.x, y, reach, fmt="none", elinewidth=1, capsize=2, **look)
    for x, value, text in zip(trace.x, y, trace.text or (), strict=False):
        axes.annotate(_plain(text), (x, value), (3, 3), textcoords="offset points", fontsize=7, color=trace.line.color)


def _plain(text: str | None) -> str:
    return unescape((text or "").replace("<br>", " "))
