"""A picture of an experiment for documents: differences with intervals, and the buckets of realism beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from dpa.report.canvas import CYCLE, INK, QUIET, VERDICTS, blank_figure, calm, save_figure
from dpa.report.experiment import Experiment, decoding_of, in_words
from dpa.report.statistics import verdict
from dpa.report.table import REFERENCE, difference

BUCKETS = (("kinematic", "kinematic"), ("interactive", "interactive"), ("map_based", "map"))


def plot_comparison(experiment: Experiment, path: str | Path) -> None:
    """Draw paired realism differences with their intervals, and beside them the three buckets of every method.

    Each method stands at its own best decoding. A difference of which nothing may be said is grey. In the
    buckets a small dot is a seed, a large one the mean over seeds, and the line marks the reference.

    Args:
        experiment: see :func:`dpa.report.experiment.read_experiment`.
        path: PNG to write.

    Raises:
        ValueError: nothing is compared, or the path is no PNG.
    """
    if not experiment.own_best.paired:
        raise ValueError(f"{experiment.path}: own_best.paired is empty: there is no difference to draw.")
    records = experiment.own_best.records()
    figure = blank_figure(11, 1.1 + 0.42 * len(records))
    panels = figure.subplots(1, 4, sharey=True, width_ratios=[2.4, 1, 1, 1])
    names = [f"{experiment.labels[record['method']]}  ({in_words(decoding_of(record))})" for record in records]
    panels[0].set_yticks(range(len(names)), names)
    panels[0].set_ylim(len(names) - 0.4, -0.6)
    _forest(panels[0], records)
    for axes, (key, title) in zip(panels[1:], BUCKETS, strict=True):
        _bucket(axes, records, experiment.own_best.rows, key, title)
    figure.suptitle(f"{experiment.title}, {experiment.reported}", fontsize=9, color=INK)
    for axes in panels:
        calm(axes, grid="x")
        axes.tick_params(axis="y", length=0)
    save_figure(figure, path)


def _forest(axes: Axes, records: list[dict[str, Any]]) -> None:
    axes.axvline(0, color=QUIET, lw=1, zorder=1)
    for row, record in enumerate(records):
        if record["ci95"] is None:
            continue
        mean, (low, high) = record["realism_difference"], record["ci95"]
        color = VERDICTS[verdict(record["ci95"], record["over"])]
        axes.plot([low, high], [row, row], color=color, lw=2.2, solid_capstyle="round", zorder=2)
        axes.plot(mean, row, "o", color=color, ms=7, mec="white", mew=1, zorder=3)
        text = difference(mean, record["ci95"])
        axes.annotate(
            text, (mean, row), (0, 8), textcoords="offset points", ha="center", fontsize=7.5, color=INK,
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none"},
        )  # fmt: skip
    axes.margins(x=0.15)  # room for the letters of the outermost intervals
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes.set_title("realism minus the reference's, 95 % interval")


def _bucket(axes: Axes, records: list[dict[str, Any]], rows: Sequence[Mapping[str, Any]], key: str, title: str) -> None:
    base = [record[key] for record in records if record["method"] == REFERENCE and record[key] is not None]
    if base:
        axes.axvline(base[0], color=QUIET, lw=1, ls=(0, (3, 3)), zorder=1)
    for position, record in enumerate(records):
        mine = [r for r in rows if r["method"] == record["method"]]
        seeds = [r[key] for r in mine if r.get(key) is not None]
        axes.plot(seeds, [position] * len(seeds), "o", color=CYCLE[0], alpha=0.35, ms=3.5, mew=0)
        if record[key] is not None:
            axes.plot(record[key], position, "o", color=CYCLE[0], ms=7, mec="white", mew=1)
    axes.margins(x=0.15)
    axes.set_title(title)
