"""Scaling (figure 7 of the paper): realism against what was scaled, and against the distance from the reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dpa.report.charts import Chart, Line, curves, lines
from dpa.report.experiment import Comparison, Experiment
from dpa.report.table import difference, mean_over_seeds, number

COLOURS, DASHES = ("#2a78b5", "#c79a1b"), ("solid", "dot")
"""Of what is scaled, for the comparisons of an experiment."""
BEHIND = "#a8a8a8"
"""Colour of what was scaled where each method has a line of its own."""


def scaling_charts(experiment: Experiment, colours: Mapping[str, str]) -> list[Chart]:
    """The figures of an experiment that scales something, or that evaluated snapshots; others have none.

    Args:
        experiment: to show.
        colours: of its methods.
    """
    return [*_against_axis(experiment), *_against_kl(experiment, colours)]


def _against_axis(experiment: Experiment) -> list[Chart]:
    axis = experiment.axis
    if axis is None:
        return []
    content = []
    for (kind, comparison), colour, dash in zip(experiment.comparisons().items(), COLOURS, DASHES, strict=False):
        entries = _scaled(experiment, comparison)
        if not entries:
            continue
        content.append(
            Line(
                kind,
                [axis.values[entry["method"]] for entry in entries],
                [entry["realism_difference"] for entry in entries],
                colour,
                hover=[
                    lines(
                        f"{experiment.labels[entry['method']]}, {kind}",
                        *told(entry),
                        f"{axis.name}: {axis.values[entry['method']]:g}",
                    )
                    for entry in entries
                ],
                dash=dash,
                markers=8,
                error=errors(entries),
            )
        )
    title = f"Realism against {axis.name}"
    caption = f"Realism minus that of the reference on {experiment.reported}, 95 % intervals (figure 7 left)."
    shown = {"x": axis.name, "y": "difference in realism", "caption": caption, "log_x": axis.log, "zero": True}
    return [curves(content, title, **shown)] if content else []


def _against_kl(experiment: Experiment, colours: Mapping[str, str]) -> list[Chart]:
    """What was scaled, in its order, and one line for each method with snapshots, from the reference on."""
    kl = {method: _mean_kl(experiment, method) for method in experiment.methods}
    bases = list(dict.fromkeys(method.partition("@")[0] for method in experiment.methods if "@" in method))
    content = []
    for (kind, comparison), colour, dash in zip(experiment.comparisons().items(), COLOURS, DASHES, strict=False):
        # KL was measured of the checkpoint that stands for a method at its own best decoding.
        known = {
            m for m in experiment.methods if comparison.steps[m] == experiment.own_best.steps[m] and kl[m] is not None
        }
        scaled = [entry for entry in _scaled(experiment, comparison) if entry["method"] in known]
        if experiment.axis is not None and scaled:
            name, values = f"{experiment.axis.name}, {kind}", experiment.axis.values
            line = _drift(experiment, scaled, kl, name, BEHIND if bases else colour, dash)
            text = [f"{values[entry['method']]:g}" for entry in scaled]
            content.append(line._replace(error=errors(scaled), text=text))
        for base in bases:
            members = [m for m in experiment.methods if m.partition("@")[0] == base and kl[m] is not None]
            if found := snapshots(comparison, members):
                name = f"{experiment.labels[base]}, {kind}"
                content.append(_from_reference(_drift(experiment, found, kl, name, colours[base], dash)))
    caption = "".join(
        (
            f"Numbers at points: {experiment.axis.name}. " if experiment.axis is not None else "",
            "Snapshots along each alignment, from the reference at the origin. " if bases else "",
            f"A line that bends down is over-optimisation. Both on {experiment.reported} (figure 7 right).",
        )
    )
    title = "Realism against the distance from the reference"
    axes = {"x": "KL to the reference [nats per token]", "y": "difference in realism"}
    return [curves(content, title, **axes, caption=caption, zero=True)] if content else []


def _drift(
    experiment: Experiment, entries: Sequence[Mapping[str, Any]], kl: Mapping[str, float | None], name: str,
    colour: str, dash: str,
) -> Line:  # fmt: skip
    """Differences of realism over the KL of their methods."""
    hover = [
        lines(experiment.labels[entry["method"]], *told(entry), f"KL {number(kl[entry['method']], 4)}")
        for entry in entries
    ]
    at = [kl[entry["method"]] for entry in entries]
    gains = [entry["realism_difference"] for entry in entries]
    return Line(name, at, gains, colour, hover, dash=dash, markers=7)


def _from_reference(line: Line) -> Line:
    """Begin where nothing has moved yet."""
    return line._replace(x=[0.0, *line.x], y=[0.0, *line.y], hover=[lines("reference"), *(line.hover or ())])


def _scaled(experiment: Experiment, comparison: Comparison) -> list[Mapping[str, Any]]:
    """Differences of the methods on the axis, in its order."""
    values = {} if experiment.axis is None else experiment.axis.values
    return sorted(
        (entry for entry in comparison.paired if entry["method"] in values),
        key=lambda entry: values[entry["method"]],
    )


def errors(entries: Sequence[Mapping[str, Any]]) -> tuple[list[float], list[float]]:
    """How far intervals reach up and down."""
    return (
        [entry["ci95"][1] - entry["realism_difference"] for entry in entries],
        [entry["realism_difference"] - entry["ci95"][0] for entry in entries],
    )


def snapshots(comparison: Comparison, policies: Sequence[str]) -> list[Mapping[str, Any]]:
    """Differences of a method's snapshots and of the method itself, in order of their steps."""
    ordered = sorted(policies, key=lambda policy: (not policy.partition("@")[1], int(policy.partition("@")[2] or 0)))
    return [entry for policy in ordered if (entry := comparison.entry(policy)) is not None]


def _mean_kl(experiment: Experiment, method: str) -> float | None:
    return mean_over_seeds([row.get("kl") for row in experiment.likelihood if row["method"] == method])


def told(entry: Mapping[str, Any]) -> Sequence[str]:
    """A difference with its interval, and what it is over."""
    return (difference(entry["realism_difference"], entry["ci95"]), f"{entry['n_seeds']} seeds, over {entry['over']}")
