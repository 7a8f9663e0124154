"""Score a policy: WOSAC realism, minADE, collisions and off-road, also by class, the preference distance, and safety.

python -m recipes.evaluate policy=runs/pretrain/policy.pt decoding.top_p=0.9 json=runs/reference.json
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig

from dpa.models import Decoding
from dpa.ranking import Distance
from dpa.realism import CLASS_RATES, RealismConfig, RealismResult, class_rates, mean_result, realism
from dpa.realism.submission import SubmissionWriter, plan_submission
from dpa.rollout import make_collector
from dpa.safety import MEASURES, safety
from envs.files import write_json
from envs.progress import progress
from envs.scene import CURRENT_STEP
from envs.store import SceneStore
from recipes.common.cli import CONFIG, build, deciding, finished, finite, mean_known, recipe
from recipes.common.models import given_policy, open_policy, weights_digest
from recipes.common.partial import PartialResult
from recipes.common.rankings import build_distance
from recipes.common.rolled import Rolled, final_spread, rolled
from recipes.common.scenes import fingerprint, open_splits

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
    "spread",
    *MEASURES,
)
"""Figures of every scene, averaged over scenes, that comparisons tell as well."""
FIGURES = (*SCENE_FIGURES, *CLASS_RATES)
"""Those that an evaluation tells."""


def evaluate(
    cfg: DictConfig,
    scenes: SceneStore,
    policy: Path,
    decoding: Decoding,
    seed: int,
    path: Path,
    open_submission: Callable[[Sequence[str], Mapping[str, Any]], SubmissionWriter] | None = None,
) -> dict[str, Any]:
    """Score one policy on some scenes; a finished result of the same options is read back, an unfinished one goes on.

    Args:
        cfg: with the sections ``evaluation``, ``collection.ranking`` and ``device``.
        scenes: to roll out.
        policy: file of the policy.
        decoding: how tokens are drawn.
        seed: of the sampling.
        path: JSON to write.
        open_submission: where the rollouts go as well, from :func:`~dpa.realism.submission.plan_submission`.

    Returns:
        ``options``, ``mean`` (each figure of :data:`FIGURES`), ``likelihood`` (of each realism feature),
        ``scenes`` (ids) and ``per_scene`` (each figure as a list).
    """
    options = cfg.evaluation
    model, episode, _ = open_policy(policy, cfg.device)
    distance = build_distance(cfg.collection.ranking, "collection.ranking")
    metric = RealismConfig.load(str(options.metric))
    decided_by = {
        "policy": weights_digest(model),
        "scenes": fingerprint(scenes),
        "evaluation": deciding(options, "memory") | {"metric": metric.describe()},
        "ranking": distance.describe(),
        "decoding": asdict(decoding),
        "seed": seed,
    }
    done = finished(path, decided_by)
    if done is not None and not set(FIGURES) <= done["per_scene"].keys():
        done = None  # of an earlier version, which had fewer figures
    submission = None if open_submission is None else open_submission(scenes.scene_ids, decided_by)
    if done is not None and (submission is None or submission.finished):
        return done
    partial = PartialResult(path, decided_by | {"figures": list(FIGURES)})
    scored = partial.read()
    # A scene is done once it is scored and, where a submission is written, in there as well.
    ready = frozenset(scored) if submission is None else submission.done & scored.keys()
    bar = progress(
        total=len(scenes), description=f"evaluate top-p {decoding.top_p:g}", initial=len(ready), unit="scene"
    )
    with bar, submission or nullcontext():
        batches = make_collector(
            scenes,
            model,
            num_rollouts=options.num_rollouts,
            done=ready,
            decoding=decoding,
            options=episode,
            seed=seed,
            memory=options.memory,
            device=cfg.device,
        )
        for each in rolled(batches, scenes, options.num_rollouts, ready):
            scored[each.index] = score_scene(each, distance, metric)
            partial.add({each.index: scored[each.index]})
            if submission is not None:
                submission.add(each.index, each.scene, each.trajectories, each.controlled)
            bar.update()
        if submission is not None:
            submission.finish()
    content = {"options": decided_by, **summarise([scored[i] for i in range(len(scenes))], scenes.scene_ids)}
    write_json(path, content)
    partial.remove()
    return content


def score_scene(each: Rolled, distance: Distance, metric: RealismConfig) -> dict[str, Any]:
    """The :class:`~dpa.realism.RealismResult` of one scene's rollouts as plain numbers, and figures of our own.

    Args:
        each: scene and rollouts.
        distance: how far rollouts are from the log.
        metric: the realism metric.
    """
    result = realism(each.scene, each.trajectories, metric, features=True)
    return {
        "result": asdict(replace(result, features=None)),
        "preference_distance": distance(each.scene, each.trajectories, each.controlled).distance.mean().item(),
        "standing_moved": standing_moved(each.scene, each.trajectories),
        "spread": final_spread(each.scene, each.trajectories, each.controlled),
        **safety(each.scene, each.trajectories, each.controlled),
        **class_rates(result.features, metric),
    }


def summarise(scored: list[dict[str, Any]], scene_ids: list[str]) -> dict[str, Any]:
    """Means over scenes and the figures of each, from what :func:`score_scene` gives for each scene."""
    results = [RealismResult(**entry["result"]) for entry in scored]
    figures = [result.as_dict() | entry for result, entry in zip(results, scored, strict=True)]
    per_scene = {name: [finite(figure[name]) for figure in figures] for name in FIGURES}
    return {
        "mean": {name: mean_known(values) for name, values in per_scene.items()},
        "likelihood": {name: finite(value) for name, value in mean_result(results).likelihood.items()},
        "scenes": scene_ids,
        "per_scene": per_scene,
    }


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


@hydra.main(**CONFIG, config_name="evaluate")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.evaluate``."""
    if cfg.json is None:
        raise ValueError("json=null: the result needs a file, from which it also goes on after a kill; say json=FILE.")
    plan = None
    if cfg.submission is not None:
        rollouts = cfg.evaluation.num_rollouts
        plan = plan_submission(cfg.submission, cfg.submission_metadata, rollouts, cfg.submission_shards)
    policy, decoding = given_policy(cfg.policy), build(Decoding, cfg.decoding, "decoding")
    scenes = open_splits(cfg.scenes)[cfg.split]
    result = evaluate(cfg, scenes, policy, decoding, cfg.seed, Path(cfg.json), plan)
    width = max(map(len, FIGURES))
    for name, value in result["mean"].items():
        print(f"{name:{width}}  {'–' if value is None else format(value, '.4f')}")
    print(
        f"{len(scenes)} scenes, {cfg.evaluation.num_rollouts} rollouts each, metric {cfg.evaluation.metric}: {cfg.json}"
    )


if __name__ == "__main__":
    main()
