"""Any figure of a method minus that of another one, scene by scene, from the files behind their rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpa.report.markup import Html, html, joined, quiet, stacked
from dpa.report.statistics import Interval, paired_bootstrap
from dpa.report.table import MISSING, number

Rows = Sequence[Mapping[str, Any]]
"""Rows of a method at one decoding, one for each seed, with their ``file``."""
Evaluated = Callable[[str], Mapping[str, Sequence[float | None]] | None]
"""Figures of every scene of a file, such as :class:`~dpa.report.study.Evaluations` reads; None if it is not there."""


class Cell(NamedTuple):
    """A figure of a method: its mean over seeds, the difference from another method, and how many digits it has."""

    mean: float | None
    change: Interval | None = None
    digits: int = 3


def scene_values(groups: Sequence[Rows], figures: Sequence[str], evaluations: Evaluated) -> NDArray | None:
    """Figures of several methods or decodings, paired by seed and scene.

    Args:
        groups: rows of each; the seeds are those of the first.
        figures: keys of what is asked for.
        evaluations: figures of every scene.

    Returns:
        ``[figures, groups, seeds, scenes]`` over the scenes where all rows have all values; None where a file, a seed
        or a figure is missing, numbers of scenes differ, or no scene is left.
    """
    seeds = [row["seed"] for row in groups[0]]
    files = [{row["seed"]: row["file"] for row in rows} for rows in groups]
    if not seeds or any(seed not in each for each in files for seed in seeds):
        return None
    found = [[evaluations(each[seed]) for seed in seeds] for each in files]
    if any(scenes is None or key not in scenes for runs in found for scenes in runs for key in figures):
        return None
    if len({len(scenes[key]) for runs in found for scenes in runs for key in figures}) != 1:
        return None
    values = np.array([[[scenes[key] for scenes in runs] for runs in found] for key in figures], dtype=float)
    values = values[..., ~np.isnan(values).any((0, 1, 2))]
    return values if values.shape[-1] else None


def paired_values(mine: Rows, base: Rows, key: str, evaluations: Evaluated) -> NDArray | None:
    """A figure of two methods, ``[2, seeds, scenes]``; None as in :func:`scene_values`."""
    values = scene_values([mine, base], [key], evaluations)
    return None if values is None else values[0]


def paired_figure(mine: Rows, base: Rows, key: str, evaluations: Evaluated) -> Interval | None:
    """A figure minus that of another method, with its interval; None as in :func:`scene_values`."""
    both = paired_values(mine, base, key, evaluations)
    return None if both is None else paired_bootstrap(both[0], both[1])


def quiet_change(found: Interval | None, digits: int = 3) -> Html:
    """A difference below the value that it belongs to; nothing where there is none."""
    return Html("") if found is None else quiet(found.mean, (found.low, found.high), found.over, digits)


def with_change(cell: Cell) -> Html:
    """A figure and, below it, its difference."""
    return joined([number(cell.mean, cell.digits), quiet_change(cell.change, cell.digits)], "")


def stacked_change(found: Interval | None) -> Html:
    """A difference above its interval, for a column of its own; a dash where there is none."""
    return html(MISSING) if found is None else stacked(found.mean, (found.low, found.high), found.over)
