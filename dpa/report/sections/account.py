"""What the numbers cost and what they rest on: hours of each stage, data cards of the scenes and of the preferences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from dpa.preferences.card import DataCard
from dpa.report.account import account_rows
from dpa.report.cards import preference_rows
from dpa.report.charts import bars, drawn, lines
from dpa.report.experiment import SPLITS
from dpa.report.markup import Html, Section, element, folded, hint, joined, table
from dpa.report.scenes import SceneCard
from dpa.report.study import Study
from dpa.report.table import MISSING, duration
from envs.card import AGENT_COLUMNS, MAP_COLUMNS

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
    titles, *rows = preference_rows(cards)
    origins = [folded(name, element("pre", card.origin.to_json())) for name, card in cards.items()]
    return [
        element("h3", "Ranked rollouts"),
        folded(f"{len(cards)} stores", table(titles, rows), open_=len(cards) < MANY),
        hint("A person: the time that the paper's appendix G gives for ranking as many pairs by hand."),
        folded("what each store came from", *origins),
    ]
