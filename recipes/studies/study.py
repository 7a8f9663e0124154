"""What studies of rankings share: each policy rolls each scene out once, and every scene's numbers are kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from dpa.ranking import Distance
from dpa.report.statistics import Interval, summary
from envs.seeding import make_generator
from envs.store import SceneStore
from recipes.common.cli import plain
from recipes.common.models import open_policy, weights_digest
from recipes.common.provenance import provenance
from recipes.common.rankings import build_distance
from recipes.common.rolled import Rolled, driven
from recipes.studies.rows import Measure, measure_row

RANDOM_GROUPS = 8
"""Groups of rollouts drawn at random from a scene: what they score, a group of that size scores that nothing chose."""
ADE = "ade"
"""Displacement, the ranking that every study has beside those that it is given."""
TAKEN = (ADE, "random")
"""Names of rankings that studies give themselves."""


def study(
    cfg: DictConfig, policies: Mapping[str, Path], scenes: SceneStore, measure: Measure, decided_by: dict[str, Any]
) -> dict[str, list[dict]]:
    """Measure every scene under every policy; what an earlier run has measured is read back.

    Args:
        cfg: with ``num_rollouts``, ``decoding``, ``seed``, ``memory``, ``device`` and ``output``.
        policies: files by name.
        scenes: to roll out.
        measure: of one scene.
        decided_by: options of the measure.

    Returns:
        For each policy by name what ``measure`` gave for each scene.
    """
    return {name: study_policy(cfg, scenes, path, measure, decided_by, name) for name, path in policies.items()}


def study_policy(
    cfg: DictConfig, scenes: SceneStore, policy: Path, measure: Measure, decided_by: dict[str, Any], name: str
) -> list[dict]:
    """What ``measure`` gives for each scene under one policy; arguments and files as in :func:`study`."""
    model, episode, _ = open_policy(policy, cfg.device)
    options = decided_by | {
        "policy": weights_digest(model),
        "num_rollouts": cfg.num_rollouts,
        "decoding": plain(cfg.decoding),
        "seed": cfg.seed,
    }
    return measure_row(cfg.output, name, options, scenes, partial(driven, scenes, model, episode, cfg), measure)


def distances_of(section: DictConfig, name: str) -> dict[str, Distance]:
    """Distances by name, from a section of the configuration that holds the options of each.

    Raises:
        ValueError: a wrong option, or a name that studies have given already; the message names it.
    """
    taken = next((key for key in section if key in TAKEN), None)
    if taken is not None:
        raise ValueError(
            f"{name}.{taken}: {' and '.join(TAKEN)} stand for displacement and chance; choose another name."
        )
    return {key: build_distance(options, f"{name}.{key}") for key, options in section.items()}


def random_groups(each: Rolled, size: int, seed: int, study: str) -> list[Tensor]:
    """Rollouts of a scene that nothing has chosen, :data:`RANDOM_GROUPS` times.

    Args:
        each: scene and rollouts.
        size: rollouts of a group, each once.
        seed: of the draw.
        study: that draws; another one draws others.
    """
    draw = make_generator(seed, study, each.index)
    return [torch.randperm(len(each.trajectories), generator=draw)[:size] for _ in range(RANDOM_GROUPS)]


def how_made(cfg: DictConfig, recipe: str, scenes: SceneStore, measured: dict[str, list[dict]]) -> dict[str, Any]:
    """What a reader of a study needs to make it again: command, code, machine, sizes and configuration.

    Args:
        cfg: of the study.
        recipe: its name.
        scenes: that were rolled out.
        measured: what :func:`study` gave.
    """
    return {
        **provenance(recipe, cfg.device),
        "scenes": len(scenes),
        "policies": list(measured),
        "num_rollouts": cfg.num_rollouts,
        "config": plain(cfg),
    }


def over_scenes(values: np.ndarray, name: str) -> Interval:
    """Mean over the scenes at which every policy has a value.

    Raises:
        ValueError: there is none.
    """
    known = ~np.isnan(values).any(0)
    if not known.any():
        raise ValueError(
            f"{name}: in no scene do both measures tell rollouts apart, so that nothing is ranked; choose other scenes."
        )
    return summary(values[:, known])


def with_realism(rows: Sequence[Sequence[Mapping[str, Any]]], realism: Callable[[Any], Sequence[Any]]) -> list[int]:
    """Places of the scenes that have realism under all policies.

    Args:
        rows: for each policy what was measured of each scene.
        realism: of what was measured of a scene the values that must be known.

    Raises:
        ValueError: there is none.
    """
    places = [i for i in range(len(rows[0])) if all(None not in realism(row[i]) for row in rows)]
    if not places:
        raise ValueError("no scene has realism: none scores all features of the metric; choose scenes with vehicles.")
    return places


def as_json(content: Any) -> Any:
    """Intervals anywhere in dicts and lists as plain JSON; None where a number is not known."""
    if isinstance(content, Interval):
        return {"mean": content.mean, "ci95": [content.low, content.high], "scenes": content.num_scenes}
    if isinstance(content, dict):
        return {key: as_json(value) for key, value in content.items()}
    return None if content is None else [as_json(value) for value in content]
