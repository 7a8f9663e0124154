"""Who collides, and how they met: the first collision of every evaluated agent, by class.

python -m recipes.encounters 'policies=[zoo:motionlm-nano-sumo,zoo:smart-nano-sumo]'

With somebody beside them, ahead or behind, headed across or oncoming: what a collision rate sums up. Of several
policies each is also told minus the first, scene by scene. Run the same command again to go on after a kill, with the
next scene.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig

from dpa.realism import Encounter, RealismConfig, compare, encounters, measure
from envs.episode import EpisodeOptions
from envs.files import write_json
from envs.scene import AgentKind
from envs.store import SceneStore
from recipes.common.cli import CONFIG, plain, study_recipe
from recipes.common.models import given_policies, open_policy, weights_digest
from recipes.common.rolled import Rolled, driven, logs
from recipes.common.scenes import open_splits
from recipes.studies.rows import Roll, measure_rows
from recipes.studies.tables import StudyTable, compared, tell

CLASSES = {AgentKind.VEHICLE: "vehicles", AgentKind.PEDESTRIAN: "pedestrians", AgentKind.CYCLIST: "cyclists"}
MET = {
    Encounter.BESIDE: "beside",
    Encounter.IN_LINE: "ahead or behind",
    Encounter.CROSSING: "crossing",
    Encounter.ONCOMING: "oncoming",
}
ALL = "all"
Figures = dict[str, dict[str, list[float | None]]]
"""By class and by how they met, the share of each scene; None where nobody of the class is evaluated."""


def look(each: Rolled, metric: RealismConfig) -> dict[str, dict[str, float | None]]:
    """How the evaluated agents of each class met whom they collided with first.

    Args:
        each: scene and rollouts.
        metric: whose collisions these are.

    Returns:
        Shares of (rollout, agent) pairs, ``all`` of them summed; None where nobody of the class is evaluated.
    """
    comparison = compare(each.scene, each.trajectories, metric)
    measured = measure([comparison], metric)[0]
    met = encounters(comparison.tracks, measured, metric)[1:]
    found: dict[str, dict[str, float | None]] = {}
    for kind, name in CLASSES.items():
        mine = met[:, measured.kind == kind]
        shares = {told: (mine == how).float().mean().item() if mine.numel() else None for how, told in MET.items()}
        found[name] = {ALL: (mine != Encounter.NONE).float().mean().item() if mine.numel() else None, **shares}
    return found


def rows(cfg: DictConfig, files: Mapping[str, Path], scenes: SceneStore) -> Iterator[tuple[str, dict[str, Any], Roll]]:
    """Name of each row, what decides it, and its rollouts: the log, then the policies."""
    yield "log", {}, partial(logs, scenes, EpisodeOptions(), None)
    for name, path in files.items():
        model, options, config = open_policy(path, cfg.device)
        told = {"policy": weights_digest(model), **config, "decoding": plain(cfg.decoding), "seed": cfg.seed}
        yield name, told | {"num_rollouts": cfg.num_rollouts}, partial(driven, scenes, model, options, cfg)


def tables(found: Mapping[str, Figures], names: Sequence[str]) -> Iterator[StudyTable]:
    """Of each class every row with intervals over scenes, and each further policy minus the first, scene by scene.

    Args:
        found: a value for each scene by row, class and how they met.
        names: of the policies.
    """
    first, *others = names
    for kind in CLASSES.values():
        shares = {name: figures[kind] for name, figures in found.items()}
        known = sum(value is not None for value in shares[first][ALL])
        if known:
            columns = [f"{kind} collide", ALL, *MET.values()]
            yield from compared(
                kind, f"{known} scenes with {kind}", columns, shares, dict.fromkeys(others, first), first
            )


@hydra.main(**CONFIG, config_name="encounters")
@study_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.encounters``."""
    policies = given_policies(cfg)
    scenes = open_splits(cfg.scenes)[cfg.split]
    metric = RealismConfig.load(str(cfg.metric))
    common = {"metric": metric.describe()}
    found = measure_rows(cfg.output, common, scenes, rows(cfg, policies, scenes), partial(look, metric=metric))
    tell(cfg, list(tables(found, list(policies))), {})
    if cfg.json is not None:
        write_json(cfg.json, {"scenes": len(scenes), "rows": found})


if __name__ == "__main__":
    sys.exit(main())
