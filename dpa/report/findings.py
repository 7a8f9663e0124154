"""What the numbers allow to be said: one sentence, and the reservations that belong to it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dpa.report.experiment import Decoding, Experiment, decoding_of, in_words, read_json
from dpa.report.statistics import SCENES, verdict
from dpa.report.table import REFERENCE, signed

FEW_SEEDS = 5
"""With fewer training runs a bootstrap interval is too narrow; see :func:`dpa.report.statistics.paired_bootstrap`."""


SAYS = {"better": "Better", "worse": "Worse", "open": "Not told apart"}
"""Verdicts in words, each the beginning of a sentence."""


def headline(experiment: Experiment) -> str:
    """The result in one sentence that claims no more than the interval does.

    It is about the method that ``experiment.headline`` names, at its own best decoding against the reference at its
    own, where several were tried: a gain that sharper sampling of the reference reaches too is none.
    """
    entry = experiment.own_best.entry(experiment.headline)
    if entry is None:
        return "No claim: no method was compared with the reference."
    low, high = entry["ci95"]
    name, where = experiment.labels[experiment.headline], f"on {experiment.reported}"
    sampled = experiment.sampled
    interval = f"95 % interval [{signed(low)}, {signed(high)}]"
    if entry["over"] == SCENES:
        change = signed(entry["realism_difference"])
        return (
            f"No claim about a method from one training run: {sampled}, this {name} differs from "
            f"its reference by {change} realism {where} ({interval} over scenes alone)."
        )
    if low <= 0 <= high:
        change = signed(entry["realism_difference"])
        return (
            f"No claim: {sampled}, {name} differs from the reference by {change} realism {where}, "
            f"and the {interval} contains 0."
        )
    size, word = f"{abs(entry['realism_difference']):.3f}", "more" if low > 0 else "less"
    return f"{sampled.capitalize()}, {name} is {size} {word} realistic than the reference {where} ({interval})."


def reservations(experiment: Experiment, num_compared: int | None = None) -> list[str]:
    """What a reader must know before believing :func:`headline`.

    Args:
        experiment: that the headline is of.
        num_compared: differences of realism with an interval that stand on the page; by default those of the
            experiment.
    """
    own = experiment.own_best
    entry = own.entry(experiment.headline)
    notes = []
    if entry is not None and entry["over"] == SCENES:
        notes.append(
            "One training run: the interval covers the choice of scenes, not the spread between training runs."
        )
    elif entry is not None and entry["n_seeds"] < FEW_SEEDS:
        notes.append(f"{entry['n_seeds']} training runs: an interval over so few is a little too narrow.")
    if entry is not None:
        notes += _decoding(experiment, entry)
    notes += [note for note in (chosen_on_the_same(experiment), left_out(experiment), budgets(experiment)) if note]
    compared = differences_of(experiment) if num_compared is None else num_compared
    if compared > 1:
        notes.append(
            f"{compared} differences of realism stand on this page, and more of other figures; their intervals are not "
            "corrected for that."
        )
    notes.append(
        f"Scores on {experiment.reported} compare the methods of this page with each other, not with published tables."
    )
    return notes


def differences_of(experiment: Experiment) -> int:
    """How many differences of realism an experiment has."""
    return sum(len(each.paired) + len(each.versus) for each in experiment.comparisons().values())


def chosen_on_the_same(experiment: Experiment) -> str | None:
    """The reservation that an experiment on the tuning scenes needs."""
    if experiment.split != "tune":
        return None
    return (
        "Decodings were chosen on these very tuning scenes, so what methods and reference reach at their own best is a "
        "little too good, for all alike: each had the same decodings to choose from."
    )


def left_out(experiment: Experiment) -> str | None:
    """How many scenes realism does without."""
    if not experiment.left_out:
        return None
    rest = experiment.scenes[experiment.split] - experiment.left_out
    return f"Realism and its differences are over {rest} of {experiment.reported}: on the others some run has none."


def budgets(experiment: Experiment) -> str | None:
    """Which methods train on more or less than the one they are compared with; None where none does.

    Examples:
        >>> import types
        >>> budget = {"dpa_omf": {"steps": 60, "rollouts": 960}, "round 2": {"steps": 120, "rollouts": 1920}}
        >>> labels = {"dpa_omf": "DPA-OMF", "round 2": "round 2"}
        >>> budgets(types.SimpleNamespace(budget=budget, labels=labels, versus="dpa_omf"))
        'Budgets differ. Against that of DPA-OMF, 2 times the steps, 2 times the rollouts: round 2.'
    """
    base = experiment.versus.partition("@")[0]
    if base not in experiment.budget:
        return None
    mine = {kind: of_base for kind in ("steps", "rollouts") if (of_base := experiment.budget[base][kind])}
    alike: dict[str, list[str]] = {}
    for method, budget in experiment.budget.items():
        times = {kind: budget[kind] / of_base for kind, of_base in mine.items()}
        told = [f"{ratio:.3g} times the {kind}" for kind, ratio in times.items() if ratio != 1]
        if told:
            alike.setdefault(", ".join(told), []).append(experiment.labels[method])
    if not alike:
        return None
    each = ". ".join(f"{told}: {'; '.join(labels)}" for told, labels in alike.items())
    return f"Budgets differ. Against that of {experiment.labels[base]}, {each}."


def saturated(experiment: Experiment, folder: Path) -> str | None:
    """Which methods trained with a loss that no longer weighed preferences; None where no run says so.

    Args:
        experiment: whose runs are asked for the warning that ``recipes.align`` keeps in ``result.json``; a run without
            that file says nothing.
        folder: of the study.
    """
    told = []
    for method, runs in experiment.curves.items():
        results = (folder / run / "result.json" for run in runs.values())
        warned = sum("saturated" in read_json(result) for result in results if result.is_file())
        if warned:
            told.append(f"{experiment.labels[method]} ({warned} of {len(runs)} seeds)")
    if not told:
        return None
    return (
        f"Saturated: {', '.join(told)}. The weights of their pairs say little about how clear a preference is; the "
        "warning that `recipes.align` gives says why, and what to change."
    )


def ordering(experiment: Experiment) -> str:
    """Which methods can be told apart from ``experiment.versus``, each at its own best decoding."""
    entries = experiment.own_best.versus
    if entries and all(entry["over"] == SCENES for entry in entries):
        return "no order is told: one training run of each says nothing about a method"
    sides: dict[str, list[str]] = {side: [] for side in SAYS.values()}
    for entry in entries:
        sides[SAYS[verdict(entry["ci95"], entry["over"])]].append(experiment.labels[entry["method"]])
    told = ". ".join(f"{side}: {'; '.join(labels)}" for side, labels in sides.items() if labels)
    return told[:1].lower() + told[1:]


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
            f"Sampling alone moves the reference by {signed(best['realism_difference'])} at best "
            f"(at {in_words(decoding_of(best))} instead of {in_words(experiment.common)})."
        )
    if len({temperature for _, temperature in grid}) == 1:
        notes.append(f"Of decodings only top-p was varied, at temperature {experiment.common[1]:g}.")
    edges = [
        f"{experiment.labels[method]} ({in_words(experiment.chosen[method])})"
        for method in experiment.methods
        if method in experiment.chosen and _at_edge(experiment.chosen[method], grid)
    ]
    if edges:
        notes.append(
            f"Chosen at the edge of the {len(grid)} decodings tried: {', '.join(edges)}; one beyond may be better."
        )
    return notes


def _at_edge(chosen: Decoding, grid: list[Decoding]) -> bool:
    """The best of a row of decodings is its last: one beyond was never tried.

    A row is of decodings that differ in one number alone; of two, one is tried beyond neither. Beyond top-p 1 there is
    none.

    Examples:
        >>> grid = [(1.0, 1.0), (0.9, 1.0), (0.8, 1.0)]
        >>> [_at_edge(chosen, grid) for chosen in grid]
        [False, False, True]
    """
    for place, value in enumerate(chosen):
        row = sorted({decoding[place] for decoding in grid if decoding[1 - place] == chosen[1 - place]})
        if len(row) > 1 and (value == row[0] or (value == row[-1] and not (place == 0 and value == 1))):
            return True
    return False
