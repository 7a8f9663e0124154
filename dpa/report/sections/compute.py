"""Compute against quality: realism over what a method took to get there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from dpa.report.charts import Chart, Line, curves, lines
from dpa.report.experiment import Experiment
from dpa.report.sections.scaling import errors, snapshots, told
from dpa.report.table import number

MINUTES = ("method", "before training", "until each snapshot, all in all")
"""Columns of :func:`minute_rows`."""
ABOUT_MINUTES = "one job at a time, means over seeds; what comes before training is rolling out and ranking"


class Course(NamedTuple):
    """What a method gained, and when.

    Attributes:
        method: its name.
        before: minutes of rolling out and ranking before its training begins.
        minutes: until each of its snapshots, and its end, all in all.
        found: paired differences of these from the reference.
    """

    method: str
    before: float
    minutes: list[float]
    found: list[Mapping[str, Any]]


def courses(experiment: Experiment) -> Iterator[Course]:
    """The methods of which it is known what they took, in their order.

    Args:
        experiment: whose jobs were timed; of results that do not tell there is none.
    """
    comparison = experiment.own_best
    for base, spent in experiment.compute.items():
        found = snapshots(comparison, [m for m in experiment.methods if m.partition("@")[0] == base])
        if not found or not spent["training"]:
            continue
        # A snapshot has taken its share of the training, and all that came before it.
        shares = [comparison.steps[entry["method"]] / spent["steps"] for entry in found]
        minutes = [(spent["before"] + share * spent["training"]) / 60 for share in shares]
        yield Course(base, spent["before"] / 60, minutes, found)


def compute_charts(experiment: Experiment, colours: Mapping[str, str]) -> list[Chart]:
    """One line for each method, over its snapshots; nothing of results that do not tell what a method took.

    Args:
        experiment: to show.
        colours: of its methods.
    """
    content = []
    for method, _, minutes, found in courses(experiment):
        gains = [entry["realism_difference"] for entry in found]
        hover = [
            lines(experiment.labels[entry["method"]], *told(entry), f"{number(each, 1)} minutes")
            for entry, each in zip(found, minutes, strict=True)
        ]
        name = experiment.labels[method]
        content.append(Line(name, minutes, gains, colours[method], hover, markers=7, error=errors(found)))
    caption = (
        f"Realism minus that of the reference on {experiment.reported}, {experiment.sampled}, over minutes "
        "of rolling out, ranking and training, one job at a time, once the reference was there; 95 % intervals."
    )
    shown = {"x": "minutes", "y": "difference in realism", "caption": caption, "zero": True}
    return [curves(content, "Realism against compute", **shown)] if content else []


def minute_rows(experiment: Experiment) -> list[list[str]]:
    """The minutes of :func:`compute_charts` in words, a row for each method; none where no snapshot was evaluated.

    Args:
        experiment: to tell of.
    """
    known = list(courses(experiment))
    if all(len(course.found) < 2 for course in known):
        return []
    return [
        [
            experiment.labels[course.method],
            number(course.before, 1),
            ", ".join(number(each, 1) for each in course.minutes),
        ]
        for course in known
    ]
