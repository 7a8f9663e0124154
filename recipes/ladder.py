"""A ladder for sanity: what the realism metric gives to the log itself, to crude rollouts, and to models.

python -m recipes.ladder scenes=gpudrive scenes.train=DIR scenes.eval=DIR policies=[runs/pretrain/policy.pt]

A metric that is worth trusting puts the rungs in their order. Run the same command again to go on after a kill,
with the next scene. Of scenes from SUMO, ``simulator=true`` adds what SUMO itself does when it goes on from the current
step: the log again, which says what is lost on the way, and what the logs were drawn from, by one who knows all drivers
and of their ways what can be seen.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from omegaconf import DictConfig

from dpa.realism import CLASS_RATES, RealismConfig, class_rates, realism
from dpa.report.statistics import summary
from dpa.training.seeding import seed_everything
from envs.files import write_json
from envs.sources.sumo.futures import Keeps
from envs.store import SceneStore
from recipes.common.cli import CONFIG, finite, mean_known, plain, study_recipe
from recipes.common.models import (
    episode_options,
    fresh_policy,
    given_policies,
    open_policy,
    policy_config,
    weights_digest,
)
from recipes.common.rolled import Rolled, driven, final_spread
from recipes.common.scenes import open_splits
from recipes.studies.rows import Roll, measure_rows
from recipes.studies.rungs import (
    Simulator,
    constant_velocity,
    crude,
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
    "SUMO, ways drawn anew": "drivers",
}
"""Rungs of SUMO itself, and what each keeps of the log."""
FIGURES = ("realism", "kinematic", "interactive", "map_based", *BESIDES)
"""What is kept of every scene."""


def measure_scene(each: Rolled, metrics: Mapping[str, RealismConfig]) -> dict[str, dict[str, float | None]]:
    """``{year: {figure: value}}``; None where a scene has none."""
    found, spread = {}, final_spread(each.scene, each.trajectories, each.controlled)
    for year, metric in metrics.items():
        result = realism(each.scene, each.trajectories, metric, features=True)
        figures = result.as_dict() | class_rates(result.features, metric) | {"spread": spread}
        found[year] = {name: finite(figures[name]) for name in FIGURES}
    return found


def rungs(
    cfg: DictConfig, policies: Mapping[str, Path], scenes: SceneStore
) -> Iterator[tuple[str, dict[str, Any], Roll]]:
    """Name, what decides it, and rollouts of each rung: the log, what is crude, the simulator, models."""
    count, seed = cfg.num_rollouts, cfg.seed
    sumo = Simulator(scenes, count, seed) if cfg.simulator else None
    config = policy_config(cfg.model)
    seed_everything(seed)
    untrained = fresh_policy(cfg.model)
    decoding = {"decoding": plain(cfg.decoding)}
    models = {"untrained model": (untrained, episode_options(cfg.model), config)}
    for name, path in policies.items():
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
        yield name, {"tokenizer": config["tokenizer"]}, partial(crude, scenes, rung, count, seed)
    for name, keeps in SIMULATOR.items() if sumo is not None else ():
        yield name, {}, partial(sumo.goes_on, keeps, None)
        told = {"tokenizer": config["tokenizer"]}
        yield f"{name}, through tokens", told, partial(sumo.goes_on, keeps, untrained.tokenizer)
    for name, (model, episode, config) in models.items():
        yield name, decoding | {"policy": weights_digest(model), **config}, partial(driven, scenes, model, episode, cfg)


def climb(cfg: DictConfig, policies: Mapping[str, Path], scenes: SceneStore) -> dict[str, dict]:
    """Measure every rung, or read it back; ``{rung: {year: {figure: one value per scene}}}``.

    Raises:
        ValueError: no metric is named, or a rung was measured with other options.
    """
    if not cfg.years:
        raise ValueError('years is empty: there is no metric to score by; say years=["2024"].')
    metrics = {year: RealismConfig.load(year) for year in years_of(cfg)}
    common = {
        "num_rollouts": cfg.num_rollouts,
        "seed": cfg.seed,
        "years": {year: metric.describe() for year, metric in metrics.items()},
        "figures": list(FIGURES),
    }
    return measure_rows(
        cfg.output, common, scenes, rungs(cfg, policies, scenes), partial(measure_scene, metrics=metrics)
    )


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
@study_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.ladder``."""
    policies = given_policies(cfg) if cfg.policies else {}
    scenes = open_splits(cfg.scenes)[cfg.split]
    ladder, years = climb(cfg, policies, scenes), years_of(cfg)
    tell(cfg, [table(ladder, years)], {})
    if cfg.json is not None:
        write_json(cfg.json, {"scenes": len(scenes), "years": years, "rungs": ladder})


if __name__ == "__main__":
    main()
