"""Data cards of the stores of ranked rollouts, for the page and the logs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path

from dpa.preferences import PreferenceStore
from dpa.preferences.card import DataCard, data_card
from dpa.report.experiment import read_json
from dpa.report.table import MISSING, number
from envs.shards import check_shape
from envs.sources.fields import one_line

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


KEPT = "preferences.json"
"""The cards of a study whose stores are elsewhere, as :func:`~dpa.report.archive.write_archive` keeps them."""


def read_preference_cards(folder: Path) -> dict[str, DataCard]:
    """Cards of the stores of a study that hold something, by their folders relative to it, and those that were kept.

    Args:
        folder: of the study.

    Raises:
        ValueError: :data:`KEPT` holds something else; the message names it.
    """
    found = _kept(folder / KEPT) if (folder / KEPT).is_file() else {}
    for path in sorted(folder.glob("seed_*/preferences_*/metadata.json")):
        store = PreferenceStore(path.parent)
        if len(store):
            found[path.parent.relative_to(folder).as_posix()] = data_card(store)
    return found


def _kept(path: Path) -> dict[str, DataCard]:
    content = read_json(path)
    try:
        check_shape(content, {str: object}, "it")
        return {name: DataCard.from_json(card) for name, card in content.items()}
    except ValueError as error:
        raise ValueError(
            f"{path} holds no cards of ranked rollouts ({one_line(error)}); remove it, the page does without."
        ) from None


def preference_rows(cards: Mapping[str, DataCard]) -> list[list[str]]:
    """A table of cards: a row of titles, then one for each store; features of any of them have a column.

    Args:
        cards: by the names of their stores.
    """
    shares = list(dict.fromkeys(feature for card in cards.values() for feature in card.feature_shares))
    rows = [
        [
            name.replace("/preferences_", ", ").replace("_", " "),
            *(cell(card) for cell in CARD.values()),
            *(_share(card, feature) for feature in shares),
        ]
        for name, card in cards.items()
    ]
    return [["store", *CARD, *(f"distance made of {feature}" for feature in shares)], *rows]


def _share(card: DataCard, feature: str) -> str:
    share = card.feature_shares.get(feature)
    return MISSING if share is None else _percent(share)


def _known(value: float, digits: int) -> str:
    return number(None if math.isnan(value) else value, digits)


def _percent(share: float) -> str:
    return _known(100 * share, 0) + " %"
