"""Measure what tokenization loses: the logs of scenes, tokenized and decoded again, against the logs.

python -m recipes.tokens scenes=gpudrive scenes.train=DIR scenes.eval=DIR json=runs/tokens.json
python -m recipes.tokens tokenizer@model.tokenizer=verlet_fine

Besides the errors of poses it tells the realism of the log and of the log through tokens, every rollout alike: what
tokens leave of the metric to any policy that uses them.
"""

from __future__ import annotations

from statistics import fmean
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from dpa.realism import RealismConfig, realism
from dpa.tokens import MotionTokenizer
from envs.episode import EpisodeOptions, make_episode
from envs.files import write_json
from envs.geometry.frames import wrap_angle
from envs.progress import progress
from envs.scene import STEP_SECONDS, AgentKind, SceneSource
from recipes.common.cli import CONFIG, recipe
from recipes.common.models import episode_options, fresh_policy, tokenizer_config
from recipes.common.scenes import open_splits
from recipes.studies.rungs import logged, tokenized_log

CLASSES = (AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST)
MOVING = 1.0
"""An agent that its log moves further than this in the episode [m]."""
BUCKETS = ("realism", "kinematic", "interactive", "map_based")
ROLLOUTS = 32
"""All alike."""


def reconstruction_errors(
    scenes: SceneSource, tokenizer: MotionTokenizer, options: EpisodeOptions
) -> dict[str, dict[str, float]]:
    """Errors of each class over all poses that tokens were encoded from.

    Returns:
        For each class, all agents and moving ones: number of ``poses``, mean and 99th percentile of the displacement
        ``position_mean`` and ``position_p99`` [m], ``heading_mean`` [degrees] and ``speed_mean`` [m/s].
    """
    found: dict[str, list[torch.Tensor]] = {}
    for index in progress(range(len(scenes)), "tokens", unit="scene"):
        episode = make_episode(scenes[index], options)
        tracks = tokenizer.encode_tracks(episode.logged, episode.logged_valid, episode.recent, episode.kind)
        valid = episode.logged_valid & tracks.valid.repeat_interleave(tokenizer.steps, -1)
        error = (tracks.poses - episode.logged)[..., :2].norm(dim=-1)
        heading = wrap_angle(tracks.poses[..., 2] - episode.logged[..., 2]).abs().rad2deg()
        speed = [p[..., :2].diff(dim=-2).norm(dim=-1) / STEP_SECONDS for p in (tracks.poses, episode.logged)]
        speed_error = torch.nn.functional.pad((speed[0] - speed[1]).abs(), (1, 0))
        both = torch.nn.functional.pad(valid[:, 1:] & valid[:, :-1], (1, 0))
        away = ((episode.logged - episode.recent[:, -1:])[..., :2].norm(dim=-1) * episode.logged_valid).amax(-1)
        for kind in CLASSES:
            for name, chosen in (("all", episode.kind == kind), ("moving", (episode.kind == kind) & (away > MOVING))):
                rows = valid[chosen]
                sums = found.setdefault(f"{kind.name.lower()} {name}", [])
                sums.append(
                    torch.stack(
                        (
                            error[chosen][rows],
                            heading[chosen][rows],
                            torch.where(both[chosen], speed_error[chosen], torch.nan)[rows],
                        )
                    )
                )
    return {name: _statistics(torch.cat(parts, -1)) for name, parts in found.items()}


def _statistics(values: torch.Tensor) -> dict[str, float]:
    if values.shape[-1] == 0:
        return {"poses": 0}
    position, heading, speed = values
    # torch.quantile refuses more than 2**24 values; a sort of one row is as good.
    return {
        "poses": len(position),
        "position_mean": position.mean().item(),
        "position_p99": position.sort().values[int(0.99 * (len(position) - 1))].item(),
        "heading_mean": heading.mean().item(),
        "speed_mean": speed.nanmean().item(),
    }


def realism_left(scenes: SceneSource, tokenizer: MotionTokenizer, metric: RealismConfig) -> dict[str, list[Any]]:
    """Realism and its buckets, scene by scene, of the log and of the log through tokens.

    Returns:
        ``log`` and ``tokens``, each the results of the scenes in order.
    """
    rungs, generator = {"log": logged, "tokens": tokenized_log(tokenizer)}, torch.Generator()
    found: dict[str, list[Any]] = {name: [] for name in rungs}
    for index in progress(range(len(scenes)), "realism", unit="scene"):
        scene = scenes[index]
        for name, rung in rungs.items():
            found[name].append(realism(scene, rung(scene, ROLLOUTS, generator), metric).as_dict())
    return found


def realism_table(found: dict[str, list[Any]]) -> tuple[dict[str, dict[str, float]], int]:
    """Means over the scenes that have realism, and how many these are.

    Raises:
        ValueError: none has.
    """
    known = [place for place, result in enumerate(found["log"]) if result["realism"] == result["realism"]]
    if not known:
        raise ValueError(f"none of the {len(found['log'])} scenes has realism by this metric; take others.")
    means = {
        name: {key: fmean(results[place][key] for place in known) for key in BUCKETS} for name, results in found.items()
    }
    return means, len(known)


@hydra.main(**CONFIG, config_name="tokens")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.tokens``."""
    model, scenes = fresh_policy(cfg.model), open_splits(cfg.scenes)[cfg.split]
    errors = reconstruction_errors(scenes, model.tokenizer, episode_options(cfg.model))
    table = Table("agents", "poses", "position mean [m]", "p99 [m]", "heading mean [deg]", "speed mean [m/s]")
    for name, row in errors.items():
        table.add_row(name, *(f"{value:.3f}" if isinstance(value, float) else str(value) for value in row.values()))
    Console(markup=False).print(table)
    left, num_scenes = realism_table(realism_left(scenes, model.tokenizer, RealismConfig.load(str(cfg.metric))))
    spoken = f"{model.tokenizer.vocab_size} tokens" if model.tokenizer.vocab_size else "patches"
    realistic = Table("", *BUCKETS, title=f"realism, {num_scenes} scenes, {spoken}")
    for name, row in left.items():
        realistic.add_row("log through tokens" if name == "tokens" else name, *(f"{row[key]:.3f}" for key in BUCKETS))
    Console(markup=False).print(realistic)
    if cfg.json is not None:
        write_json(
            cfg.json,
            {"tokenizer": tokenizer_config(cfg.model), "scenes": len(scenes), "errors": errors, "realism": left},
        )


if __name__ == "__main__":
    main()
