"""Safety of an experiment's methods, by who else sees it: nobody, the paper's distance, the metric, or both; and what
it may be paid with.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from dpa.report.experiment import Comparison, Experiment, decoding_of, in_words
from dpa.report.markup import Html, element, hint, joined, table
from dpa.report.paired import Cell, paired_figure, with_change
from dpa.report.study import Evaluations
from dpa.report.table import REFERENCE, measured

UNSEEN = {"wrong_way": "wrong way", "red_light": "red light"}
RELATED = {"close_pass": "close pass", "harsh_jerk": "harsh jerk", "standing_moved": "standing moved"}
"""Computed otherwise than the features of the distance, but relatives of its clearance, effort and speed."""
SEEN = {"collision_rate": "collision", "offroad_rate": "off-road"}
"""In the paper's features of the preference distance, and in the metric."""
MEASURES = UNSEEN | RELATED | SEEN
PAID = {"min_ade": "minADE [m]", "spread": "spread [m]"}
"""A policy that is safe and says one thing only has less spread, one that waits is far from the log."""
DIGITS = {"min_ade": 2, "spread": 1}
"""After the point; of rates three."""
RED_LIGHTS = "2025"
"""The metrics of this year weigh driving through red lights (dpa/realism/config)."""


def safety_tables(experiment: Experiment, comparison: Comparison, evaluations: Evaluations) -> Html:
    """Rates of every method, and their paired differences from the reference where the scenes' values are there.

    Args:
        experiment: to show.
        comparison: one of its two.
        evaluations: figures of every scene.
    """
    shown = [
        (title, found)
        for title, keys in groups_of(experiment).items()
        if (found := _table(experiment, comparison, evaluations, keys))
    ]
    if not shown:
        return Html("")
    note = (
        f"Means over seeds and those of the {experiment.reported} where a rate is known. Below each its difference "
        "from the reference, with a 95 % interval over the scenes where all have a value; bold where the interval does "
        "not contain 0."
    )
    return joined([*(joined([element("h3", title), found]) for title, found in shown), hint(note)])


def groups_of(experiment: Experiment) -> dict[str, Mapping[str, str]]:
    """Measures of safety and what they are called, by who sees them.

    Args:
        experiment: whose metric may see more than that of other years; a YAML of one's own is taken for one of 2024.
    """
    unseen, weighed = dict(UNSEEN), {}
    if experiment.metric.startswith(RED_LIGHTS):
        weighed = {"red_light": unseen.pop("red_light")}
    return {
        "Safety that neither the paper's preference distance nor the metric sees": unseen,
        "Relatives of the distance's clearance, effort and speed, measured otherwise": RELATED,
        f"Safety that the metric of {experiment.metric} sees, and the paper's preference distance does not": weighed,
        "Safety that both the paper's preference distance and the metric see": SEEN,
        "What it may be paid with: distance to the log, and variety": PAID,
    }


def safety_rows(
    experiment: Experiment,
    comparison: Comparison,
    records: Sequence[Mapping[str, Any]],
    keys: Sequence[str],
    evaluations: Evaluations,
) -> Iterator[tuple[str, list[Cell]]]:
    """Measures of every row with the paired difference from the reference that others are compared with.

    Args:
        experiment: that they are of.
        comparison: one of its two.
        records: of it.
        keys: of the measures.
        evaluations: figures of every scene; without them there are no differences.

    Returns:
        What each row is called and its cells. The reference, where it is not the one that others are compared with,
        is called by its decoding too.
    """
    base = comparison.base()
    for record in records:
        mine, name = comparison.of(record["method"], decoding_of(record)), experiment.labels[record["method"]]
        if record["method"] == REFERENCE and mine != base:
            name += f", {in_words(decoding_of(record))}"
        changes = [None if mine == base else paired_figure(mine, base, key, evaluations) for key in keys]
        yield name, [Cell(record.get(k), each, DIGITS.get(k, 3)) for k, each in zip(keys, changes, strict=True)]


def _table(
    experiment: Experiment, comparison: Comparison, evaluations: Evaluations, keys: Mapping[str, str]
) -> Html | None:
    """One group of measures; None where nothing of it was measured."""
    records = [record for method in experiment.methods for record in comparison.records() if record["method"] == method]
    shown = measured(records, keys)
    if not shown:
        return None
    rows = safety_rows(experiment, comparison, records, shown, evaluations)
    titles = ["method", *(_title(key, keys[key]) for key in shown)]
    return table(titles, [[name, *map(with_change, cells)] for name, cells in rows])


def _title(key: str, name: str) -> str:
    """With an arrow to where better values lie; more spread is neither better nor worse."""
    return name if key == "spread" else f"{name}\N{NO-BREAK SPACE}↓"
