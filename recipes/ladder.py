"""A ladder for sanity: what the realism metric gives to the log itself, to crude rollouts, and to models.

python -m recipes.ladder scenes=gpudrive scenes.train=DIR scenes.eval=DIR policies=[runs/pretrain/policy.pt]

A metric that is worth trusting puts the rungs in their order. Run the same command again to go on after a kill: rungs
that are there are read back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from dpa.realism import RealismConfig, realism
from dpa.report.statistics import summary
from dpa.rollout import lifted
from dpa.tokens import MotionTokenizer
from dpa.training.seeding import seed_everything
from envs.files import write_json
from envs.progress import progress
from envs.scene import CURRENT_STEP, STEP_SECONDS, Scene, SceneSource
from envs.seeding import make_generator
from recipes.common.cli import CONFIG, finite, plain, recipe
from recipes.common.models import build_policy, episode_options, open_policy, policies_of, policy_config, weights_digest
from recipes.common.rolled import driven
from recipes.common.scenes import fingerprint, open_splits
from recipes.studies.rows import read_or_score
from recipes.studies.tables import StudyTable, tell

Rung = Callable[[Scene, int, torch.Generator], Tensor]
"""Scene, number of rollouts and generator -> ``[R, A, 80, 4]``."""
BESIDES = {"min_ade": "minADE [m]", "collision_rate": "collision", "offroad_rate": "off-road"}
"""What is told beside realism."""
NOISE_XY, NOISE_HEADING = 0.1, 0.01
"""Standard deviation of a noisy log's drift in one step [m], [rad]; it adds up to 0.9 m and 5 degrees at the end."""


def logged(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
    """The log in every rollout; where it has no step, the agent stays where it was last."""
    return _log(scene).expand(num_rollouts, -1, -1, -1)


def noisy_log(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
    """The log with a drift of its own in every rollout."""
    log = _log(scene)
    noise = torch.randn(num_rollouts, *log.shape, generator=generator).cumsum(2)
    return log + noise * torch.tensor([NOISE_XY, NOISE_XY, 0.0, NOISE_HEADING])


def constant_velocity(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
    """Every agent goes straight on at its speed of the current step, in every rollout."""
    agents, log = scene.agents, _log(scene)
    time = STEP_SECONDS * torch.arange(1, log.shape[1] + 1)
    now = agents.present
    xy = agents.position[now, CURRENT_STEP, None, :2] + agents.velocity[now, CURRENT_STEP, None] * time[:, None]
    heading = agents.heading[now, CURRENT_STEP, None, None].expand(-1, log.shape[1], 1)
    poses = torch.cat((xy, heading), -1)
    return lifted(scene, poses[None]).expand(num_rollouts, -1, -1, -1)


def random_tokens(tokenizer: MotionTokenizer) -> Rung:
    """Every token as likely as any other, at every decision."""

    def roll(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
        recent, kind = _seen(scene, tokenizer.steps)
        steps = _log(scene).shape[1] // tokenizer.steps
        tokens = torch.randint(tokenizer.vocab_size, (num_rollouts, len(kind), steps), generator=generator)
        return lifted(scene, tokenizer.decode_tracks(tokens, recent.expand(num_rollouts, -1, -1, -1), kind))

    return roll


def tokenized_log(tokenizer: MotionTokenizer) -> Rung:
    """The log through tokens and back, in every rollout: the best that any model of these tokens could do alike."""

    def roll(scene: Scene, num_rollouts: int, generator: torch.Generator) -> Tensor:
        recent, kind = _seen(scene, tokenizer.steps)
        poses = _log(scene)[..., [0, 1, 3]]
        tracks = tokenizer.encode_tracks(poses, torch.ones(poses.shape[:2], dtype=torch.bool), recent, kind)
        return lifted(scene, tracks.poses[None]).expand(num_rollouts, -1, -1, -1)

    return roll


def _seen(scene: Scene, steps: int) -> tuple[Tensor, Tensor]:
    """What a policy sees of the present agents: ``[A, F + 1, 3]`` before the first decision, and their kinds."""
    present = scene.agents.present
    return scene.agents.recent(steps)[present], scene.agents.kind[present]


def _log(scene: Scene) -> Tensor:
    """``[A, 80, 4]`` of the present agents; a step that the log lacks has the pose of the last one that it has."""
    agents = scene.agents
    poses = torch.cat((agents.position, agents.heading[..., None]), -1)[agents.present, CURRENT_STEP:]
    steps = torch.arange(poses.shape[1])
    last = torch.where(agents.valid[agents.present, CURRENT_STEP:], steps, 0).cummax(1).values
    return poses.gather(1, last[..., None].expand_as(poses))[:, 1:]


def score_rung(scenes: SceneSource, rollouts: Iterator[tuple[int, Tensor]], years: list[str], name: str) -> dict:
    """``{year: {figure: one value per scene}}`` of one rung; None where a scene has none."""
    found: dict[int, dict[str, dict[str, float]]] = {}
    with progress(total=len(scenes), description=name, unit="scene") as bar:
        for index, poses in rollouts:
            found[index] = {year: realism(scenes[index], poses, year).as_dict() for year in years}
            bar.update()
    figures = ("realism", "kinematic", "interactive", "map_based", *BESIDES)
    return {year: {key: [finite(found[i][year][key]) for i in sorted(found)] for key in figures} for year in years}


def crude(scenes: SceneSource, rung: Rung, num_rollouts: int, seed: int) -> Iterator[tuple[int, Tensor]]:
    """Rollouts of every scene by a rung that needs no model."""
    for index in range(len(scenes)):
        yield index, rung(scenes[index], num_rollouts, make_generator(seed, "ladder", index))


def rungs(cfg: DictConfig, scenes: SceneSource) -> Iterator[tuple[str, dict[str, Any], Iterator[tuple[int, Tensor]]]]:
    """Name, what decides it, and rollouts of each rung, from the best to expect to the worst."""
    count, seed = cfg.num_rollouts, cfg.seed
    config = policy_config(cfg.model)
    seed_everything(seed)
    untrained = build_policy(config)
    decoding = {"decoding": plain(cfg.decoding)}
    models = {"untrained model": (untrained, episode_options(cfg.model), config)}
    for name, path in (policies_of(cfg) if cfg.policies else {}).items():
        models[name] = open_policy(path, cfg.device)
    made = {
        "log": logged,
        "log through tokens": tokenized_log(untrained.tokenizer),
        "noisy log": noisy_log,
        "constant velocity": constant_velocity,
        "random tokens": random_tokens(untrained.tokenizer),
    }
    for name, rung in made.items():
        yield name, {"tokenizer": plain(cfg.model.tokenizer)}, crude(scenes, rung, count, seed)
    for name, (model, context, config) in models.items():
        yield name, decoding | {"policy": weights_digest(model), **config}, driven(scenes, model, context, cfg)


def climb(cfg: DictConfig, scenes: SceneSource) -> dict[str, dict]:
    """Score every rung, or read it back; ``{rung: {year: {figure: one value per scene}}}``.

    Raises:
        ValueError: no metric is named, or a rung was scored with other options.
    """
    if not cfg.years:
        raise ValueError('years is empty: there is no metric to score by; say years=["2024"].')
    metrics = {year: RealismConfig.load(year).describe() for year in years_of(cfg)}
    common = {"scenes": fingerprint(scenes), "num_rollouts": cfg.num_rollouts, "seed": cfg.seed, "years": metrics}
    ladder = {}
    for name, own, rollouts in rungs(cfg, scenes):
        score = partial(score_rung, scenes, rollouts, years_of(cfg), name)
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
    values = {
        name: np.array([scores[year]["realism"] for year in years] + [scores[last][key] for key in BESIDES], float)
        for name, scores in ladder.items()
    }
    known = ~np.isnan(np.array(list(values.values()))).any((0, 1))
    if not known.any():
        raise ValueError("no scene has realism under every rung; choose scenes with vehicles.")
    rows = {
        name: [*(summary(row[None, known]) for row in found[: len(years)]), *found[len(years) :, known].mean(-1)]
        for name, found in values.items()
    }
    columns = ["rung", *(f"realism {year}" for year in years), *BESIDES.values()]
    left_out = f", {(~known).sum()} left out, which have no realism" if not known.all() else ""
    return StudyTable("rungs", f"{known.sum()} scenes{left_out}", columns, rows, signed=False)


@hydra.main(**CONFIG, config_name="ladder")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.ladder``."""
    scenes = open_splits(cfg.scenes)[cfg.split]
    ladder, years = climb(cfg, scenes), years_of(cfg)
    tell(cfg, [table(ladder, years)], {})
    if cfg.json is not None:
        write_json(cfg.json, {"scenes": len(scenes), "years": years, "rungs": ladder})


if __name__ == "__main__":
    main()
