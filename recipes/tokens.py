"""Measure what tokenization loses: the logs of scenes, tokenized and decoded again, against the logs.

python -m recipes.tokens scenes=gpudrive scenes.train=DIR scenes.eval=DIR json=runs/tokens.json
python -m recipes.tokens model.tokenizer.interpolation=linear
"""

from __future__ import annotations

import hydra
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from dpa.tokens import MotionTokenizer
from envs.episode import EpisodeOptions, make_episode
from envs.files import write_json
from envs.geometry.frames import wrap_angle
from envs.progress import progress
from envs.scene import STEP_SECONDS, AgentKind, SceneSource
from recipes.common.cli import CONFIG, plain, recipe
from recipes.common.models import build_policy, episode_options, policy_config
from recipes.common.scenes import open_splits

CLASSES = (AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST)
MOVING = 1.0
"""An agent that its log moves further than this in the episode [m]."""


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


@hydra.main(**CONFIG, config_name="tokens")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.tokens``."""
    model, scenes = build_policy(policy_config(cfg.model)), open_splits(cfg.scenes)[cfg.split]
    errors = reconstruction_errors(scenes, model.tokenizer, episode_options(cfg.model))
    table = Table("agents", "poses", "position mean [m]", "p99 [m]", "heading mean [deg]", "speed mean [m/s]")
    for name, row in errors.items():
        table.add_row(name, *(f"{value:.3f}" if isinstance(value, float) else str(value) for value in row.values()))
    Console(markup=False).print(table)
    if cfg.json is not None:
        write_json(cfg.json, {"tokenizer": plain(cfg.model.tokenizer), "scenes": len(scenes), "errors": errors})


if __name__ == "__main__":
    main()
