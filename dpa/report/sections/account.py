"""What the numbers cost and what they rest on: hours of each stage, data cards of the scenes and of the preferences."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping

from dpa.preferences.card import DataCard
from dpa.report.account import account_rows
from dpa.report.charts import bars, drawn, lines
from dpa.report.experiment import SPLITS
from dpa.report.markup import Html, Section, element, folded, hint, joined, table
from dpa.report.scenes import SceneCard
from dpa.report.study import Study
from dpa.report.table import MISSING, duration, number
from envs.card import AGENT_COLUMNS, MAP_COLUMNS

CARD: Mapping[str, Callable[[DataCard], str]] = {
    "scenes": lambda card: f"{card.scenes}",
    "rollouts per scene": lambda card: f"{card.rollouts}",
    "ranked agents": lambda card: f"{card.agents}",
    "pairs": lambda card: f"{card.scenes * card.pairs}",
    "margin of a pair": lambda card: _known(card.margin, 3),
    "margin over the scene's mean": lambda card: _percent(card.relative_margin),
    "pairs without preference": lambda card: _percent(card.tied_pairs),
    "Spearman of distance and ADE": lambda card: _known(card.spearman, 2),
    "ADE's pairs ordered alike": lambda card: _percent(card.same_side),
    "a person would take": lambda card: f"{card.human_hours:.1f} h",
    "on disk, per scene": lambda card: f"{card.scene_bytes / 1000:.1f} kB",
}

MANY = 10
"""Stores that are shown only when asked for."""


def account_section(study: Study) -> Section | None:
    """Compute account and data cards; None where the study has neither."""
    parts = [*_stages(study), *_scenes(study.scenes), *_cards(study.cards)]
    return Section("account", "Compute and data", joined(parts)) if parts else None


def _stages(study: Study) -> list[Html]:
    if not study.stages:
        return []
    seconds = study.seconds
    chart = bars(
        {name: spent / 3600 for name, spent in seconds.items()},
        f"Hours of each stage, {duration(sum(seconds.values()))} in all",
        x="hours",
        hover=[lines(name, duration(seconds[name]), f"{len(study.stages[name])} jobs") for name in seconds],
    )
    titles, *rows = account_rows(study)
    note = hint("Time of one worker, each job as it was done first. Experiments share jobs (stages.json).")
    return [drawn(chart), table(titles, rows), note]


def _scenes(cards: Mapping[str, SceneCard]) -> list[Html]:
    """A row for each split, below it one for each class of agents in it; map and inputs on request."""
    if not cards:
        return []
    *facts, last = next(iter(cards.values())).facts  # the longest cells come last: what recordings lack
    classes = {split: {name: count for name, count, *_ in card.agents} for split, card in cards.items()}
    named = list(dict.fromkeys(name for found in classes.values() for name in found))
    rows = [
        [
            SPLITS[split],
            _sources(card),
            *(card.facts[name] for name in facts),
            *(classes[split].get(name, "0") for name in named),
            card.facts[last],
        ]
        for split, card in cards.items()
    ]
    inputs = [
        [SPLITS[split], each["source"], each["split"] or MISSING, str(each["scenes"]), ", ".join(each["named"])]
        for split, card in cards.items()
        for each in card.origins
    ]
    return [
        element("h3", "Scenes"),
        table(["split", "from", *facts, *named, last], rows),
        hint("By class; speeds are of all valid states. A median is given as the bin that it lies in."),
        table(AGENT_COLUMNS, _by_split(cards, "agents")),
        folded("map", table(MAP_COLUMNS, _by_split(cards, "road"))),
        folded("what the scenes were converted from", table(["split", "source", "part", "scenes", "inputs"], inputs)),
    ]


def _sources(card: SceneCard) -> str:
    """Where scenes came from; how many from each where they are of several sources."""
    scenes: Counter[str] = Counter()
    for each in card.origins:
        scenes[each["source"]] += each["scenes"]
    return next(iter(scenes)) if len(scenes) == 1 else ", ".join(f"{name} ({many})" for name, many in scenes.items())


def _by_split(cards: Mapping[str, SceneCard], part: str) -> list[list[str]]:
    return [[f"{SPLITS[split]}, {name}", *row] for split, card in cards.items() for name, *row in getattr(card, part)]


def _cards(cards: Mapping[str, DataCard]) -> list[Html]:
    if not cards:
        return []
    shares = list(dict.fromkeys(feature for card in cards.values() for feature in card.feature_shares))
    rows = [
        [
            name.replace("/preferences_", ", ").replace("_", " "),
            *(cell(card) for cell in CARD.values()),
            *(_share(card, feature) for feature in shares),
        ]
        for name, card in cards.items()
    ]
    origins = [folded(name, element("pre", card.origin.to_json())) for name, card in cards.items()]
    titles = ["store", *CARD, *(f"distance made of {feature}" for feature in shares)]
    return [
        element("h3", "Ranked rollouts"),
        folded(f"{len(cards)} stores", table(titles, rows), open_=len(cards) < MANY),
        hint("A person: the time that the paper's appendix G gives for ranking as many pairs by hand."),
        folded("what each store came from", *origins),
    ]


def _share(card: DataCard, feature: str) -> str:
    share = card.feature_shares.get(feature)
    return MISSING if share is None else _percent(share)


def _known(value: float, digits: int) -> str:
    return number(None if math.isnan(value) else value, digits)


def _percent(share: float) -> str:
    return _known(100 * share, 0) + " %"
