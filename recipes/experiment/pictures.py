"""Scenes and rollouts of an experiment's policies, to play on the page and as a picture (figures 5 and 9)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from omegaconf import DictConfig

from dpa.report.experiment import read_json
from dpa.report.likely import plot_likely
from dpa.report.player import pack_players
from envs.files import write_json
from envs.store import SceneStore
from recipes.common.cli import plain
from recipes.common.models import open_policy, weights_digest
from recipes.common.rankings import build_distance
from recipes.common.scenes import fingerprint
from recipes.experiment.jobs import runs_of
from recipes.experiment.runs import Run
from recipes.experiment.summary import labels
from recipes.play import roll_out


def write_players(cfg: DictConfig, scenes: SceneStore, chosen: Mapping[str, Run]) -> Path:
    """Roll the policies of the first seed out in some scenes, each at its own best decoding, and keep what is shown.

    Args:
        cfg: of the experiment; ``pictures`` names the number of scenes, rollouts and those kept.
        scenes: of the reported split; neighbours may be of one place, so those shown lie evenly among them.
        chosen: what stands for each method.

    Returns:
        The picture of the most likely rollouts.
    """
    runs, seed, options = runs_of(cfg), cfg.seeds[0], cfg.pictures
    files = {method: runs.policy(seed, run.policy) for method, run in chosen.items()}
    named = labels(cfg, chosen)
    distance = build_distance(cfg.collection.ranking, "collection.ranking")
    decided_by = {
        "policies": {method: weights_digest(open_policy(path)[0]) for method, path in files.items()},
        "decodings": {method: asdict(run.decoding) for method, run in chosen.items()},
        "scenes": fingerprint(scenes),
        "labels": named,
        "ranking": distance.describe(),
        "options": plain(options),
        "seed": seed,
    }
    if runs.likely.is_file() and runs.players.is_file() and read_json(runs.players).get("options") == decided_by:
        return runs.likely
    players = roll_out(
        {named[method]: path for method, path in files.items()},
        scenes,
        range(0, len(scenes), max(1, len(scenes) // options.scenes))[: options.scenes],
        decoding={named[method]: run.decoding for method, run in chosen.items()},
        num_rollouts=options.num_rollouts,
        kept=options.kept,
        distance=distance,
        seed=seed,
        device=cfg.device,
    )
    plot_likely(players, runs.likely)
    write_json(runs.players, pack_players(players) | {"options": decided_by})
    return runs.likely
