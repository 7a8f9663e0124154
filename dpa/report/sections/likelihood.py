"""Likelihood that methods give to ranked rollouts: a table, and curves along training (figures 4 and 6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dpa.report.charts import Chart, Line, curves, gallery
from dpa.report.experiment import Experiment
from dpa.report.likelihoods import ABOUT_LEARNT, LEARNT, Learnt, likelihoods, shown_figures, who_learns
from dpa.report.markup import Html, Section, element, folded, hint, joined, sources, table
from dpa.report.paired import stacked_change, with_change
from dpa.report.study import Evaluations
from dpa.report.table import REFERENCE, number
from dpa.training.loggers import Curve, read_curves

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
    "train/rollout_distance": ("Own rollouts of a step: distance to the log", "preference distance"),
    "train/rollout_missed": ("Own rollouts of a step: realism missed", "sum over agents, to the group's best"),
    "train/rollout_spread": ("Own rollouts: how far apart they end", "spread [m]"),
    "train/rollout_pair_accuracy": ("Own rollouts: pair accuracy", "share of pairs"),
    "train/seconds_rollout": ("Rolling out and ranking", "seconds of a step"),
    "train/seconds_ranking": ("Ranking, of that; added up over workers", "seconds of a step"),
    "train/seconds_learning": ("Learning from it", "seconds of a step"),
}
"""Title and axis of the figure of a scalar."""
REWARD = "train/reward_"
"""Begins the names of scalars that are rewards."""
POINTS = 40
"""Most points of a curve on the page; longer ones are averaged over blocks of steps."""


def likelihood_table(experiment: Experiment, evaluations: Evaluations) -> Html:
    """Likelihood of ranked rollouts of the reported scenes, and with it the paper's table 3 where its methods are.

    Args:
        experiment: to show.
        evaluations: figures of every scene.
    """
    shown = shown_figures(experiment)
    if not shown:
        return Html("")
    files = {
        method: [row["file"] for row in experiment.likelihood if row["method"] == method]
        for method in experiment.methods
    }
    rows = [
        [experiment.labels[method], *map(with_change, cells), sources(files[method])]
        for method, cells in likelihoods(experiment, evaluations).items()
    ]
    learnt = who_learns(experiment, evaluations)
    parts = [
        *([] if learnt is None else [_table_3(learnt, experiment)]),
        element("h3", "Likelihood of ranked rollouts"),
        table(["method", *shown.values(), "seeds"], rows),
        hint(
            f"On the reference's ranked rollouts of the {experiment.reported}, means over seeds; in small type the "
            "difference from the reference with its 95 % interval. Pair accuracy: how often the nearer rollout of a "
            "pair is the likelier one; reward accuracy: how often it gained more "
            "likelihood over the reference (chance: 0.5). NLL: negative log-likelihood per token [nats]. KL: along the "
            "method's own rollouts, per token [nats]."
        ),
    ]
    return joined(parts)


def _table_3(learnt: Learnt, experiment: Experiment) -> Html:
    rows: list[list[object]] = []
    for name, cells in learnt.means.items():
        papers = (
            Html("") if each is None else element("small", f"paper {number(each, 3)}")
            for each in learnt.published[name]
        )
        values = (number(cell.mean, cell.digits) for cell in cells)
        rows.append([name, *(joined(each, "") for each in zip(values, papers, strict=True))])
    for name, changes in learnt.changes.items():
        rows.append([name, *(stacked_change(change) for change in changes)])
    note = f"On {experiment.reported}; {ABOUT_LEARNT}. Differences with 95 % intervals, bold where 0 lies outside."
    head = element("h3", "Who learns the ranking (table 3)")
    return joined([head, table(["method", *LEARNT.values()], rows), hint(note)])


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
        charts, health = training_charts(experiment, folder, colours[experiment.name])
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


def training_charts(
    experiment: Experiment, folder: Path, colours: Mapping[str, str]
) -> tuple[list[Chart], list[Chart]]:
    """Likelihoods of each method along its alignment, and what tells whether that goes well, all methods together.

    Args:
        experiment: to show.
        folder: of the study.
        colours: of the methods.
    """
    runs = {
        method: [found for run in seeds.values() if (found := read_curves(folder / run))]
        for method, seeds in experiment.curves.items()
    }
    runs = {method: seeds for method, seeds in runs.items() if seeds}
    charts = [chart for method, seeds in runs.items() for chart in _likelihood(experiment.labels[method], seeds)]
    rewards = sorted({key for seeds in runs.values() for run in seeds for key in run if key.startswith(REWARD)})
    told = HEALTH | {key: (f"Reward: {key.removeprefix(REWARD)}", "reward of an agent") for key in rewards}
    return charts, [chart for key, names in told.items() for chart in _health(experiment, runs, key, names, colours)]


def _likelihood(label: str, seeds: Sequence[Mapping[str, Curve]]) -> list[Chart]:
    changes = [{key: _since_start(run[key]) for key in SIDES if key in run} for run in seeds]
    content = [line for key, (name, colour) in SIDES.items() for line in _lines(name, key, changes, colour)]
    return (
        [curves(content, label, x="step", y="change of NLL [nats per token]", zero=True, height=250)] if content else []
    )


def _since_start(curve: Curve) -> Curve:
    """Runs start where their references are, and these lie further apart than training moves them."""
    return [(step, value - curve[0][1]) for step, value in curve]


def _health(
    experiment: Experiment, runs: Mapping[str, Sequence[Mapping[str, Curve]]], key: str, names: tuple[str, str],
    colours: Mapping[str, str],
) -> list[Chart]:  # fmt: skip
    content = [
        line
        for method, seeds in runs.items()
        if method != REFERENCE
        for line in _lines(experiment.labels[method], key, seeds, colours[method])
    ]
    title, axis = names
    shown = {"x": "step", "y": axis, "nonnegative": not key.startswith(REWARD), "height": 260}
    return [curves(content, title, **shown)] if content else []


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
        >>> blocks([(1, 1.0), (2, 3.0), (3, 5.0), (4, 7.0)], 2)
        ([1.5, 3.5], [2.0, 6.0])
    """
    known = [(step, value) for step, value in curve if math.isfinite(value)]
    size = math.ceil(len(known) / points) or 1
    parts = [known[first : first + size] for first in range(0, len(known), size)]
    means = [tuple(sum(column) / len(part) for column in zip(*part, strict=True)) for part in parts]
    return [step for step, _ in means], [value for _, value in means]
