"""What ranks rollouts, from YAML; and the ranked rollouts on disk, of the scenes and the policy at hand."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from dpa.policy import MotionLM
from dpa.preferences import PreferenceStore
from dpa.ranking import Distance, PreferenceDistance
from dpa.ranking.rival import DisplacementDistance
from envs.store import SceneStore
from recipes.cli import build
from recipes.models import weights_digest
from recipes.scenes import fingerprint

DISTANCES: dict[str, type[Distance]] = {"preference": PreferenceDistance, "displacement": DisplacementDistance}
"""Distances that a YAML of ``config/ranking`` can name; add a class of your own here (docs/how-to.md)."""


def build_distance(section: DictConfig, name: str) -> Distance:
    """The distance that a section names by ``kind``; without one it is the preference distance.

    Raises:
        ValueError: no such kind, or an option that it does not take; the message names it.

    Examples:
        >>> build_distance(OmegaConf.create({"kind": "displacement", "measure": "final"}), "collection.ranking")
        DisplacementDistance(measure='final', aggregate='mean', agents='controlled')
    """
    kind = section.get("kind", "preference")
    if kind not in DISTANCES:
        raise ValueError(f"{name}.kind must be one of {sorted(DISTANCES)}, got {kind!r}.")
    options = {key: value for key, value in section.items() if key != "kind"}
    return build(DISTANCES[kind], OmegaConf.create(options), name)


def open_preferences(folder: str | Path, scenes: SceneStore, model: MotionLM, policy: str | Path) -> PreferenceStore:
    """A preference store, refused where its tokens would mean nothing here.

    Args:
        folder: of the store.
        scenes: that it must be of.
        model: that must have made its rollouts.
        policy: file of the model, for the message.

    Raises:
        ValueError: it is of other scenes or of another policy.
    """
    store = PreferenceStore(folder)
    if store.provenance.scenes != fingerprint(scenes):
        raise ValueError(
            f"{folder} ranks rollouts of other scenes; give the scenes and the split that it was collected with, or "
            "collect again."
        )
    if store.provenance.policy != weights_digest(model):
        raise ValueError(f"{folder} ranks rollouts of another policy than {policy}; give that one, or collect again.")
    return store
