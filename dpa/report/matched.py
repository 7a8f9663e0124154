"""Methods at equal sharpness: realism above or below what sharper or wider sampling of the reference reaches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dpa.report.experiment import Comparison, Decoding, Experiment
from dpa.report.paired import Rows, scene_values
from dpa.report.statistics import Interval, interval_of, resampled_means
from dpa.report.study import Evaluations
from dpa.report.table import REFERENCE


def matched(experiment: Experiment, method: str, decoding: Decoding, evaluations: Evaluations) -> Interval | None:
    """:func:`matched_difference` of a method on the tuning scenes, where all decodings of the grid were tried.

    Args:
        experiment: that tried them.
        method: other than the reference.
        decoding: of the method.
        evaluations: figures of every scene.
    """
    tuned = Comparison(experiment.tuning, [])
    base = [rows for each in experiment.grid() if (rows := tuned.of(REFERENCE, each))]
    return matched_difference(tuned.of(method, decoding), base, evaluations)


def matched_difference(
    mine: Rows, base: Sequence[Rows], evaluations: Evaluations, num_resamples: int = 10_000
) -> Interval | None:
    """Realism of a method at one decoding minus the reference's at the same spread of rollouts.

    The reference at several decodings is a line, realism over the mean distance between the rollouts of a scene, and is
    read between two of its points. A method that only samples more sharply lies on that line. Each resample draws
    seeds and scenes as in :func:`~dpa.report.statistics.paired_bootstrap` and makes line and point anew, where a point
    beyond the line's end is compared with that end.

    Args:
        mine: of the method.
        base: of the reference, one for each decoding.
        evaluations: figures of every scene.
        num_resamples: bootstrap draws.

    Returns:
        None where the line has fewer than two points, the point lies beyond both of its ends, or a file or figure is
        missing.

    Examples:
        >>> scenes = {
        ...     "sharp": {"realism": [0.6, 0.6], "spread": [1.0, 1.0]},
        ...     "wide": {"realism": [0.5, 0.5], "spread": [3.0, 3.0]},
        ...     "mine": {"realism": [0.7, 0.7], "spread": [2.0, 2.0]},
        ... }
        >>> sharp, wide, mine = ([{"seed": 0, "file": name}] for name in ("sharp", "wide", "mine"))
        >>> round(matched_difference(mine, [sharp, wide], scenes.get).mean, 3)
        0.15
    """
    if len(base) < 2:
        return None
    values = scene_values([mine, *base], ["realism", "spread"], evaluations)
    if values is None:
        return None
    realism, spread = values.mean((-1, -2)).reshape(2, -1, 1)
    if not spread[1:].min() <= spread[0] <= spread[1:].max():
        return None
    _, _, num_seeds, num_scenes = values.shape
    drawn = resampled_means(values.reshape(-1, num_seeds, num_scenes), num_resamples).reshape(2, -1, num_resamples)
    return interval_of(float(_above(realism, spread)[0]), _above(*drawn), num_seeds, num_scenes)


def _above(realism: NDArray, spread: NDArray) -> NDArray:
    """Height of the first point above the line through the others, ``[points, resamples]`` each."""
    order = np.argsort(spread[1:], axis=0)
    x, y = (np.take_along_axis(each[1:], order, axis=0) for each in (spread, realism))
    left = np.clip((x <= spread[0]).sum(0) - 1, 0, len(x) - 2)[None]
    (x_0, x_1), (y_0, y_1) = ([np.take_along_axis(each, left + k, axis=0)[0] for k in (0, 1)] for each in (x, y))
    width = x_1 - x_0
    share = np.divide(spread[0] - x_0, width, out=np.zeros_like(width), where=width > 0).clip(0, 1)
    return realism[0] - (y_0 + share * (y_1 - y_0))
