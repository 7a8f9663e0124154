"""A ladder for sanity: what the realism metric gives to the log itself, to crude rollouts, and to models.

python -m recipes.ladder scenes=gpudrive scenes.train=DIR scenes.eval=DIR policies=[runs/pretrain/policy.pt]

A metric that is worth trusting puts the rungs in their order. Run the same command again to go on after a kill: rungs
that are there are read back. Of scenes from SUMO, ``simulator=true`` adds what SUMO itself does when it goes on from
the current step: what the logs were drawn from, by one who knows all drivers, and everybody's way or only what can be
seen of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import compress
from typing import Any

import hydra
import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from dpa.ranking import agent_spread
from dpa.realism import CLASS_RATES, RealismConfig, class_rates, realism
from dpa.report.statistics import summary
from dpa.training.seeding import seed_everything
from envs.files import write_json
from envs.scene import Scene, SceneSource
from envs.seeding import make_generator
from envs.sources.sumo.futures import Keeps
from envs.store import SceneStore
from recipes.common.cli import CONFIG, finite, mean_known, plain, recipe
from recipes.common.models import (
    episode_options,
    fresh_policy,
    given_policies,
    open_policy,
    policies_of,
    policy_config,
    weights_digest,
)
from recipes.common.rolled import Rolls, driven
from recipes.common.scenes import fingerprint, open_splits
from recipes.studies.rows import looked_at, read_or_score
from recipes.studies.rungs import (
    Rung,
    Simulator,
    constant_velocity,
    logged,
    noisy_log,
    random_tokens,
    tokenized_log,
)
from recipes.studies.tables import StudyTable, tell

BESIDES = {
    "min_ade": "minADE [m]",
    "collision_rate": "collision",
    **{name: name.replace("_", " ") for name in CLASS_RATES},
    "offroad_rate": "off-road",
    "spread": "spread [m]",
}
"""What is told beside realism; of a class, over the scenes that evaluate somebody of it."""
SIMULATOR: dict[str, Keeps] = {
    "SUMO again": "all",
    "SUMO, other random numbers": "ways",
    "SUMO, other ways too": "drivers",
}
"""Rungs of SUMO itself, and what each keeps of the log."""
FIGURES = ("realism", "kinematic", "interactive", "map_based", *BESIDES)
"""What is kept of every scene."""


def score_rung(scenes: SceneSource, rollouts: Rolls, metrics: Mapping[str, RealismConfig], name: str) -> dict:
    """``{year: {figure: one value per scene}}`` of one rung; None where a scene has none."""

    def figures(scene: Scene, poses: Tensor) -> dict[str, dict[str, float]]:
        return {year: _figures(scene, poses, metric) for year, metric in metrics.items()}

    found = looked_at(scenes, rollouts, figures, name)
    return {year: {key: [finite(each[year][key]) for each in found] for key in FIGURES} for year in metrics}


def _figures(scene: Scene, poses: Tensor, metric: RealismConfig) -> dict[str, float]:
    result = realism(scene, poses, metric, features=True)
    spread = agent_spread(poses[:, scene.agents.evaluated[scene.agents.present]]).mean().item()
    return result.as_dict() | class_rates(result.features, metric) | {"spread": spread}


def crude(scenes: SceneSource, rung: Rung, num_rollouts: int, seed: int) -> Rolls:
    """Rollouts of every scene by a rung that needs no model."""
    for index in range(len(scenes)):
        yield index, rung(scenes[index], num_rollouts, make_generator(seed, "ladder", index))


def rungs(cfg: DictConfig, scenes: SceneStore) -> Iterator[tuple[str, dict[str, Any], Rolls]]:
    """Name, what decides it, and rollouts of each rung, from the best to expect to the worst."""
    count, seed = cfg.num_rollouts, cfg.seed
    sumo = Simulator(scenes, count, seed) if cfg.simulator else None
    config = policy_config(cfg.model)
    seed_everything(seed)
    untrained = fresh_policy(cfg.model)
    decoding = {"decoding": plain(cfg.decoding)}
    models = {"untrained model": (untrained, episode_options(cfg.model), config)}
    for name, path in (policies_of(cfg) if cfg.policies else {}).items():
        models[name] = open_policy(path, cfg.device)
    made = {
        "log": logged,
        "log through tokens": tokenized_log(untrained.tokenizer),
        "noisy log": noisy_log,
        "constant velocity": constant_velocity,
    }
    if untrained.tokenizer.vocab_size:
        made["random tokens"] = random_tokens(untrained.tokenizer)
    for name, rung in made.items():
        yield name, {"tokenizer": config["tokenizer"]}, crude(scenes, rung, count, seed)
    for name, keeps in SIMULATOR.items() if sumo is not None else ():
        yield name, {}, sumo.goes_on(keeps)
        told = {"tokenizer": config["tokenizer"]}
        yield f"{name}, through tokens", told, sumo.goes_on(keeps, untrained.tokenizer)
    for name, (model, episode, config) in models.items():
        yield name, decoding | {"policy": weights_digest(model), **config}, driven(scenes, model, episode, cfg)


def climb(cfg: DictConfig, scenes: SceneStore) -> dict[str, dict]:
    """Score every rung, or read it back; ``{rung: {year: {figure: one value per scene}}}``.

    Raises:
        ValueError: no metric is named, or a rung was scored with other options.
    """
    if not cfg.years:
        raise ValueError('years is empty: there is no metric to score by; say years=["2024"].')
    metrics = {year: RealismConfig.load(year) for year in years_of(cfg)}
    common = {
        "scenes": fingerprint(scenes),
        "num_rollouts": cfg.num_rollouts,
        "seed": cfg.seed,
        "years": {year: metric.describe() for year, metric in metrics.items()},
        "figures": list(FIGURES),
    }
    ladder = {}
    for name, own, rollouts in rungs(cfg, scenes):
        score = partial(score_rung, scenes, rollouts, metrics, name)
        ladder[name] = read_or_score(cfg.output, name, common | own, "scores", score)
    return ladder


def years_of(cfg: DictConfig) -> list[str]:
    """Metrics to score by, as the keys of JSON are: 2024 is a number in YAML."""
    return [str(year) for year in cfg.years]


def table(ladder: dict[str, dict], years: list[str]) -> StudyTable:
    """Realism of each rung by every metric, and what the last one says besides, over the scenes that all rungs score.

    Raises:
        ValueError: there is none.
    """
    last = years[-1]
    realisms = {name: np.array([scores[year]["realism"] for year in years], float) for name, scores in ladder.items()}
    known = ~np.isnan(np.array(list(realisms.values()))).any((0, 1))
    if not known.any():
        raise ValueError("no scene has realism under every rung; choose scenes with vehicles.")
    rows = {
        name: [
            *(summary(row[None, known]) for row in realisms[name]),
            *(mean_known(list(compress(scores[last][key], known))) for key in BESIDES),
        ]
        for name, scores in ladder.items()
    }
    columns = ["rung", *(f"realism {year}" for year in years), *BESIDES.values()]
    left_out = f", {(~known).sum()} left out, which have no realism" if not known.all() else ""
    return StudyTable("rungs", f"{known.sum()} scenes{left_out}", columns, rows, signed=False)


@hydra.main(**CONFIG, config_name="ladder")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.ladder``."""
    if cfg.policies:
        given_policies(cfg)
    scenes = open_splits(cfg.scenes)[cfg.split]
    ladder, years = climb(cfg, scenes), years_of(cfg)
    tell(cfg, [table(ladder, years)], {})
    if cfg.json is not None:
        write_json(cfg.json, {"scenes": len(scenes), "years": years, "rungs": ladder})


if __name__ == "__main__":
    main()
