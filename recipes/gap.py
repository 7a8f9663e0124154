"""What lies between a policy and the log: its tokens, its own errors, errors that add up, or the other agents.

python -m recipes.gap policies=[zoo:motionlm-nano-sumo]

One agent of each scene, the self-driving car, is looked at in the same place four times: it follows the log by tokens;
it takes single decisions from the log, each from where the log is; it drives alone while the log replays all others;
and it drives among agents of the same policy. What grows from one row to the next is the share of each cause, but for
one thing: replayed agents show the policy where they are, and no tokens, which it has hardly seen in training. Only
agents whose log goes on to the end are looked at, so that nobody runs into one that is no longer there.

Of several policies each is also told minus the first, scene by scene. Run the same command again to go on after a
kill, with the next scene.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from torch import Tensor

from dpa.models import Decoding, MotionModel, collate_contexts, make_context
from dpa.realism import RealismConfig
from dpa.realism.features import measure
from dpa.realism.tracks import compare
from dpa.rollout import lifted
from envs.episode import EpisodeOptions
from envs.files import write_json
from envs.geometry.frames import to_world
from envs.options import differences
from envs.scene import STEP_SECONDS, Scene, SceneSource, select_agents
from envs.seeding import make_generator
from envs.store import SceneStore
from recipes.common.cli import CONFIG, build, plain, study_recipe
from recipes.common.models import given_policies, open_policy, weights_digest
from recipes.common.rolled import Rolled, driven, logs, waiting
from recipes.common.scenes import open_splits
from recipes.studies.rows import Roll, measure_rows
from recipes.studies.tables import StudyTable, compared, tell

PLACES = ("single decisions", "alone", "among its own")
"""Where a policy is looked at."""
SECONDS = (2.0, 8.0)
"""When it is looked at what has happened so far."""


def single_decisions(
    scenes: SceneSource,
    model: MotionModel,
    options: EpisodeOptions,
    decoding: Decoding,
    cfg: DictConfig,
    done: Collection[int] = (),
) -> Iterator[Rolled]:
    """Every decision of the self-driving car taken from where the log, through its tokens, has brought it."""
    options, tokenizer = replace(options, control="sdc"), model.tokenizer.on_cpu()
    for index, scene in waiting(scenes, done):
        context = make_context(scene, model.featurize, options)
        episode = context.episode
        tracks = tokenizer.encode_tracks(episode.logged, episode.logged_valid, episode.recent, episode.kind)
        with torch.no_grad():
            batch = collate_contexts([context]).to(cfg.device)
            seen = (each.to(cfg.device) for each in (tracks.tokens[None, None], tracks.valid[None, None]))
            logits = model(batch, *seen).float()[0, 0].cpu()  # [A, T, P]
        shape, draw = (cfg.num_rollouts, *logits.shape[:-1]), make_generator(cfg.seed, "gap", scene.scene_id)
        uniform = torch.rand(*shape, model.distribution.numbers, generator=draw)
        tokens, _ = model.distribution.draw(logits.expand(*shape, -1), uniform, decoding)
        before = torch.cat((episode.recent, tracks.poses), 1).unfold(1, tokenizer.steps + 1, tokenizer.steps)
        before = before.movedim(-1, -2)[:, : shape[2]].expand(*shape, -1, -1)
        kind = episode.kind[:, None].expand(shape)
        moved = to_world(tokenizer.decode(tokens, before, kind), before[..., -1:, :]).flatten(2, 3)
        yield Rolled.of(
            index, scene, lifted(scene, torch.where(episode.controlled[:, None, None], moved, episode.logged))
        )


def rows(cfg: DictConfig, files: Mapping[str, Path], scenes: SceneStore) -> Iterator[tuple[str, dict[str, Any], Roll]]:
    """Name of each row, what decides it, and its rollouts.

    Raises:
        ValueError: policies with different tokens, which would need a log each.
    """
    decoding, told = build(Decoding, cfg.decoding, "decoding"), {"decoding": plain(cfg.decoding)}
    policies = {name: open_policy(path, cfg.device) for name, path in files.items()}
    model, options, first = next(iter(policies.values()))
    for name, (_, _, config) in policies.items():
        if differ := differences(config["tokenizer"], first["tokenizer"]):
            raise ValueError(f"{name} has other tokens than the first policy ({differ}); ask for it alone.")
    tokenizer, several = model.tokenizer.on_cpu(), len(policies) > 1
    yield "log", {}, partial(logs, scenes, options, None)
    yield "log through tokens", {"tokenizer": first["tokenizer"]}, partial(logs, scenes, options, tokenizer)
    for name, (model, options, config) in policies.items():
        own = told | {"policy": weights_digest(model), **config}
        rolls = (
            partial(single_decisions, scenes, model, options, decoding, cfg),
            partial(driven, scenes, model, replace(options, control="sdc"), cfg),
            partial(driven, scenes, model, replace(options, control="all"), cfg),
        )
        for row, roll in zip(PLACES, rolls, strict=True):
            yield f"{name}: {row}" if several else row, own, roll


def look(each: Rolled, metric: RealismConfig) -> dict[str, float | None]:
    """What becomes of the self-driving car by each of :data:`SECONDS`; shares and means over rollouts.

    Args:
        each: scene and rollouts.
        metric: whose measurements these are.

    Returns:
        ``collision``, ``off-road`` and ``away`` (from the log [m]), each by some seconds; None where its log has ended.

    Raises:
        ValueError: the scene has no self-driving car.
    """
    scene, trajectories = _to_the_end(each.scene, each.trajectories)
    comparison = compare(scene, trajectories, metric)
    measured, agents = measure([comparison], metric)[0], scene.agents
    row = torch.isin(measured.track_id, agents.track_id[agents.sdc]).nonzero()
    if len(row) != 1:
        raise ValueError(f"scene {scene.scene_id} has no self-driving car; leave it out.")
    row, there = int(row), measured.scored[int(row)]
    logged = comparison.scene.agents.position[row, -len(there) :, :2]
    away = (comparison.simulated[:, row, :, :2] - logged).norm(dim=-1).mean(0)
    happened = {
        name: measured.values[event][1:, row].float().cummax(-1).values.mean(0)
        for name, event in (("collision", "collision_per_step"), ("off-road", "offroad_per_step"))
    }
    found = happened | {"away [m]": away}
    return {
        f"{name} {seconds:g} s": found[name][_last(seconds)].item() if there[_last(seconds)] else None
        for name in found
        for seconds in SECONDS
    }


def _to_the_end(scene: Scene, trajectories: Tensor) -> tuple[Scene, Tensor]:
    """The scene and its rollouts with the self-driving car, and of the others those whose log goes on to the end."""
    agents = scene.agents
    stays = agents.sdc | agents.valid[:, -1]
    return select_agents(scene, agents.present & stays), trajectories[:, stays[agents.present]]


def _last(seconds: float) -> int:
    return round(seconds / STEP_SECONDS) - 1


def tables(
    gap: Mapping[str, Mapping[str, Sequence[float | None]]], names: Sequence[str], num_scenes: int
) -> Iterator[StudyTable]:
    """Every row with intervals over scenes, and each further policy minus the first, scene by scene.

    Args:
        gap: a value for each scene by row and figure; a figure counts the scenes in which the log is still there.
        names: of the policies.
        num_scenes: of all.
    """
    first, *others = names
    columns = ["driven by", *next(iter(gap.values()))]
    pairs = {f"{name}: {place}": f"{first}: {place}" for name in others for place in PLACES}
    yield from compared("gap", f"the self-driving car in {num_scenes} scenes", columns, gap, pairs, first)


@hydra.main(**CONFIG, config_name="gap")
@study_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.gap``."""
    policies = given_policies(cfg)
    scenes = open_splits(cfg.scenes)[cfg.split]
    metric = RealismConfig.load(str(cfg.metric))
    common = {"num_rollouts": cfg.num_rollouts, "seed": cfg.seed, "metric": metric.describe()}
    gap = measure_rows(cfg.output, common, scenes, rows(cfg, policies, scenes), partial(look, metric=metric))
    tell(cfg, list(tables(gap, list(policies), len(scenes))), {})
    if cfg.json is not None:
        write_json(cfg.json, {"scenes": len(scenes), "rows": gap})


if __name__ == "__main__":
    main()
