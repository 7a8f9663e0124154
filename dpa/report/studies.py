"""Figures of the studies of rankings: what a distance says about realism, and what its options change."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from dpa.report.canvas import CYCLE, INK, QUIET, blank_figure, calm, save_figure
from dpa.report.statistics import Interval

MARKERS = "os^D"
"""The next one where colours come round again."""


def plot_validity(found: Mapping[str, Mapping[str, Any]], path: str | Path) -> None:
    """Draw realism against mean distance, window by window, for each ranking (figure 3 of the paper).

    Left the curves with their 95 % bands: distance over the scene's mean, realism minus that of rollouts drawn at
    random. Right the rank correlation of both within a scene.

    Args:
        found: for each ranking ``distance`` and ``realism``, an :class:`~dpa.report.statistics.Interval` for each
            window, and ``correlation`` and ``near_half``.
        path: PNG to write.
    """
    figure = blank_figure(10, 4)
    left, right = figure.subplots(1, 2, width_ratios=[1.7, 1])
    left.axhline(0, color=QUIET, lw=1, zorder=1)
    for color, (name, values) in zip(_colours(len(found)), found.items(), strict=True):
        x = [window.mean for window in values["distance"]]
        y = values["realism"]
        left.fill_between(x, [v.low for v in y], [v.high for v in y], color=color, alpha=0.15, lw=0)
        left.plot(x, [v.mean for v in y], "o-", color=color, ms=3.5, lw=1.4, label=name)
    left.set_xlabel("mean distance of the window over the scene's mean", fontsize=8, color=INK)
    left.set_title("realism of a window minus that of random rollouts")
    left.legend(frameon=False, fontsize=8, labelcolor=INK)
    rows = {"all windows": "correlation", "nearer half": "near_half"}
    _dots(right, {title: {name: values[key] for name, values in found.items()} for title, key in rows.items()})
    right.set_title("Spearman of distance and realism in a scene")
    for axes, grid in ((left, "both"), (right, "x")):
        calm(axes, grid)
    save_figure(figure, path)


def plot_references(
    curves: Mapping[str, Sequence[tuple[int, float]]], realism: Mapping[str, Interval | None], path: str | Path
) -> None:
    """Draw how pre-trainings learn, and how realistic that makes them.

    Left the negative log-likelihood of the tuning scenes along the steps, that of the start left out; right realism
    with its 95 % interval over scenes against the lowest of each.

    Args:
        curves: by training, ``(step, NLL per token [nats])``.
        realism: likewise; None where no scene has any.
        path: PNG to write.
    """
    figure = blank_figure(10, 4)
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    for place, (color, (name, curve)) in enumerate(zip(_colours(len(curves)), curves.items(), strict=True)):
        marker = MARKERS[place // len(CYCLE) % len(MARKERS)]
        steps, nll = zip(*(row for row in curve if row[0]), strict=True)
        left.plot(steps, nll, marker, ls="-", color=color, ms=3, lw=1.4, label=name)
        if (value := realism[name]) is not None:
            right.plot([min(nll)] * 2, [value.low, value.high], color=color, lw=1.4, alpha=0.5)
            right.plot(min(nll), value.mean, marker, color=color, ms=6, mec="white", mew=1)
    left.set_xscale("log")
    left.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    left.xaxis.set_major_formatter("{x:,.0f}")
    left.xaxis.set_minor_locator(NullLocator())
    left.set_xlabel("step", fontsize=8, color=INK)
    left.set_title("NLL of the tuning scenes, per token [nats]")
    left.legend(frameon=False, fontsize=7, labelcolor=INK)
    right.set_xlabel("lowest NLL of the tuning scenes", fontsize=8, color=INK)
    right.set_title("realism")
    for axes in (left, right):
        calm(axes, "both")
    save_figure(figure, path)


def plot_gains(
    competence: Mapping[str, Interval], gains: Mapping[str, Mapping[str, Interval]], path: str | Path
) -> None:
    """Draw what methods gain against how good their references are, both with their 95 % intervals.

    Args:
        competence: realism of the reference, by comparison.
        gains: by method and comparison.
        path: PNG to write.
    """
    figure = blank_figure(7, 4.2)
    axes = figure.subplots()
    ends = [end for at in competence.values() for end in (at.low, at.high)]
    apart = 0.01 * (max(ends) - min(ends))  # methods stand side by side, so that one interval does not hide another
    for place, (color, (method, found)) in enumerate(zip(_colours(len(gains)), gains.items(), strict=True)):
        marker = MARKERS[place // len(CYCLE) % len(MARKERS)]
        for number, (name, gain) in enumerate(found.items()):
            at = competence[name].mean + apart * (place - (len(gains) - 1) / 2)
            axes.plot([at] * 2, [gain.low, gain.high], color=color, lw=1.8)
            axes.plot(at, gain.mean, marker, color=color, ms=7, mec="white", mew=1, label=None if number else method)
    for name, at in competence.items():
        axes.plot([at.low, at.high], [0, 0], color=INK, lw=3, alpha=0.25)
        top = max(found[name].high for found in gains.values())
        axes.annotate(name, (at.mean, top), (0, 4), textcoords="offset points", ha="center", fontsize=7, color=INK)
    axes.axhline(0, color=QUIET, lw=1)
    axes.set_xlabel("realism of the reference", fontsize=8, color=INK)
    axes.set_title("gain of realism over it")
    axes.legend(frameon=False, fontsize=8, labelcolor=INK)
    calm(axes, "both")
    save_figure(figure, path)


def plot_sensitivity(
    agreement: Mapping[str, Interval], margins: Sequence[tuple[str, Mapping[str, Interval]]], path: str | Path
) -> None:
    """Draw how far variants of a distance rank as it does, and how that depends on the margin of a pair.

    Args:
        agreement: Spearman with the distance itself, by variant.
        margins: for each range of margins its title and, by variant, the share of pairs in the same order.
        path: PNG to write.
    """
    figure = blank_figure(10.5, 1.1 + 0.3 * len(agreement))
    left, right = figure.subplots(1, 2, sharey=True)
    for row, value in enumerate(agreement.values()):
        left.plot([value.low, value.high], [row, row], color=CYCLE[0], lw=2.2, solid_capstyle="round")
        left.plot(value.mean, row, "o", color=CYCLE[0], ms=6, mec="white", mew=1)
    left.set_yticks(range(len(agreement)), list(agreement))
    left.set_title("rank correlation with the distance (Spearman, 95 %)")
    calm(left, "x")
    shares = np.array([[values[name].mean for _, values in margins] for name in agreement])
    # Half of the pairs agree by chance.
    right.imshow(shares, cmap="Blues", vmin=0.5, vmax=1.3, aspect="auto")
    for (row, column), share in np.ndenumerate(shares):
        right.text(column, row, f"{share:.2f}", ha="center", va="center", fontsize=7.5, color=INK)
    right.set_xticks(range(len(margins)), [title for title, _ in margins])
    right.set_xlabel("gap of a pair's distances over the scene's mean", fontsize=8, color=INK)
    right.set_title("share of pairs in the same order")
    calm(right, "x")
    right.grid(visible=False)
    for axes in (left, right):
        axes.tick_params(axis="y", length=0)
    save_figure(figure, path)


def plot_discriminator(found: Mapping[str, Any], path: str | Path) -> None:
    """Draw what a discriminator ranks rollouts by, beside the preference distance and ADE (figure 10 of the paper).

    Left Spearman of the score with what was measured of a rollout; below 0 the ranking prefers less of it. Right the
    realism of the best and of the worst quarter, minus that of random groups.

    Args:
        found: ``correlation`` by quantity and ranking (None where nothing is ranked), and ``realism`` by ranking,
            ``best`` or ``worst``, and figure.
        path: PNG to write.
    """
    figure = blank_figure(10.5, 4)
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1])
    _dots(left, {quantity: values for quantity, values in found["correlation"].items() if None not in values.values()})
    left.set_title("Spearman of the score with ... in a scene")
    ends = {"best quarter": "best", "worst quarter": "worst"}
    realism = found["realism"]
    _dots(right, {title: {name: realism[name][end]["realism"] for name in realism} for title, end in ends.items()})
    right.set_title("realism minus that of random rollouts")
    for color, name in zip(_colours(len(realism) + 1), [*realism, "random"], strict=True):
        left.plot([], [], "o", color=color, ms=5.5, label=name)
    left.legend(frameon=False, fontsize=8, labelcolor=INK)
    for axes in (left, right):
        calm(axes, "x")
        axes.tick_params(axis="y", length=0)
    save_figure(figure, path)


def _dots(axes: Axes, rows: Mapping[str, Mapping[str, Interval]]) -> None:
    """Means with intervals: a group of rows for each title, in it one for each name."""
    names = list(next(iter(rows.values())))
    step = 0.7 / max(len(names), 1)
    for group, values in enumerate(rows.values()):
        for color, (place, value) in zip(_colours(len(names)), enumerate(values.values()), strict=True):
            y = group + step * (place - (len(names) - 1) / 2)
            axes.plot([value.low, value.high], [y, y], color=color, lw=2, solid_capstyle="round")
            axes.plot(value.mean, y, "o", color=color, ms=5.5, mec="white", mew=1)
    axes.axvline(0, color=QUIET, lw=1, zorder=1)
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)


def _colours(count: int) -> list[str]:
    """As many colours as needed; beyond the palette they come round again."""
    return [CYCLE[i % len(CYCLE)] for i in range(count)]
