"""What methods think of ranked rollouts: likelihoods, and the paper's table 3, with what may be said of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from dpa.report.experiment import Experiment
from dpa.report.paired import Cell, paired_figure
from dpa.report.statistics import Interval
from dpa.report.study import Evaluations
from dpa.report.table import MINUS, REFERENCE, mean_over_seeds, measured, summarise

FIGURES = {
    "pair_accuracy": "pair accuracy ↑", "reward_accuracy": "reward accuracy ↑",
    "nll_preferred": "NLL preferred", "nll_unpreferred": "NLL unpreferred",
    "nll_demonstration": "NLL log", "entropy": "entropy", "kl": "KL to reference",
}  # fmt: skip
DIGITS = {"kl": 4}
"""Of a figure after the point, where it is not 3."""
LEARNERS = ("dpa_omf", "adversarial_afd")
"""Methods of the paper's table 3."""
LEARNT = {"pair_accuracy": "pair accuracy ↑", "realism": "realism ↑", "min_ade": "minADE ↓"}
"""Its columns."""
ABOUT_LEARNT = (
    "realism and minADE at the common decoding; pair accuracy, which depends on none, of the checkpoint that was "
    "chosen for the best one"
)


def shown_figures(experiment: Experiment) -> dict[str, str]:
    """Titles of the likelihood figures that an experiment has."""
    return {key: FIGURES[key] for key in measured(summarise(experiment.likelihood), FIGURES)}


def likelihoods(experiment: Experiment, evaluations: Evaluations) -> dict[str, list[Cell]]:
    """Every figure of :func:`shown_figures` of every method, with the paired difference from the reference.

    Args:
        experiment: with rows of likelihood.
        evaluations: figures of every scene.
    """
    found = {method: _of(experiment, method) for method in experiment.methods if _of(experiment, method)}
    base = found.get(REFERENCE, [])
    return {
        method: [
            Cell(
                mean_over_seeds([row.get(key) for row in rows]),
                None if method == REFERENCE else paired_figure(rows, base, key, evaluations),
                DIGITS.get(key, 3),
            )
            for key in shown_figures(experiment)
        ]
        for method, rows in found.items()
    }


class Learnt(NamedTuple):
    """Who learns the ranking (table 3): a row for each of :data:`LEARNERS`, then their differences."""

    means: Mapping[str, list[Cell]]
    """By name, the figures of :data:`LEARNT`."""
    published: Mapping[str, list[float | None]]
    """By name, the paper's."""
    changes: Mapping[str, list[Interval | None]]
    """By what is subtracted from what."""


def who_learns(experiment: Experiment, evaluations: Evaluations) -> Learnt | None:
    """The paper's table 3; None where one of its methods has no likelihood.

    Args:
        experiment: to ask.
        evaluations: figures of every scene.
    """
    if not all(_of(experiment, method) for method in LEARNERS):
        return None

    def rows(method: str, key: str) -> Sequence[Mapping[str, Any]]:
        return _of(experiment, method) if key == "pair_accuracy" else experiment.at_common.of(method, experiment.common)

    labels, (mine, rival) = experiment.labels, LEARNERS
    means = {
        labels[method]: [Cell(mean_over_seeds([row.get(key) for row in rows(method, key)])) for key in LEARNT]
        for method in LEARNERS
    }
    published = {labels[m]: [experiment.published.get(m, {}).get(key) for key in LEARNT] for m in LEARNERS}
    changes = {
        f"{labels[mine]} {MINUS} {labels[other]}": [
            paired_figure(rows(mine, key), rows(other, key), key, evaluations) for key in LEARNT
        ]
        for other in (rival, REFERENCE)
    }
    return Learnt(means, published, changes)


def _of(experiment: Experiment, method: str) -> list[Mapping[str, Any]]:
    return [row for row in experiment.likelihood if row["method"] == method]
