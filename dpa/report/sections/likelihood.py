"""Likelihood that methods give to ranked rollouts: a table, and curves along training (figures 4 and 6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpa.report.charts import Chart, Line, curves, gallery
from dpa.report.curves import Curve, read_curves
from dpa.report.experiment import Experiment
from dpa.report.markup import Html, Section, element, folded, hint, joined, sources, stacked, table
from dpa.report.paired import paired_figure, quiet_change
from dpa.report.study import Evaluations
from dpa.report.table import MINUS, REFERENCE, mean_over_seeds, number

FIGURES = {
    "pair_accuracy": "pair accuracy ↑", "reward_accuracy": "reward accuracy ↑",
    "nll_preferred": "NLL preferred", "nll_unpreferred": "NLL unpreferred",
    "nll_demonstration": "NLL log", "entropy": "entropy", "kl": "KL to reference",
}  # fmt: skip
DIGITS = {"kl": 4}
"""Of a figure after the point, where it is not 3."""
SIDES = {
    "tune/nll_preferred": ("preferred", "#2a78b5"),
    "tune/nll_unpreferred": ("unpreferred", "#d55e00"),
    "tune/nll_demonstration": ("log", "#3c4043"),
}
HEALTH = {
    "train/logit_std": ("Spread of the preference logits", "standard deviation of the logits"),
    "train/saturated": ("Share of saturated pairs", "share of pairs"),
    "tune/kl": ("KL along the reference's ranked rollouts", "KL per token [nats]"),
    "tune/entropy": ("Entropy of the tokens", "entropy per token [nats]"),
    "tune/pair_accuracy": ("Pair accuracy", "share of pairs"),
    "tune/reward_accuracy": ("Reward accuracy", "share of pairs"),
}
"""Title and axis of the figure of a scalar."""
POINTS = 40
"""Most points of a curve on the page; longer ones are averaged over blocks of steps."""
TABLE_3 = ("dpa_omf", "adversarial_afd")
"""Methods of the paper's table 3."""
OF_TABLE_3 = {"pair_accuracy": "pair accuracy ↑", "realism": "realism ↑", "min_ade": "minADE ↓"}


def likelihood_table(experiment: Experiment, evaluations: Evaluations) -> Html:
    """Likelihood of ranked rollouts of the reported scenes, and with it the paper's table 3 where its methods are.

    Args:
        experiment: to show.
        evaluations: figures of every scene.
    """
    by_method = {
        method: [row for row in experiment.likelihood if row["method"] == method] for method in experiment.methods
    }
    by_method = {method: rows for method, rows in by_method.items() if rows}
    shown = [key for key in FIGURES if any(row.get(key) is not None for row in experiment.likelihood)]
    if not shown:
        return Html("")
    rows = []
    for method, of_method in by_method.items():
        cells = []
        for key in shown:
            digits, base = DIGITS.get(key, 3), by_method.get(REFERENCE, [])
            found = None if method == REFERENCE else paired_figure(of_method, base, key, evaluations)
            cells.append(
                joined(
                    [number(mean_over_seeds([row.get(key) for row in of_method]), digits), quiet_change(found, digits)],
                    "",
                )
            )
        rows.append([experiment.labels[method], *cells, sources([row["file"] for row in of_method])])
    parts = [
        *([_table_3(experiment, by_method, evaluations)] if set(TABLE_3) <= set(by_method) else []),
        element("h3", "Likelihood of ranked rollouts"),
        table(["method", *(FIGURES[key] for key in shown), "seeds"], rows),
        hint(
            f"On the reference's ranked rollouts of the {experiment.reported}, means over seeds; in small type the "
            "difference from the reference with its 95 % interval. Pair accuracy: how often the nearer rollout of a "
            "pair is the likelier one; reward accuracy: how often it gained more "
            "likelihood over the reference (chance: 0.5). NLL: negative log-likelihood per token [nats]. KL: along the "
            "method's own rollouts, per token [nats]."
        ),
    ]
    return joined(parts)


def _table_3(
    experiment: Experiment, by_method: Mapping[str, Sequence[Mapping[str, Any]]], evaluations: Evaluations
) -> Html:
    def runs(method: str, key: str) -> Sequence[Mapping[str, Any]]:
        at_common = experiment.at_common.of(method, experiment.common)
        return by_method.get(method, []) if key == "pair_accuracy" else at_common

    rows = []
    for method in TABLE_3:
        published = experiment.published.get(method, {})
        cells = []
        for key in OF_TABLE_3:
            paper = [element("small", f"paper {number(published[key], 3)}")] if key in published else []
            cells.append(joined([number(mean_over_seeds([row.get(key) for row in runs(method, key)]), 3), *paper], ""))
        rows.append([experiment.labels[method], *cells])
    mine = TABLE_3[0]
    for other in (TABLE_3[1], REFERENCE):
        changes = [paired_figure(runs(mine, key), runs(other, key), key, evaluations) for key in OF_TABLE_3]
        cells = [stacked(None, None) if each is None else stacked(each.mean, (each.low, each.high)) for each in changes]
        rows.append([f"{experiment.labels[mine]} {MINUS} {experiment.labels[other]}", *cells])
    note = (
        f"On {experiment.reported}; realism and minADE at the common decoding; pair accuracy, which depends on "
        "none, of the checkpoint that was chosen for the best one. Differences with 95 % intervals, bold where 0 lies "
        "outside."
    )
    head = element("h3", "Who learns the ranking (table 3)")
    return joined([head, table(["method", *OF_TABLE_3.values()], rows), hint(note)])


def training_section(
    experiments: Sequence[Experiment], folder: Path, colours: Mapping[str, Mapping[str, str]]
) -> Section | None:
    """Curves of every experiment along its alignment; None where no run has any.

    Args:
        experiments: of the study.
        folder: of the study.
        colours: of the methods, by experiment.
    """
    parts = []
    for experiment in experiments:
        runs = {
            method: [read_curves(folder / run) for run in seeds.values() if (folder / run / "scalars").is_dir()]
            for method, seeds in experiment.curves.items()
        }
        runs = {method: seeds for method, seeds in runs.items() if seeds}
        charts = [chart for method, seeds in runs.items() for chart in _likelihood(experiment.labels[method], seeds)]
        health = [chart for key in HEALTH for chart in _health(experiment, runs, key, colours[experiment.name])]
        if charts or health:
            body = joined([gallery(charts, small=True), element("h3", "Health of the alignment"), gallery(health)])
            parts.append(folded(experiment.title, body, open_=not parts))
    if not parts:
        return None
    about = hint(
        "Figures 4 and 6 of the paper: negative log-likelihood (NLL) of ranked rollouts and logs of the tuning scenes "
        "along training, minus that at the start; below 0 they have become likelier. "
        f"Thin lines are seeds, thick ones their mean; curves of more than {POINTS} points are averaged over blocks of "
        "steps (seed_N/METHOD/scalars/). "
        "Each figure has a scale of its own."
    )
    return Section("training", "Likelihood along training", joined([about, *parts]))


def _likelihood(label: str, seeds: Sequence[Mapping[str, Curve]]) -> list[Chart]:
    changes = [{key: _since_start(run[key]) for key in SIDES if key in run} for run in seeds]
    content = [line for key, (name, colour) in SIDES.items() for line in _lines(name, key, changes, colour)]
    return (
        [curves(content, label, x="step", y="change of NLL [nats per token]", zero=True, height=250)] if content else []
    )


def _since_start(curve: Curve) -> Curve:
    """Runs start where their references are, and these lie further apart than training moves them."""
    return {"step": curve["step"], "value": [value - curve["value"][0] for value in curve["value"]]}


def _health(
    experiment: Experiment, runs: Mapping[str, Sequence[Mapping[str, Curve]]], key: str, colours: Mapping[str, str]
) -> list[Chart]:
    content = [
        line
        for method, seeds in runs.items()
        if method != REFERENCE
        for line in _lines(experiment.labels[method], key, seeds, colours[method])
    ]
    title, axis = HEALTH[key]
    return [curves(content, title, x="step", y=axis, nonnegative=True, height=260)] if content else []


def _lines(name: str, key: str, seeds: Sequence[Mapping[str, Curve]], colour: str) -> list[Line]:
    """A thin line for each seed and a thick one for their mean, where a run has the scalar."""
    found = [blocks(run[key], POINTS) for run in seeds if key in run]
    if not found:
        return []
    if len(found) == 1 or any(step != found[0][0] for step, _ in found):  # runs of other lengths have no mean
        return [Line(name, *each, colour, legend=place == 0, markers=3) for place, each in enumerate(found)]
    mean = [float(value) for value in np.mean([value for _, value in found], axis=0)]
    thin = [Line(name, *each, colour, width=1, opacity=0.35, legend=False) for each in found]
    return [*thin, Line(name, found[0][0], mean, colour, width=2.6)]


def blocks(curve: Curve, points: int) -> tuple[list[float], list[float]]:
    """A curve in at most so many points, each the mean of a block of steps.

    Args:
        curve: with finite values.
        points: at most.

    Examples:
        >>> blocks({"step": [1, 2, 3, 4], "value": [1.0, 3.0, 5.0, 7.0]}, 2)
        ([1.5, 3.5], [2.0, 6.0])
    """
    known = [(s, v) for s, v in zip(curve["step"], curve["value"], strict=True) if math.isfinite(v)]
    size = math.ceil(len(known) / points) or 1
    parts = [known[first : first + size] for first in range(0, len(known), size)]
    means = [tuple(sum(column) / len(part) for column in zip(*part, strict=True)) for part in parts]
    return [step for step, _ in means], [value for _, value in means]
