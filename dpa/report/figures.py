"""Figures of a comparison: differences with intervals, training curves, and rollouts beside the log."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from torch import Tensor

from dpa.report.canvas import CYCLE, INK, NEGATIVE, NEUTRAL, POSITIVE, QUIET, blank_figure, calm, save_figure
from dpa.report.table import REFERENCE, difference, summarise
from envs.render import draw_agents, draw_map, draw_trails, fit_view, frame_view, pose_tracks
from envs.scene import CURRENT_STEP, LOG_STEPS, Scene

BUCKETS = (("kinematic", "kinematic"), ("interactive", "interactive"), ("map_based", "map"))

Curve = Mapping[str, Sequence[float]]
"""``{"step": [...], "value": [...]}``."""


def plot_comparison(comparison: Mapping[str, Any], path: str | Path) -> None:
    """Draw paired realism differences with their intervals, and beside them the three buckets of every method.

    A difference whose interval contains zero is grey: no claim. In the buckets a small dot is a seed, a large one the
    mean over seeds, and the line marks the reference.

    Args:
        comparison: see :mod:`dpa.report`; ``rows`` and ``paired`` are read.
        path: PNG to write.

    Raises:
        ValueError: nothing is compared, or a paired entry that fits no row.
    """
    records = summarise(comparison["rows"], comparison["paired"])
    if not comparison["paired"]:
        raise ValueError("comparison['paired'] is empty: there is no difference to draw.")
    figure = blank_figure(11, 1.1 + 0.42 * len(records))
    panels = figure.subplots(1, 4, sharey=True, width_ratios=[2.4, 1, 1, 1])
    names = [_label(record) for record in records]
    panels[0].set_yticks(range(len(names)), names)
    panels[0].set_ylim(len(names) - 0.4, -0.6)
    _forest(panels[0], records)
    for axes, (key, title) in zip(panels[1:], BUCKETS, strict=True):
        _bucket(axes, records, comparison["rows"], key, title)
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
        color = POSITIVE if low > 0 else NEGATIVE if high < 0 else NEUTRAL
        axes.plot([low, high], [row, row], color=color, lw=2.2, solid_capstyle="round", zorder=2)
        axes.plot(mean, row, "o", color=color, ms=7, mec="white", mew=1, zorder=3)
        text = difference(mean, record["ci95"])
        axes.annotate(
            text, (mean, row), (0, 8), textcoords="offset points", ha="center", fontsize=7.5, color=INK,
            bbox={"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none"},
        )  # fmt: skip
    axes.margins(x=0.15)  # room for the letters of the outermost intervals
    axes.set_title("realism minus the reference's, 95 % interval")


def _bucket(axes: Axes, records: list[dict[str, Any]], rows: Sequence[Mapping[str, Any]], key: str, title: str) -> None:
    base = [record[key] for record in records if record["method"] == REFERENCE and record[key] is not None]
    if base:
        axes.axvline(base[0], color=QUIET, lw=1, ls=(0, (3, 3)), zorder=1)
    for position, record in enumerate(records):
        mine = [r for r in rows if (r["method"], r.get("top_p")) == (record["method"], record["top_p"])]
        seeds = [r[key] for r in mine if r.get(key) is not None]
        axes.plot(seeds, [position] * len(seeds), "o", color=CYCLE[0], alpha=0.35, ms=3.5, mew=0)
        if record[key] is not None:
            axes.plot(record[key], position, "o", color=CYCLE[0], ms=7, mec="white", mew=1)
    axes.margins(x=0.15)
    axes.set_title(title)


def read_curves(folder: str | Path) -> dict[str, dict[str, list[float]]]:
    """Read the scalars that a TorchRL ``CSVLogger`` wrote for one experiment.

    Args:
        folder: ``<log_dir>/<exp_name>``; its ``scalars`` folder holds one file of ``step,value`` rows for each scalar,
            in sub-folders where the name has slashes.

    Returns:
        ``{name: {"step": [...], "value": [...]}}``, in order of name.

    Raises:
        ValueError: no such folder, or a row that is not ``step,value``; the message names file and line.
    """
    scalars = Path(folder) / "scalars"
    if not scalars.is_dir():
        raise ValueError(f"{folder} has no folder 'scalars'; give the experiment folder of a CSVLogger.")
    curves: dict[str, dict[str, list[float]]] = {}
    for file in sorted(scalars.rglob("*.csv")):
        curve: dict[str, list[float]] = {"step": [], "value": []}
        with file.open(newline="") as rows:
            for line, row in enumerate(csv.reader(rows), start=1):
                try:
                    step, value = row
                    curve["step"].append(int(step))
                    curve["value"].append(float(value))
                except ValueError as error:
                    raise ValueError(f"{file}:{line}: expected 'step,value', got {','.join(row)!r}.") from error
        curves[file.relative_to(scalars).with_suffix("").as_posix()] = curve
    return curves


def plot_curves(logs: Mapping[str, Mapping[str, Curve]], path: str | Path, *, smooth: int = 20) -> None:
    """Draw training curves: a panel for each scalar, a line for each run.

    Args:
        logs: ``{run: {scalar: {"step": [...], "value": [...]}}}``, each run as :func:`read_curves` gives it.
        path: PNG to write.
        smooth: a curve of more than this many points is drawn pale, and over it the mean of the last so many values.

    Raises:
        ValueError: no scalar, or step and value of different lengths.
    """
    scalars = list(dict.fromkeys(name for run in logs.values() for name in run))
    if not scalars:
        raise ValueError("there is no curve to draw: no run has a scalar.")
    columns = min(3, len(scalars))
    rows = math.ceil(len(scalars) / columns)
    figure = blank_figure(3.7 * columns, 2.4 * rows + 0.4)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, scalar in zip(panels, scalars, strict=False):
        for index, (run, curves) in enumerate(logs.items()):
            if scalar in curves:
                _curve(axes, curves[scalar], f"{run}: {scalar}", run, CYCLE[index % len(CYCLE)], smooth)
        axes.set_title(scalar)
        calm(axes, grid="y")
    for axes in panels[len(scalars) :]:
        axes.set_axis_off()
    handles = {line.get_label(): line for axes in panels for line in axes.get_lines()}
    handles = {label: line for label, line in handles.items() if not label.startswith("_")}
    if len(handles) > 1:
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=min(6, len(handles)), frameon=False
        )
    save_figure(figure, path)


def _curve(axes: Axes, curve: Curve, name: str, run: str, color: str, smooth: int) -> None:
    step, value = np.asarray(curve["step"], float), np.asarray(curve["value"], float)
    if step.shape != value.shape:
        raise ValueError(f"{name}: {len(step)} steps but {len(value)} values.")
    if len(value) <= smooth:
        axes.plot(step, value, color=color, lw=1.4, marker="o" if len(value) < 3 else "", ms=3, label=run)
        return
    axes.plot(step, value, color=color, lw=0.6, alpha=0.25)
    total = np.concatenate(([0.0], np.cumsum(value)))
    last = np.arange(1, len(value) + 1)
    first = np.maximum(last - smooth, 0)
    axes.plot(step, (total[last] - total[first]) / (last - first), color=color, lw=1.5, label=run)


def plot_scenes(
    scenes: Sequence[Scene], trajectories: Mapping[str, Sequence[Tensor]], path: str | Path, *, step: int = CURRENT_STEP
) -> None:
    """Draw scenes as rows; the log and every method as columns (METHOD figures 5 and 9).

    Args:
        scenes: uncollated scenes.
        trajectories: for each method one tensor for each scene, ``[A', T, 3 or 4]`` or, for several rollouts laid over
            each other, ``[R, A', T, 3 or 4]``; see :func:`envs.render.pose_tracks`.
        path: PNG to write.
        step: at which the boxes stand; paths lead on from it.

    Raises:
        ValueError: a method without a tensor for each scene, or trajectories that do not fit their scene.
    """
    for method, given in trajectories.items():
        if len(given) != len(scenes):
            raise ValueError(f"{method}: {len(given)} trajectories for {len(scenes)} scenes; give one for each.")
    if not scenes:
        raise ValueError("there is no scene to draw.")
    columns = 1 + len(trajectories)
    figure = blank_figure(3.2 * columns, 3.2 * len(scenes) + 0.3)
    panels = figure.subplots(len(scenes), columns, squeeze=False)
    for row, scene in enumerate(scenes):
        _scene_panel(panels[row, 0], scene, [pose_tracks(scene)], step)
        panels[row, 0].set_ylabel(scene.scene_id, fontsize=8, color=QUIET)
        for axes, given in zip(panels[row, 1:], trajectories.values(), strict=True):
            rollouts = given[row] if given[row].ndim == 4 else given[row][None]
            _scene_panel(axes, scene, [pose_tracks(scene, rollout) for rollout in rollouts], step)
    for axes, title in zip(panels[0], ("log", *trajectories), strict=True):
        axes.set_title(title, fontsize=10, color=INK)
    save_figure(figure, path)


def _scene_panel(axes: Axes, scene: Scene, tracks: Sequence[Tensor], step: int) -> None:
    frame_view(axes, fit_view(scene))
    draw_map(axes, scene)
    for track in tracks:
        draw_trails(axes, scene, track, step, LOG_STEPS - 1, alpha=0.9 / math.sqrt(len(tracks)), width=1.2)
    draw_agents(axes, scene, tracks[0], step)


def _label(record: Mapping[str, Any]) -> str:
    return record["method"] if record["top_p"] is None else f"{record['method']}  p {record['top_p']:g}"
