"""The main job: from scenes to the comparison of six methods (METHOD section 6), for several seeds.

    python -m recipes.compare scenes=gpudrive scenes.train=DIR scenes.eval=DIR
    make demo                                         # the same on SUMO scenes, in minutes

For every seed: pre-train a reference, collect and rank its rollouts, align it with each method, choose each one's
decoding on the tuning scenes, and evaluate once. Run the same command again to go on after a kill.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from dpa.preferences import PreferenceStore
from dpa.report.table import print_table
from recipes.align import align
from recipes.candidates import make_candidates, pair_accuracy
from recipes.cli import CONFIG, check_steps, finished, plain, recipe, write_json
from recipes.collect import collect
from recipes.evaluate import evaluate
from recipes.models import open_policy, policy_config, weights_digest
from recipes.pool import Job, Workers
from recipes.pretrain import pretrain
from recipes.scenes import open_splits
from recipes.summary import REFERENCE, summarise_comparison, write_report


def pretrain_job(cfg: DictConfig, seed: int) -> None:
    """Reference of one seed."""
    pretrain(cfg, open_splits(cfg.scenes), seed, run_folder(cfg, seed, REFERENCE))


def collect_job(cfg: DictConfig, seed: int, split: str) -> None:
    """Ranked rollouts of one seed's reference on the training scenes, or on the evaluation scenes for pair accuracy."""
    scenes = open_splits(cfg.scenes)[split]
    collect(cfg, scenes, policy_of(cfg, seed, REFERENCE), seed, preferences_of(cfg, seed, split))


def align_job(cfg: DictConfig, seed: int, method: str) -> None:
    """One aligned policy."""
    align(
        cfg,
        cfg.methods[method],
        open_splits(cfg.scenes).train,
        policy_of(cfg, seed, REFERENCE),
        preferences_of(cfg, seed, "train"),
        seed,
        run_folder(cfg, seed, method),
    )


def evaluate_job(cfg: DictConfig, seed: int, method: str, split: str, top_p: float) -> None:
    """One policy at one top-p, on the tuning or the evaluation scenes."""
    if split == "tune":
        cfg = OmegaConf.merge(cfg, {"evaluation": {"num_rollouts": cfg.decoding.num_rollouts}})
    scenes = open_splits(cfg.scenes)[split]
    evaluate(cfg, scenes, policy_of(cfg, seed, method), top_p, seed, result_of(cfg, seed, method, split, top_p))


def accuracy_job(cfg: DictConfig, seed: int, method: str) -> None:
    """Pair accuracy of one policy on the reference's ranked rollouts of the evaluation scenes (METHOD table 3)."""
    path = run_folder(cfg, seed, method) / "pair_accuracy.json"
    model, context, _ = open_policy(policy_of(cfg, seed, method), cfg.device)
    data = cfg.methods.dpa_omf.data
    decided_by = {"policy": weights_digest(model), "data": plain(data), "seed": seed}
    if finished(path, decided_by) is None:
        scenes = open_splits(cfg.scenes).eval
        store = PreferenceStore(preferences_of(cfg, seed, "eval"))
        pairs = make_candidates(data, store, scenes, context, model.tokenizer, seed)
        write_json(path, {"options": decided_by, "pair_accuracy": pair_accuracy(model, pairs, cfg.device)})


def run_folder(cfg: DictConfig, seed: int, method: str) -> Path:
    """Folder of one training run."""
    return Path(cfg.output) / f"seed_{seed}" / method


def policy_of(cfg: DictConfig, seed: int, method: str) -> Path:
    """Its policy."""
    return run_folder(cfg, seed, method) / "policy.pt"


def preferences_of(cfg: DictConfig, seed: int, split: str) -> Path:
    """Ranked rollouts of a seed's reference."""
    return Path(cfg.output) / f"seed_{seed}" / f"preferences_{split}"


def result_of(cfg: DictConfig, seed: int, method: str, split: str, top_p: float) -> Path:
    """Figures of one policy at one top-p."""
    return run_folder(cfg, seed, method) / f"{split}_top_p_{top_p:g}.json"


def choose_top_p(cfg: DictConfig, method: str) -> float:
    """The top-p of the grid with the highest mean realism over seeds on the tuning scenes."""

    def realism(top_p: float) -> float:
        return sum(
            finished_figures(result_of(cfg, seed, method, "tune", top_p))["mean"]["realism"] for seed in cfg.seeds
        )

    return max(cfg.decoding.grid, key=realism)


def finished_figures(path: Path) -> dict[str, Any]:
    """A result that a job of this run has written."""
    return json.loads(path.read_text(encoding="utf-8"))


class Stages:
    """Runs the stages one after the other and keeps how long each took, over all calls until it was complete."""

    def __init__(self, cfg: DictConfig, workers: Workers) -> None:
        self.cfg, self.workers, self.path = cfg, workers, Path(cfg.output) / "stages.json"
        self.kept: dict[str, dict[str, Any]] = finished_figures(self.path) if self.path.is_file() else {}

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of each stage."""
        return {name: entry["seconds"] for name, entry in self.kept.items()}

    def run(self, name: str, job: Callable[..., None], arguments: list[tuple]) -> None:
        """Run one job for each tuple of arguments; reading a complete stage back costs nothing in the account."""
        entry = self.kept.setdefault(name, {"seconds": 0.0, "jobs": 0})
        start = time.perf_counter()
        jobs = [Job(job, (self.cfg, *each), " ".join(map(str, (name, *each)))) for each in arguments]
        complete, left = entry["jobs"] == len(jobs), len(jobs)
        try:
            self.workers.run(jobs, name)
            left = 0
        finally:
            if not complete:
                entry["seconds"] += time.perf_counter() - start
            entry["jobs"] = len(jobs) - left
            write_json(self.path, self.kept)


def compare(cfg: DictConfig) -> dict[str, Any]:
    """Run every stage that is not done yet and write the report; returns the content of ``comparison.json``."""
    for section in ("pretraining", "alignment"):  # a wrong option is told before hours of work
        check_steps(cfg[section], section)
    policy_config(cfg.model)
    splits = open_splits(cfg.scenes)
    with Workers(cfg.workers, cfg.threads) as workers:
        stages = Stages(cfg, workers)
        best = run_stages(cfg, stages)
    comparison = summarise_comparison(cfg, splits, best, stages.seconds, lambda *run: result_of(cfg, *run))
    write_report(cfg, splits, comparison)
    return comparison


def run_stages(cfg: DictConfig, stages: Stages) -> dict[str, float]:
    """From pre-training to the figures of every policy; returns each method's own best top-p."""
    seeds, methods, grid = list(cfg.seeds), [REFERENCE, *cfg.methods], list(cfg.decoding.grid)
    stages.run("pretrain", pretrain_job, [(seed,) for seed in seeds])
    stages.run("collect", collect_job, [(seed, split) for seed in seeds for split in ("train", "eval")])
    stages.run("align", align_job, [(seed, method) for seed in seeds for method in cfg.methods])
    every = [(seed, method) for method in methods for seed in seeds]
    best = dict.fromkeys(methods, grid[0])
    if len(grid) > 1:  # otherwise there is nothing to choose
        stages.run("tune decoding", evaluate_job, [(*run, "tune", top_p) for run in every for top_p in grid])
        best = {method: choose_top_p(cfg, method) for method in methods}
    wanted = {(*run, "eval", top_p) for run in every for top_p in (cfg.decoding.common, best[run[1]])}
    wanted |= {(seed, REFERENCE, "eval", top_p) for seed in seeds for top_p in grid}
    stages.run("evaluate", evaluate_job, sorted(wanted))
    stages.run("pair accuracy", accuracy_job, every)
    return best


@hydra.main(**CONFIG, config_name="compare")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.compare``."""
    comparison = compare(cfg)
    print_table(comparison["rows"], comparison["paired"], title="At the common top-p")
    own = comparison["own_best"]
    print_table(own["rows"], own["paired"], title="Each at its own best top-p, chosen on the tuning scenes")
    print(f"report: {Path(cfg.output) / 'index.html'}")


if __name__ == "__main__":
    sys.exit(main())
