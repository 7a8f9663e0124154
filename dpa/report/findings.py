"""What the numbers allow to be said: one sentence, and the reservations that belong to it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dpa.report.table import REFERENCE, signed, summarise


def headline(comparison: Mapping[str, Any], method: str | None = None) -> str:
    """The result in one sentence that claims no more than the interval does.

    Args:
        comparison: see :mod:`dpa.report`.
        method: whose difference to the reference is told; the first entry of ``paired`` by default. Fix it before the
            numbers are known: the best of several methods is better than it deserves.

    Raises:
        ValueError: the method was not compared.

    Examples:
        >>> rows = [{"method": "reference", "realism": 0.700}, {"method": "DPA-OMF", "realism": 0.704}]
        >>> paired = [{"method": "DPA-OMF", "realism_difference": 0.004, "ci95": [-0.002, 0.010]}]
        >>> headline({"rows": rows, "paired": paired, "scenes": {"eval": 54}})
        'No claim: DPA-OMF differs from the reference by +0.004 realism on 54 scenes, and the 95 % interval \
[−0.002, +0.010] contains 0.'
    """
    entry = _entry(comparison, method)
    if entry is None:
        return "No claim: no method was compared with the reference."
    low, high = entry["ci95"]
    name = _name(entry)
    scenes = f"on {comparison['scenes']['eval']} scenes"
    interval = f"95 % interval [{signed(low)}, {signed(high)}]"
    if low <= 0 <= high:
        change = signed(entry["realism_difference"])
        return (
            f"No claim: {name} differs from the reference by {change} realism {scenes}, and the {interval} contains 0."
        )
    size = f"{abs(entry['realism_difference']):.3f}"
    if high < 0:
        return f"{name} is {size} less realistic than the reference {scenes} ({interval})."
    sentence = f"{name} is {size} more realistic than the reference {scenes} ({interval})"
    best = _best(comparison, REFERENCE)
    mine = _best(comparison, entry["method"])
    if best is not None and mine is not None and best["realism"] >= mine["realism"]:
        return f"{sentence}, but the reference alone, sampled at top-p {best['top_p']:g}, is as realistic."
    return f"{sentence}."


def reservations(comparison: Mapping[str, Any], method: str | None = None) -> list[str]:
    """What a reader must know before believing :func:`headline`; the arguments are the same.

    Examples:
        >>> rows = [{"method": "reference", "realism": 0.70, "top_p": 0.95}, {"method": "SFT-bestOA", "realism": 0.71}]
        >>> paired = [{"method": "SFT-bestOA", "realism_difference": 0.01, "ci95": [0.0, 0.02], "over": "scenes"}]
        >>> reservations({"rows": rows, "paired": paired, "scenes": {"eval": 54}})[0]
        'One training run: the interval covers the choice of scenes, not the spread between training runs.'
    """
    entry = _entry(comparison, method)
    notes = []
    if entry is not None and entry.get("over", "scenes") == "scenes":
        notes.append(
            "One training run: the interval covers the choice of scenes, not the spread between training runs."
        )
    elif entry is not None and entry.get("n_seeds", 2) < 5:
        notes.append(f"{entry['n_seeds']} training runs: an interval over so few is a little too narrow.")
    notes += _decoding(comparison, entry)
    if len(comparison["paired"]) > 1:
        notes.append(f"{len(comparison['paired'])} comparisons stand here; their intervals are not corrected for that.")
    notes.append(
        f"Scores on {comparison['scenes']['eval']} scenes compare the methods of this page with each other, "
        "not with published tables."
    )
    return notes


def _decoding(comparison: Mapping[str, Any], entry: Mapping[str, Any] | None) -> list[str]:
    """Sharper sampling of the reference can gain as much as alignment does: say whether that was looked at."""
    if entry is None:
        return []
    tried = sorted({row.get("top_p") for row in comparison["rows"] if row["method"] == REFERENCE} - {None})
    if len(tried) < 2:
        return ["The reference was sampled in one way only; sharper sampling of it alone may gain as much."]
    best = _best(comparison, REFERENCE)
    return [f"The reference alone reaches {best['realism']:.3f}, at top-p {best['top_p']:g} (of {len(tried)} tried)."]


def _entry(comparison: Mapping[str, Any], method: str | None) -> Mapping[str, Any] | None:
    paired = comparison["paired"]
    if method is None:
        return paired[0] if paired else None
    for entry in paired:
        if entry["method"] == method:
            return entry
    raise ValueError(f"{method!r} was not compared with the reference; compared are {[e['method'] for e in paired]}.")


def _best(comparison: Mapping[str, Any], method: str) -> dict[str, Any] | None:
    """The method's most realistic record among several ways to sample it; None if none has a realism and a top-p."""
    records = [r for r in summarise(comparison["rows"]) if r["method"] == method and r["realism"] is not None]
    records = [r for r in records if r["top_p"] is not None]
    return max(records, key=lambda record: record["realism"], default=None)


def _name(entry: Mapping[str, Any]) -> str:
    return entry["method"] if entry.get("top_p") is None else f"{entry['method']} (top-p {entry['top_p']:g})"
