"""Any figure of a method minus that of another one, scene by scene, from the files behind their rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpa.report.markup import Html, quiet
from dpa.report.statistics import Interval, paired_bootstrap
from dpa.report.study import Evaluations


def paired_values(
    mine: Sequence[Mapping[str, Any]], base: Sequence[Mapping[str, Any]], key: str, evaluations: Evaluations
) -> NDArray | None:
    """A figure of two methods, paired by seed and scene.

    Args:
        mine: rows of a method, one for each seed, with their ``file``.
        base: rows of the other.
        key: of the figure.
        evaluations: figures of every scene.

    Returns:
        ``[2, seeds, scenes]`` over the scenes where all rows have a value; None where a file or the figure is missing,
        the seeds are others, or no scene is left.
    """
    by_seed = {row["seed"]: row for row in base}
    if not mine or any(row["seed"] not in by_seed for row in mine):
        return None
    values = []
    for rows in (mine, [by_seed[row["seed"]] for row in mine]):
        found = [evaluations(row["file"]) for row in rows]
        if any(scenes is None or key not in scenes for scenes in found):
            return None
        values.append([scenes[key] for scenes in found])
    if len({len(scenes) for side in values for scenes in side}) != 1:
        return None
    both = np.array(values, dtype=float)
    both = both[:, :, ~np.isnan(both).any((0, 1))]
    return both if both.shape[-1] else None


def paired_figure(
    mine: Sequence[Mapping[str, Any]], base: Sequence[Mapping[str, Any]], key: str, evaluations: Evaluations
) -> Interval | None:
    """A figure minus that of another method; arguments, and when it is None, as in :func:`paired_values`."""
    both = paired_values(mine, base, key, evaluations)
    return None if both is None else paired_bootstrap(both[0], both[1])


def quiet_change(found: Interval | None, digits: int = 3) -> Html:
    """A difference below the value that it belongs to; nothing where there is none."""
    return quiet(None, None) if found is None else quiet(found.mean, (found.low, found.high), digits)
