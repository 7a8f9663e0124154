"""What ranks rollouts, from YAML; and the ranked rollouts on disk, of the scenes and the policy at hand."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from dpa.models import MotionModel
from dpa.preferences import PreferenceStore
from dpa.ranking import Distance, PreferenceDistance, Ranking
from dpa.ranking.rival import DisplacementDistance
from dpa.rewards import RealismRanking
from envs.scene import Scene
from envs.store import SceneStore
from recipes.common.cli import build
from recipes.common.models import weights_digest
from recipes.common.scenes import fingerprint

DISTANCES: dict[str, type[Distance]] = {
    "preference": PreferenceDistance,
    "displacement": DisplacementDistance,
    "realism": RealismRanking,
}
"""Distances that a YAML of ``config/ranking`` can name; add a class of your own here (docs/how-to.md)."""


def build_distance(section: DictConfig, name: str) -> Distance:
    """The distance that a section names by ``kind``; without one it is the preference distance.

    Raises:
        ValueError: no such kind, or an option that it does not take; the message names it.

    Examples:
        >>> build_distance(OmegaConf.create({"kind": "displacement", "measure": "final"}), "collection.ranking")
        DisplacementDistance(measure='final', aggregate='mean', agents='controlled')
    """
    if not OmegaConf.is_dict(section):
        raise ValueError(
            f"{name} must be a section of options, got {section!r}; say {name}={{kind: {section}}}, or take a file of "
            f"recipes/config/ranking by ranking@{name}=FILE."
        )
    kind = section.get("kind", "preference")
    if kind not in DISTANCES:
        raise ValueError(f"{name}.kind must be one of {sorted(DISTANCES)}, got {kind!r}.")
    options = {key: value for key, value in section.items() if key != "kind"}
    return build(DISTANCES[kind], OmegaConf.create(options), name)


def ranking_options(section: DictConfig, differing: DictConfig) -> DictConfig:
    """Options of another distance: those of a section where it does not say otherwise; of another kind, its own alone.

    Examples:
        >>> section = OmegaConf.create({"kind": "preference", "stride": 5, "weights": "paper"})
        >>> ranking_options(section, OmegaConf.create({"weights": "normalised"}))
        {'kind': 'preference', 'stride': 5, 'weights': 'normalised'}
        >>> ranking_options(section, OmegaConf.create({"kind": "displacement", "measure": "final"}))
        {'kind': 'displacement', 'measure': 'final'}
    """
    if not OmegaConf.is_dict(differing) or differing.get("kind", section.kind) != section.kind:
        return differing
    return OmegaConf.merge(section, differing)


def open_ranked_scenes(folder: str | Path, scenes: SceneStore) -> PreferenceStore:
    """A preference store of some scenes, whoever rolled them out.

    Raises:
        ValueError: it is of other scenes: its indices would mean nothing here.
    """
    store = PreferenceStore(folder)
    if store.provenance.scenes != fingerprint(scenes):
        raise ValueError(
            f"{folder} ranks rollouts of other scenes; give the scenes and the split that it was collected with, or "
            "collect again."
        )
    return store


def open_preferences(folder: str | Path, scenes: SceneStore, model: MotionModel, policy: str | Path) -> PreferenceStore:
    """A preference store, refused where its tokens would mean nothing here.

    Args:
        folder: of the store.
        scenes: that it must be of.
        model: that must have made its rollouts.
        policy: file of the model, for the message.

    Raises:
        ValueError: it is of other scenes or of another policy.
    """
    store = open_ranked_scenes(folder, scenes)
    if store.provenance.policy != weights_digest(model):
        raise ValueError(f"{folder} ranks rollouts of another policy than {policy}; give that one, or collect again.")
    return store


class TimedDistance:
    """A distance that adds up the seconds that it takes in this process.

    Args:
        distance: that does the work.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> from dpa.ranking import log_trajectory
        >>> scene, timed = straight_road(2), TimedDistance(DisplacementDistance())
        >>> ranking = timed(scene, log_trajectory(scene, 80)[None], None)
        >>> timed.seconds > 0 and timed.on_device and timed.describe() == DisplacementDistance().describe()
        True
    """

    def __init__(self, distance: Distance) -> None:
        self.distance, self.seconds = distance, 0.0

    @property
    def on_device(self) -> bool:
        """Whether the distance ranks where trajectories were rolled out."""
        return getattr(self.distance, "on_device", False)

    def describe(self) -> dict[str, Any]:
        """That of the distance."""
        return self.distance.describe()

    def __call__(self, scene: Scene, trajectories: Tensor, controlled: Tensor) -> Ranking:
        """Rank, and look at the clock."""
        wait = partial(torch.cuda.synchronize, trajectories.device) if trajectories.is_cuda else lambda: None
        wait()
        start = time.perf_counter()
        ranking = self.distance(scene, trajectories, controlled)
        wait()
        self.seconds += time.perf_counter() - start
        return ranking
