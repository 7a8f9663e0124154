"""Compute against quality: realism over what a method took to get there."""

from __future__ import annotations

from collections.abc import Mapping

from dpa.report.charts import Chart, Line, curves, lines
from dpa.report.experiment import Experiment
from dpa.report.sections.scaling import errors, snapshots, told
from dpa.report.table import number


def compute_charts(experiment: Experiment, colours: Mapping[str, str]) -> list[Chart]:
    """One line for each method, over its snapshots; nothing of results that do not tell what a method took.

    Args:
        experiment: to show.
        colours: of its methods.
    """
    content, comparison = [], experiment.own_best
    for base, spent in experiment.compute.items():
        found = snapshots(comparison, [m for m in experiment.methods if m.partition("@")[0] == base])
        if not found or not spent["training"]:
            continue
        # A snapshot has taken its share of the training, and all that came before it.
        shares = [comparison.steps[entry["method"]] / spent["steps"] for entry in found]
        minutes = [(spent["before"] + share * spent["training"]) / 60 for share in shares]
        gains = [entry["realism_difference"] for entry in found]
        hover = [
            lines(experiment.labels[entry["method"]], *told(entry), f"{number(each, 1)} minutes")
            for entry, each in zip(found, minutes, strict=True)
        ]
        name = experiment.labels[base]
        content.append(Line(name, minutes, gains, colours[base], hover, markers=7, error=errors(found)))
    caption = (
        f"Realism minus that of the reference on {experiment.reported}, {experiment.sampled}, over minutes "
        "of rolling out, ranking and training, one job at a time, once the reference was there; 95 % intervals."
    )
    shown = {"x": "minutes", "y": "difference in realism", "caption": caption, "zero": True}
    return [curves(content, "Realism against compute", **shown)] if content else []
