"""Safety of an experiment's methods, in measures that share nothing with the features of the preference distance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dpa.report.experiment import Comparison, Experiment, decoding_of, in_words
from dpa.report.markup import Html, element, hint, joined, table
from dpa.report.statistics import Interval, paired_bootstrap
from dpa.report.study import Evaluations
from dpa.report.table import REFERENCE, number, signed

SAFETY = {
    "collision_rate": "collision", "offroad_rate": "off-road", "wrong_way": "wrong way", "red_light": "red light",
    "close_pass": "close pass", "harsh_jerk": "harsh jerk",
}  # fmt: skip
RESAMPLES = 2_000
"""Draws for an interval: its ends are read to two digits."""


def safety_table(experiment: Experiment, comparison: Comparison, evaluations: Evaluations) -> Html:
    """Rates of every method, and their paired differences from the reference where the scenes' values are there.

    Args:
        experiment: to show.
        comparison: one of its two.
        evaluations: figures of every scene.
    """
    records = [record for method in experiment.methods for record in comparison.records() if record["method"] == method]
    measured = [key for key in SAFETY if any(record.get(key) is not None for record in records)]
    if not measured:
        return Html("")
    base = _base(comparison, experiment)
    rows = []
    for record in records:
        mine = comparison.of(record["method"], decoding_of(record))
        cells = []
        for key in measured:
            found = None if mine == base else paired_rate(mine, base, key, evaluations)
            cells.append(joined([number(record.get(key), 3), _change(found)], ""))
        name = experiment.label(record["method"])
        if record["method"] == REFERENCE and mine != base:
            name += f", {in_words(decoding_of(record))}"
        rows.append([name, *cells])
    return joined(
        [
            element("h3", "Safety"),
            table(["method", *(f"{SAFETY[key]}\N{NO-BREAK SPACE}↓" for key in measured)], rows),
            hint(
                "Means over seeds and scenes. Below each its difference from the reference, with a 95 % interval over "
                "the scenes where all have a value; bold where the interval does not contain 0."
            ),
        ]
    )


def paired_rate(
    mine: Sequence[Mapping[str, Any]], base: Sequence[Mapping[str, Any]], key: str, evaluations: Evaluations
) -> Interval | None:
    """A figure minus that of the reference, paired by seed and scene.

    Args:
        mine: rows of a method, one for each seed.
        base: rows of the reference.
        key: of the figure.
        evaluations: figures of every scene.

    Returns:
        Over the scenes where all rows have a value; None where a file or the figure is missing, or no scene is left.
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
    return None if both.shape[-1] == 0 else paired_bootstrap(both[0], both[1], RESAMPLES)


def _change(found: Interval | None) -> Html:
    if found is None:
        return Html("")
    mean = element("strong", signed(found.mean)) if found.excludes_zero else signed(found.mean)
    return element("small", mean, Html("<br>"), f"[{signed(found.low)}, {signed(found.high)}]")


def _base(comparison: Comparison, experiment: Experiment) -> list[Mapping[str, Any]]:
    """Rows of the reference that others are compared with."""
    for entry in comparison.paired:
        return comparison.of(REFERENCE, (float(entry["against_top_p"]), float(entry["against_temperature"])))
    return comparison.of(REFERENCE, experiment.common)
