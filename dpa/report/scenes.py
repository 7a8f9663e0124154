"""Data cards of a study's scenes, read for its page: what the policies learnt from, and what they were measured on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dpa.report.experiment import SPLITS, read_json
from envs.card import Card, agent_rows, map_rows, scene_facts
from envs.shards import check_shape
from envs.sources.fields import one_line

_SPLIT = {
    "counts": {str: {str: int}},
    "origins": [{"source": str, "split": str, "named": [str], "scenes": int}],
}
_SHAPE = {"options": {str: object}, "splits": dict.fromkeys(SPLITS, _SPLIT)}


@dataclass(frozen=True)
class SceneCard:
    """What the scenes of one split hold, as text.

    Attributes:
        facts: by name, see :func:`~envs.card.scene_facts`.
        agents: a row for each class, see :func:`~envs.card.agent_rows`.
        road: a row for each kind of polyline, see :func:`~envs.card.map_rows`.
        origins: for each store ``source``, ``split``, ``named`` and ``scenes``, see
            :meth:`~envs.store.SceneStore.origins`.
    """

    facts: Mapping[str, str]
    agents: Sequence[Sequence[str]]
    road: Sequence[Sequence[str]]
    origins: Sequence[Mapping[str, Any]]


def read_scene_cards(path: Path) -> dict[str, SceneCard]:
    """Data card of each split, in the order of :data:`~dpa.report.experiment.SPLITS`.

    Args:
        path: ``scenes.json`` of a study.

    Raises:
        ValueError: the file holds something else; the message names it.
    """
    content = read_json(path)
    try:
        check_shape(content, _SHAPE, "it")
        return {name: _card(**content["splits"][name]) for name in SPLITS}
    except (ArithmeticError, LookupError, ValueError) as error:
        raise ValueError(
            f"{path} is no account of what the scenes of a study hold ({one_line(error)}); remove it and run "
            "recipes.compare again."
        ) from None


def _card(counts: Mapping[str, Mapping[str, int]], origins: Sequence[Mapping[str, Any]]) -> SceneCard:
    card = Card(counts)
    return SceneCard(scene_facts(card), agent_rows(card), map_rows(card), origins)
