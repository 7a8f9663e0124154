"""What the numbers allow to be said: one sentence, and the reservations that belong to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dpa.report.experiment import Decoding, Experiment, decoding_of, in_words
from dpa.report.table import REFERENCE, signed

FEW_SEEDS = 5
"""With fewer training runs a bootstrap interval is too narrow; see :func:`dpa.report.statistics.paired_bootstrap`."""


def headline(experiment: Experiment) -> str:
    """The result in one sentence that claims no more than the interval does.

    It is about the method that ``experiment.headline`` names, at its own best decoding against the reference at its
    own: a gain that sharper sampling of the reference reaches too is none.
    """
    entry = experiment.own_best.entry(experiment.headline)
    if entry is None:
        return "No claim: no method was compared with the reference."
    low, high = entry["ci95"]
    name, where = experiment.label(experiment.headline), f"on {experiment.scenes['eval']} scenes"
    interval = f"95 % interval [{signed(low)}, {signed(high)}]"
    if low <= 0 <= high:
        change = signed(entry["realism_difference"])
        return (
            f"No claim: each at its own best decoding, {name} differs from the reference by {change} realism {where}, "
            f"and the {interval} contains 0."
        )
    size, word = f"{abs(entry['realism_difference']):.3f}", "more" if low > 0 else "less"
    return f"Each at its own best decoding, {name} is {size} {word} realistic than the reference {where} ({interval})."


def reservations(experiment: Experiment, num_compared: int | None = None) -> list[str]:
    """What a reader must know before believing :func:`headline`.

    Args:
        experiment: that the headline is of.
        num_compared: differences with an interval that stand on the page; by default those of the experiment.
    """
    own = experiment.own_best
    entry = own.entry(experiment.headline)
    notes = []
    if entry is not None and entry["over"] == "scenes":
        notes.append(
            "One training run: the interval covers the choice of scenes, not the spread between training runs."
        )
    elif entry is not None and entry["n_seeds"] < FEW_SEEDS:
        notes.append(f"{entry['n_seeds']} training runs: an interval over so few is a little too narrow.")
    if entry is not None:
        notes += _decoding(experiment, entry)
    compared = len(own.paired) + len(experiment.at_common.paired) if num_compared is None else num_compared
    if compared > 1:
        notes.append(f"{compared} differences stand on this page; their intervals are not corrected for that.")
    notes.append(
        f"Scores on {experiment.scenes['eval']} scenes compare the methods of this page with each other, "
        "not with published tables."
    )
    return notes


def _decoding(experiment: Experiment, entry: Mapping[str, Any]) -> list[str]:
    """Sharper sampling can gain as much as alignment does: say how well that was looked at, and what it gave."""
    grid, notes = experiment.grid(), []
    if len(grid) < 2:
        return ["One decoding was tried; sharper sampling of the reference alone may gain as much."]
    common = experiment.at_common.entry(experiment.headline)
    if common is not None and common["ci95"][0] > 0 and entry["ci95"][0] <= 0:
        notes.append("The gain at the common decoding does not outlast the best decoding of the reference.")
    sharper = [e for e in experiment.at_common.paired if e["method"] == REFERENCE]
    if sharper:
        best = max(sharper, key=lambda e: e["realism_difference"])
        notes.append(
            f"Sampling alone moves the reference by up to {signed(best['realism_difference'])} "
            f"(at {in_words(decoding_of(best))} instead of {in_words(experiment.common)})."
        )
    edges = [
        f"{experiment.label(method)} ({in_words(experiment.chosen[method])})"
        for method in (REFERENCE, experiment.headline)
        if method in experiment.chosen and _at_edge(experiment.chosen[method], grid)
    ]
    if edges:
        notes.append(
            f"Chosen at the edge of the {len(grid)} decodings tried: {', '.join(edges)}; one beyond may be better."
        )
    return notes


def _at_edge(chosen: Decoding, grid: list[Decoding]) -> bool:
    """A neighbour beyond the grid was never tried; beyond top-p 1 there is none."""
    for place, value in enumerate(chosen):
        tried = sorted({decoding[place] for decoding in grid})
        if len(tried) > 1 and (value == tried[0] or (value == tried[-1] and not (place == 0 and value == 1))):
            return True
    return False
