"""What does a discriminator rank rollouts by (figure 10 of the paper)?

python -m recipes.discriminator policies=[runs/pretrain/policy.pt]

For each policy a discriminator learns to tell the logs of the training scenes from the policy's rollouts of them. Then
it ranks the rollouts of scenes that it has not seen: by how smooth they are, or by what they do? Run the same command
again to go on after a kill.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from dpa.discriminator import Discriminator, mean_squared_jerk, until_first_hole
from dpa.ranking import Distance, occupancy_features
from dpa.realism import RealismConfig, realism_of_groups
from dpa.report.studies import plot_discriminator
from dpa.tokens import MotionTokenizer
from dpa.training.checkpoint import load_policy, load_weights, save_policy
from envs.episode import EpisodeOptions
from envs.files import write_json
from envs.locks import alone_in
from envs.progress import progress
from envs.store import SceneStore
from recipes.common.cli import CONFIG, build, finished, finite, plain, study_recipe
from recipes.common.models import given_policies, open_policy, weights_digest
from recipes.common.rankings import build_distance
from recipes.common.rolled import Rolled, driven, driven_log
from recipes.common.scenes import fingerprint, open_splits
from recipes.studies.adversary import best_look, fit
from recipes.studies.motions import MotionShelf, Sight
from recipes.studies.spurious import QUANTITIES, RANKINGS, summarise
from recipes.studies.study import (
    RANDOM_GROUPS,
    as_json,
    how_made,
    random_groups,
    study_policy,
)
from recipes.studies.tables import StudyTable, tell

FIGURES = ("realism", "kinematic", "interactive", "map_based")
SMALLEST = 8
"""Rollouts of a scene that have quarters worth looking at."""


def trained(cfg: DictConfig, scenes: SceneStore, policy: Path, name: str) -> tuple[Discriminator, dict[str, Any]]:
    """The discriminator of a policy's rollouts, trained or read back, and how its training went.

    Args:
        cfg: options of the recipe.
        scenes: to train on.
        policy: whose rollouts it learns from.
        name: of the policy.

    Raises:
        ValueError: the folder holds another training, or too few scenes have an agent to look at.
    """
    folder, sight = Path(cfg.output) / name.replace("/", "_"), build(Sight, cfg.sight, "sight")
    result, weights = folder / "training.json", folder / "discriminator.pt"
    model, episode, _ = open_policy(policy, cfg.device)
    shape = {"num_features": sight.width, "width": cfg.training.width}
    decided_by = {
        "policy": weights_digest(model),
        "scenes": fingerprint(scenes),
        "sight": plain(cfg.sight),
        "training": plain(cfg.training),
        "decoding": plain(cfg.decoding),
        "seed": cfg.seed,
    }
    rolled_by = {key: decided_by[key] for key in ("policy", "scenes", "sight", "decoding", "seed")}
    with alone_in(folder):
        shelf = MotionShelf(folder / "motions", rolled_by | {"num_rollouts": cfg.training.num_rollouts})
        done = finished(result, decided_by)
        if done is not None and weights.is_file():
            shelf.remove()  # where a command was killed at its end
            net = Discriminator(**shape)
            load_weights(net, *load_policy(weights)[:2], shape, where=str(weights))
            return net.eval(), done
        there = frozenset(shelf.scenes())
        see = partial(seen, sight=sight, tokenizer=model.tokenizer.on_cpu(), options=episode)
        rolling = OmegaConf.merge(cfg, {"num_rollouts": cfg.training.num_rollouts})
        with progress(total=len(scenes), description=f"{name} rollouts", initial=len(there), unit="scene") as bar:
            for each in driven(scenes, model, episode, rolling, there):
                shelf.put(each.index, see(each)[0])
                bar.update()
    net, curve = fit(cfg.training, shape, shelf, folder, seed=cfg.seed, decided_by=decided_by, logger=cfg.logger)
    save_policy(weights, net.state_dict(), shape, {"seed": cfg.seed})
    done = {"options": decided_by, "scenes": len(scenes), "best": best_look(curve), "curve": curve}
    write_json(result, done)
    shelf.remove()
    return net, done


def seen(each: Rolled, sight: Sight, tokenizer: MotionTokenizer, options: EpisodeOptions) -> tuple[Any, Tensor]:
    """The motions of a scene's log and rollouts, and the log ``[A, 80, 4]`` that they were compared with."""
    log = driven_log(each.scene, tokenizer if sight.tokenized else None, options)
    return sight(each, log, options.decision_steps if sight.tokenized else 1), log


@torch.no_grad()
def measure_scene(
    each: Rolled,
    net: Discriminator,
    sight: Sight,
    tokenizer: MotionTokenizer,
    options: EpisodeOptions,
    distance: Distance,
    metric: RealismConfig,
    seed: int,
) -> dict[str, Any]:
    """Scores of all rollouts and of the log, what was measured of them, and the realism of every ranking's quarters.

    Args:
        each: scene and rollouts.
        net: the discriminator.
        sight: what it sees.
        tokenizer: of the policy.
        options: of the episodes.
        distance: the preference distance.
        metric: the realism metric.
        seed: of the random groups.
    """
    motions, log = seen(each, sight, tokenizer, options)
    # Past it the log that rollouts are compared with means nothing.
    scene = until_first_hole(each.scene, options.decision_steps)
    score, log_score = net.score(motions.rollouts, motions.valid), net.score(motions.log, motions.valid)
    ego = each.controlled.nonzero()[:, 0]
    both = torch.cat((log[None], each.trajectories))
    jerks = {
        "jerk": mean_squared_jerk(scene, both, ego=ego),
        "jerk_2hz": mean_squared_jerk(scene, both, ego=ego, stride=5),
    }
    ranking = distance(each.scene, each.trajectories, each.controlled)
    quantity = {name: value[1:] for name, value in jerks.items()}
    quantity |= {"distance": ranking.distance, "ade": ranking.ade, **event_rates(each)}
    scores = {"discriminator": score, "distance": -ranking.distance, "ade": -ranking.ade}
    return {
        "score": score.tolist(),
        "quantity": {name: quantity[name].tolist() for name in QUANTITIES},
        "log": {"score": log_score.item(), **{name: value[0].item() for name, value in jerks.items()}},
        "realism": realism_of_quarters(each, scores, metric, seed),
    }


def event_rates(each: Rolled) -> dict[str, Tensor]:
    """``collision`` and ``offroad``: share of the controlled agents that ever do so in each rollout, ``[K]``."""
    ego = each.controlled.nonzero()[:, 0]
    names = ("clearance", "road_edge")
    phi, valid = occupancy_features(each.scene, each.trajectories, names, ego=ego)
    counted = valid.any(-1).sum().clamp(min=1)
    touched, off = (((event & valid).any(-1).sum(-1) / counted) for event in (phi[..., 0] < 0, phi[..., 1] > 0))
    return {"collision": touched, "offroad": off}


def realism_of_quarters(each: Rolled, scores: dict[str, Tensor], metric: RealismConfig, seed: int) -> dict[str, Any]:
    """Realism of the ``best`` and ``worst`` quarter of each ranking, and the mean over ``random`` groups of that size.

    Args:
        each: scene and rollouts.
        scores: ``[K]`` of each ranking, the best rollout with the highest; ties go to the smaller index.
        metric: the realism metric.
        seed: of the random groups.
    """
    size = len(each.trajectories) // 4
    groups = random_groups(each, size, seed, "discriminator")
    for score in scores.values():
        order = score.argsort(descending=True, stable=True)
        groups += [order[:size], order[-size:]]
    results = realism_of_groups(each.scene, each.trajectories, groups, metric)
    figures = [{figure: finite(getattr(result, figure)) for figure in FIGURES} for result in results]
    random, chosen = figures[:RANDOM_GROUPS], iter(figures[RANDOM_GROUPS:])
    return {name: {"best": next(chosen), "worst": next(chosen)} for name in scores} | {"random": _mean(random)}


def _mean(groups: list[dict[str, float | None]]) -> dict[str, float | None]:
    """Of each figure over groups; None where it is not defined."""
    columns = {figure: [group[figure] for group in groups] for figure in FIGURES}
    return {figure: None if None in values else sum(values) / len(values) for figure, values in columns.items()}


def check(cfg: DictConfig) -> None:
    """Refuse options before any work.

    Raises:
        ValueError: too few rollouts, a share that is none, or a split that is trained on.
    """
    if cfg.num_rollouts < SMALLEST:
        raise ValueError(f"num_rollouts must be {SMALLEST} or more, got {cfg.num_rollouts}.")
    if cfg.split == "train":
        raise ValueError("split=train ranks the scenes that the discriminator learns from; say split=tune.")
    if not 0 < cfg.training.held_out < 1:
        raise ValueError(f"training.held_out must lie between 0 and 1, got {cfg.training.held_out}.")


@hydra.main(**CONFIG, config_name="discriminator")
@study_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.discriminator``."""
    check(cfg)
    metric = RealismConfig.load(str(cfg.metric))
    sight, distance = build(Sight, cfg.sight, "sight"), build_distance(cfg.ranking, "ranking")
    policies, splits = given_policies(cfg), open_splits(cfg.scenes)
    scenes, measured, training = splits[cfg.split], {}, {}
    for name, path in policies.items():
        net, training[name] = trained(cfg, splits.train, path, name)
        model, episode, _ = open_policy(path, "cpu")
        decided_by = {
            "discriminator": weights_digest(net),
            "sight": plain(cfg.sight),
            "ranking": distance.describe(),
            "metric": metric.describe(),
        }
        measure = partial(
            measure_scene,
            net=net,
            sight=sight,
            tokenizer=model.tokenizer,
            options=episode,
            distance=distance,
            metric=metric,
            seed=cfg.seed,
        )
        measured[name] = study_policy(cfg, scenes, path, measure, decided_by, name)
    found, folder = summarise(measured), Path(cfg.output)
    picture = folder / "discriminator.png"
    plot_discriminator(found, picture)
    made = how_made(cfg, "discriminator", scenes, measured)
    write_json(folder / "summary.json", summary_json(found, training) | {"made": made})
    head = f"{len(scenes)} scenes, {len(training)} policies, {cfg.num_rollouts} rollouts"
    tell(cfg, tables(found, training, head, cfg.metric), {"correlation/discriminator": picture})
    print(f"numbers of every scene, summary and figure: {folder}")


def summary_json(found: dict[str, Any], training: dict[str, dict]) -> dict[str, Any]:
    """What was found, and how the training of each policy's discriminator went, for a report."""
    return as_json(found) | {
        "labels": QUANTITIES,
        "policies": {
            name: {"best": done["best"], "curve": done["curve"], "training_scenes": done["scenes"]}
            for name, done in training.items()
        },
    }


def tables(found: dict[str, Any], training: dict[str, dict], title: str, metric: str) -> list[StudyTable]:
    """What was found, and how the training of each policy's discriminator went, row by row."""
    correlation = {
        called: [
            *(found["correlation"][quantity][name] for name in (*RANKINGS, "random")),
            *(found["given"][quantity].get(fixed) for fixed in ("jerk", "distance")),
        ]
        for quantity, called in QUANTITIES.items()
    }
    quarters = {name: [found["realism"][name][end]["realism"] for end in ("best", "worst")] for name in RANKINGS} | {
        f"discriminator minus {name}": [value, None] for name, value in found["minus"].items()
    }
    log = {
        "rollouts that score below the log": [found["auc"]["discriminator"]],
        "rollouts that are jerkier than the log": [found["auc"]["jerk"]],
        "|Spearman with jerk| minus |Spearman with the distance|": [found["jerk_minus_distance"]],
    }
    looks = {
        name: [done["best"][key] for key in ("held_out_auc", "held_out_loss", "step")]
        for name, done in training.items()
    }
    fixed = ("random", "discriminator, jerk fixed", "distance fixed")
    return [
        StudyTable(
            "correlation", f"{title}: Spearman with the score of", ["within a scene", *RANKINGS, *fixed], correlation
        ),
        StudyTable(
            "quarters",
            f"realism ({metric}) minus that of random groups",
            ["ranking", "best quarter", "worst quarter"],
            quarters,
        ),
        StudyTable("log", "rollouts beside the log", ["of a scene", "mean"], log),
        StudyTable(
            "training",
            "training scenes that were held out",
            ["policy", "held-out AUC", "held-out loss", "steps"],
            looks,
            signed=False,
        ),
    ]


if __name__ == "__main__":
    main()
