"""The top of the page: the result, with its intervals and what speaks against it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dpa.report.experiment import SAMPLED, Experiment, decoding_against, decoding_of, in_words
from dpa.report.findings import differences_of, headline, reservations
from dpa.report.markup import Html, element, hint, joined
from dpa.report.statistics import verdict
from dpa.report.study import Study
from dpa.report.table import signed


def claim(study: Study) -> Html:
    """Headline, both differences in large type, and reservations.

    Args:
        study: whose first experiment the headline is of.
    """
    experiment = study.main
    if experiment is None:
        return element("p", "No claim: the study has no experiment that compares methods.", class_="headline")
    compared = sum(differences_of(each) for each in study.experiments.values())
    notes = [element("li", note) for note in reservations(experiment, compared)]
    cards = [
        _card(experiment, SAMPLED.get(kind, experiment.sampled), each.entry(experiment.headline))
        for kind, each in experiment.comparisons().items()
    ]
    return joined(
        [
            element("p", headline(experiment), class_="headline"),
            hint(
                joined(
                    ["of the experiment ", element("a", experiment.title, href=f"#experiment-{experiment.name}")], ""
                )
            ),
            element("div", *cards, class_="cards"),
            element("ul", *notes, class_="reservations"),
        ]
    )


def _card(experiment: Experiment, title: str, entry: Mapping[str, Any] | None) -> Html:
    if entry is None:
        return Html("")
    low, high = entry["ci95"]
    seeds = f"{entry['n_seeds']} seed{'s' if entry['n_seeds'] > 1 else ''}"
    return element(
        "div",
        element("div", title, class_="card-title"),
        element("div", signed(entry["realism_difference"]), class_=f"figure {verdict(entry['ci95'], entry['over'])}"),
        element("div", f"[{signed(low)}, {signed(high)}] realism, 95 %"),
        element(
            "div",
            f"{experiment.labels[experiment.headline]} at {in_words(decoding_of(entry))}, reference at "
            f"{in_words(decoding_against(entry))}; {seeds}, {experiment.reported}",
            class_="hint",
        ),
        class_="card",
    )
