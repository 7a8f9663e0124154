"""Score a policy: WOSAC realism, minADE, collisions, off-road and the preference distance (METHOD section 7).

python -m recipes.evaluate policy=runs/pretrain/policy.pt decoding.top_p=0.9 json=runs/reference.json
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig

from dpa.ranking import PreferenceDistance
from dpa.realism import mean_result, realism
from dpa.rollout import Decoding, collect_groups, lifted, simulated_poses
from envs import keys
from envs.progress import progress
from envs.scene import CURRENT_STEP
from envs.store import SceneStore
from recipes.cli import CONFIG, build, finished, plain, recipe, write_json
from recipes.models import open_policy, weights_digest
from recipes.scenes import fingerprint, open_splits

STANDING, MOVED = 0.5, 2.0
"""An agent whose log moves less than the first stands; one that a rollout moves more than the second does not [m]."""
SCENE_FIGURES = (
    "realism",
    "kinematic",
    "interactive",
    "map_based",
    "min_ade",
    "collision_rate",
    "offroad_rate",
    "preference_distance",
    "standing_moved",
)
"""Figures of every scene, averaged over scenes."""


def evaluate(cfg: DictConfig, scenes: SceneStore, policy: Path, top_p: float, seed: int, path: Path) -> dict[str, Any]:
    """Score one policy on some scenes; a finished result of the same options is read back.

    Args:
        cfg: with the sections ``evaluation``, ``collection.ranking`` and ``device``.
        scenes: to roll out.
        policy: file of the policy.
        top_p: nucleus of the sampling.
        seed: of the sampling.
        path: JSON to write.

    Returns:
        ``options``, ``mean`` (each figure of :data:`SCENE_FIGURES`), ``likelihood`` (of each realism feature), ``scenes``
        (ids) and ``per_scene`` (each figure as a list).
    """
    options = cfg.evaluation
    model, context, _ = open_policy(policy, cfg.device)
    decided_by = {
        "policy": weights_digest(model),
        "scenes": fingerprint(scenes),
        "evaluation": plain(options),
        "ranking": plain(cfg.collection.ranking),
        "top_p": top_p,
        "seed": seed,
    }
    done = finished(path, decided_by)
    if done is not None:
        return done
    distance = build(PreferenceDistance, cfg.collection.ranking, "collection.ranking")
    figures: dict[int, dict[str, float]] = {}
    results = {}
    with progress(total=len(scenes), description=f"evaluate top-p {top_p:g}", unit="scene") as bar:
        for batch in collect_groups(
            scenes,
            model,
            range(len(scenes)),
            num_rollouts=options.num_rollouts,
            decoding=Decoding(top_p, options.temperature),
            options=context,
            seed=seed,
            max_rows=options.max_rows,
            device=cfg.device,
        ):
            poses = simulated_poses(batch, options.num_rollouts).cpu()
            controlled = batch[keys.CONTROLLED][:: options.num_rollouts, 0].cpu()
            for row, index in enumerate(batch[keys.SCENE][:: options.num_rollouts, 0].tolist()):
                scene = scenes[index]
                trajectories = lifted(scene, poses[row])
                results[index] = realism(scene, trajectories, options.metric)
                ranking = distance(scene, trajectories, controlled[row, : trajectories.shape[1]])
                figures[index] = results[index].as_dict() | {
                    "preference_distance": ranking.distance.mean().item(),
                    "standing_moved": standing_moved(scene, trajectories),
                }
                bar.update()
    order = sorted(figures)
    mean = mean_result([results[i] for i in order])
    per_scene = {name: [_finite(figures[i][name]) for i in order] for name in SCENE_FIGURES}
    content = {
        "options": decided_by,
        "mean": {name: _mean(values) for name, values in per_scene.items()},
        "likelihood": {name: _finite(value) for name, value in mean.likelihood.items()},
        "scenes": [scenes.scene_ids[i] for i in order],
        "per_scene": per_scene,
    }
    write_json(path, content)
    return content


def standing_moved(scene: Any, trajectories: torch.Tensor) -> float:
    """Share of agents standing in the log that rollouts move: a sign of a policy that flattens (NaN: nobody stands).

    Args:
        scene: uncollated.
        trajectories: ``[K, A, T * F, 4]`` of the present agents.
    """
    agents = scene.agents
    xy, valid = agents.position[agents.present][:, CURRENT_STEP:, :2], agents.valid[agents.present][:, CURRENT_STEP:]
    away = (xy - xy[:, :1]).norm(dim=-1) * valid
    standing = (away.amax(-1) < STANDING) & valid[:, -1]
    if not standing.any():
        return float("nan")
    moved = (trajectories[:, standing, -1, :2] - xy[standing, 0]).norm(dim=-1) > MOVED
    return moved.float().mean().item()


def _finite(value: float) -> float | None:
    return value if value == value else None


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


@hydra.main(**CONFIG, config_name="evaluate")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.evaluate``."""
    scenes = getattr(open_splits(cfg.scenes), cfg.split)
    result = evaluate(cfg, scenes, Path(cfg.policy), cfg.decoding.top_p, cfg.seed, Path(cfg.json))
    width = max(map(len, SCENE_FIGURES))
    for name, value in result["mean"].items():
        print(f"{name:{width}}  {'–' if value is None else format(value, '.4f')}")
    print(
        f"{len(scenes)} scenes, {cfg.evaluation.num_rollouts} rollouts each, metric {cfg.evaluation.metric}: {cfg.json}"
    )


if __name__ == "__main__":
    main()
