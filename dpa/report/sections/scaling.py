"""Scaling (figure 7 of the paper): realism against what was scaled, and against the distance from the reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dpa.report.charts import Chart, Line, curves, lines
from dpa.report.experiment import Comparison, Experiment
from dpa.report.table import REFERENCE, difference, number


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
    kinds = (
        ("own best decoding", experiment.own_best, "#2a78b5"),
        ("common decoding", experiment.at_common, "#c79a1b"),
    )
    for kind, comparison, colour in kinds:
        entries = sorted(
            (entry for entry in comparison.paired if entry["method"] in axis.values),
            key=lambda entry: axis.values[entry["method"]],
        )
        if not entries:
            continue
        means = [entry["realism_difference"] for entry in entries]
        content.append(
            Line(
                kind,
                [axis.values[entry["method"]] for entry in entries],
                means,
                colour,
                hover=[
                    lines(f"{experiment.labels[entry['method']]}, {kind}", *_told(entry), f"{axis.name}: {x:g}")
                    for entry in entries
                    for x in (axis.values[entry["method"]],)
                ],
                dash="solid" if comparison is experiment.own_best else "dot",
                markers=8,
                error=(
                    [entry["ci95"][1] - mean for entry, mean in zip(entries, means, strict=True)],
                    [mean - entry["ci95"][0] for entry, mean in zip(entries, means, strict=True)],
                ),
            )
        )
    title = f"Realism against {axis.name}"
    caption = f"Realism minus that of the reference on {experiment.reported}, 95 % intervals (figure 7 left)."
    shown = {"x": axis.name, "y": "difference in realism", "caption": caption, "log_x": axis.log, "zero": True}
    return [curves(content, title, **shown)] if content else []


def _against_kl(experiment: Experiment, colours: Mapping[str, str]) -> list[Chart]:
    """One line for each method with snapshots, from the reference on; solid at own best decodings."""
    bases = list(dict.fromkeys(method.partition("@")[0] for method in experiment.methods if "@" in method))
    kl = {method: _mean_kl(experiment, method) for method in experiment.methods}
    content = []
    for comparison, kind in ((experiment.own_best, "own best"), (experiment.at_common, "common")):
        for base in bases:
            found = _snapshots(experiment, comparison, base, kl)
            if not found:
                continue
            own = comparison is experiment.own_best
            content.append(
                Line(
                    f"{experiment.labels[base]}, {kind}",
                    [0.0, *(kl[entry["method"]] for entry in found)],
                    [0.0, *(entry["realism_difference"] for entry in found)],
                    colours[base],
                    hover=[
                        lines("reference"),
                        *(
                            lines(
                                f"{experiment.labels[entry['method']]}, {kind} decoding",
                                *_told(entry),
                                f"KL {number(kl[entry['method']], 3)}",
                            )
                            for entry in found
                        ),
                    ],
                    dash="solid" if own else "dot",
                    markers=7 if own else 5,
                )
            )
    caption = (
        "Snapshots along each alignment, from the reference at the origin (figure 7 right). A line that bends down is "
        f"over-optimisation. Both on {experiment.reported}."
    )
    title = "Realism against the distance from the reference"
    shown = {"x": "KL to the reference", "y": "difference in realism", "caption": caption, "zero": True}
    return [curves(content, title, **shown)] if content else []


def _snapshots(
    experiment: Experiment, comparison: Comparison, base: str, kl: Mapping[str, float | None]
) -> list[Mapping[str, Any]]:
    """Differences of a method's snapshots and of the method itself, in order of their steps."""
    members = [m for m in experiment.methods if m.partition("@")[0] == base and m != REFERENCE and kl[m] is not None]
    members.sort(key=lambda method: (not method.partition("@")[1], int(method.partition("@")[2] or 0)))
    return [entry for method in members if (entry := comparison.entry(method)) is not None]


def _mean_kl(experiment: Experiment, method: str) -> float | None:
    values = [row.get("kl") for row in experiment.likelihood if row["method"] == method]
    return None if not values or None in values else sum(values) / len(values)


def _told(entry: Mapping[str, Any]) -> Sequence[str]:
    return (difference(entry["realism_difference"], entry["ci95"]), f"{entry['n_seeds']} seeds, over {entry['over']}")
