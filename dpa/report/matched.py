"""Methods at equal sharpness: realism above or below what sharper or wider sampling of the reference reaches."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dpa.report.experiment import Comparison, Decoding, Experiment, in_words
from dpa.report.paired import Rows, scene_values
from dpa.report.statistics import Interval, interval_of, resampled_means
from dpa.report.study import Evaluations
from dpa.report.table import DIFFERENCE_TITLE, MISSING, REFERENCE, difference, number, signed

SHARPNESS = ("method", "decoding", "spread [m]", "beyond [m]", DIFFERENCE_TITLE)
"""Titles of :func:`sharpness_rows`."""
ABOUT_SHARPNESS = (
    "realism minus that of the reference at the same spread of rollouts (root mean square distance of an agent's last "
    "position from its mean over rollouts), read between two of its decodings; where none of them is as sharp (or as "
    "wide), minus that at the nearest, and the method's spread is smaller (larger) by what stands under beyond"
)


class Matched(NamedTuple):
    """A method beside its reference at the same sharpness, or at the nearest that the reference was sampled with.

    Attributes:
        change: of realism, method minus reference.
        spread: of the method's rollouts of a scene [m]: the root mean square distance of an agent's last position from
            its mean over rollouts, the mean over agents, scenes and seeds.
        beyond: by how much it is larger than that of every decoding of the reference [m]; below 0 where it is smaller,
            0 where the reference is read at the same spread.
    """

    change: Interval
    spread: float
    beyond: float


def equal_sharpness(experiment: Experiment, evaluations: Evaluations) -> Iterator[tuple[str, Decoding, Matched]]:
    """Every method at its own best decoding and at the common one, on the scenes that the experiment reports.

    The reference was evaluated there at every decoding of the grid; decodings are chosen on the tuning scenes.

    Args:
        experiment: to show; one that tried a single decoding gives nothing.
        evaluations: figures of every scene.
    """
    compared = (experiment.own_best, experiment.at_common)
    base = reference_line(compared, experiment)
    for method in experiment.methods:
        if method == REFERENCE:
            continue
        for decoding in dict.fromkeys((experiment.chosen[method], experiment.common)):
            mine = _rows(compared, method, decoding)
            if mine and (found := matched_difference(mine, base, evaluations)):
                yield method, decoding, found


def sharpness_rows(experiment: Experiment, evaluations: Evaluations) -> list[list[str]]:
    """:func:`equal_sharpness` as cells of a table with the titles :data:`SHARPNESS`."""
    return [
        [
            experiment.labels[method],
            in_words(decoding),
            number(found.spread, 2),
            signed(found.beyond, 2) if found.beyond else MISSING,
            difference(found.change.mean, (found.change.low, found.change.high)),
        ]
        for method, decoding, found in equal_sharpness(experiment, evaluations)
    ]


def reference_line(compared: Sequence[Comparison], experiment: Experiment) -> list[Rows]:
    """Rows of the reference at every decoding of the grid that one of the comparisons has."""
    return [rows for each in experiment.grid() if (rows := _rows(compared, REFERENCE, each))]


def _rows(compared: Sequence[Comparison], method: str, decoding: Decoding) -> Rows:
    return next((rows for each in compared if (rows := each.of(method, decoding))), [])


def matched_difference(
    mine: Rows, base: Sequence[Rows], evaluations: Evaluations, num_resamples: int = 10_000
) -> Matched | None:
    """Realism of a method at one decoding minus the reference's at the same spread of rollouts.

    The reference at several decodings is a line, realism over the spread of the rollouts of a scene, and is read
    between two of its points; beyond both of its ends, at the end. A method that only samples more sharply lies on that
    line. Each resample draws seeds and scenes as in :func:`~dpa.report.statistics.paired_bootstrap` and makes line and
    point anew.

    Args:
        mine: of the method.
        base: of the reference, one for each decoding.
        evaluations: figures of every scene.
        num_resamples: bootstrap draws.

    Returns:
        None where the line has fewer than two points, or as in :func:`~dpa.report.paired.scene_values`.

    Examples:
        >>> scenes = {
        ...     "sharp": {"realism": [0.6, 0.6], "spread": [1.0, 1.0]},
        ...     "wide": {"realism": [0.5, 0.5], "spread": [3.0, 3.0]},
        ...     "mine": {"realism": [0.7, 0.7], "spread": [2.0, 2.0]},
        ... }
        >>> sharp, wide, mine = ([{"seed": 0, "file": name}] for name in ("sharp", "wide", "mine"))
        >>> found = matched_difference(mine, [sharp, wide], scenes.get)
        >>> round(found.change.mean, 3), found.spread, found.beyond
        (0.15, 2.0, 0.0)
    """
    if len(base) < 2:
        return None
    values = scene_values([mine, *base], ["realism", "spread"], evaluations)
    if values is None:
        return None
    _, _, num_seeds, num_scenes = values.shape
    realism, spread = values.mean((-1, -2))
    drawn = resampled_means(values.reshape(-1, num_seeds, num_scenes), num_resamples).reshape(2, -1, num_resamples)
    above = float(_above(realism[:, None], spread[:, None])[0])
    beyond = spread[0] - spread[0].clip(spread[1:].min(), spread[1:].max())
    return Matched(interval_of(above, _above(*drawn), num_seeds, num_scenes), float(spread[0]), float(beyond))


def _above(realism: NDArray, spread: NDArray) -> NDArray:
    """Height of the first point above the line through the others, ``[points, resamples]`` each."""
    order = np.argsort(spread[1:], axis=0)
    x, y = (np.take_along_axis(each[1:], order, axis=0) for each in (spread, realism))
    left = np.clip((x <= spread[0]).sum(0) - 1, 0, len(x) - 2)[None]
    (x_0, x_1), (y_0, y_1) = ([np.take_along_axis(each, left + k, axis=0)[0] for k in (0, 1)] for each in (x, y))
    width = x_1 - x_0
    share = np.divide(spread[0] - x_0, width, out=np.zeros_like(width), where=width > 0).clip(0, 1)
    return realism[0] - (y_0 + share * (y_1 - y_0))
