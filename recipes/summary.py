"""From the results of all runs to ``comparison.json``, figures and the page."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from dpa.policy import Decoding
from dpa.report.figures import plot_comparison, plot_curves, plot_scenes, read_curves
from dpa.report.page import Picture, write_page
from dpa.report.statistics import compare_methods
from dpa.report.table import REFERENCE
from recipes.cli import plain, write_json
from recipes.play import roll_out
from recipes.scenes import Splits

FIGURES = (
    "kinematic",
    "interactive",
    "map_based",
    "realism",
    "min_ade",
    "collision_rate",
    "offroad_rate",
    "preference_distance",
    "standing_moved",
)
CURVES = (
    "train/nll_preferred",
    "train/nll_unpreferred",
    "train/pair_accuracy",
    "train/logit_std",
    "train/kl",
    "train/entropy",
)
"""Scalars that are drawn (METHOD figures 4 and 6)."""
PACKAGES = ("torch", "torchrl", "tensordict", "pot", "numpy", "dpa-omf")


def summarise_comparison(
    cfg: DictConfig,
    splits: Splits,
    best: dict[str, float],
    stages: dict[str, float],
    result_of: Callable[[int, str, str, float], Path],
) -> dict[str, Any]:
    """The content of ``comparison.json``.

    ``rows`` and ``paired`` compare at the common top-p, and show the reference at the others of the grid beside them:
    sharper sampling alone can pass for alignment. ``own_best`` compares every method at its own best top-p with the
    reference at its own.
    """
    common, methods = cfg.decoding.common, [REFERENCE, *cfg.methods]
    others = [(REFERENCE, top_p) for top_p in cfg.decoding.grid if top_p != common]
    at_common, at_best = [(m, common) for m in methods], [(m, best[m]) for m in methods]
    results = {
        (method, top_p, seed): json.loads(result_of(seed, method, "eval", top_p).read_text(encoding="utf-8"))
        for method, top_p in {*at_common, *others, *at_best}
        for seed in cfg.seeds
    }

    def rows(runs: list[tuple[str, float]]) -> list[dict[str, Any]]:
        return [
            {
                "method": method,
                "seed": seed,
                "top_p": top_p,
                **{name: results[method, top_p, seed]["mean"][name] for name in FIGURES},
                "pair_accuracy": _pair_accuracy(result_of(seed, method, "eval", top_p).parent),
                "n_scenes": len(results[method, top_p, seed]["scenes"]),
            }
            for method, top_p in runs
            for seed in cfg.seeds
        ]

    def paired(runs: list[tuple[str, float]], reference: tuple[str, float]) -> list[dict[str, Any]]:
        scores = {
            run: {str(seed): results[*run, seed]["per_scene"]["realism"] for seed in cfg.seeds}
            for run in (reference, *runs)
        }
        found = compare_methods(
            {f"{m} {p}": score for (m, p), score in scores.items()}, f"{reference[0]} {reference[1]}"
        )
        return [
            {**entry, "method": method, "top_p": top_p, "against": reference[1]}
            for (method, top_p), entry in zip(runs, found, strict=True)
        ]

    return {
        "metric": cfg.evaluation.metric,
        "scenes": {**splits.sizes(), "source": cfg.scenes.source},
        "seeds": list(cfg.seeds),
        "rows": rows(at_common + others),
        "paired": paired(at_common[1:] + others, at_common[0]),
        "own_best": {"rows": rows(at_best), "paired": paired(at_best[1:], at_best[0])},
        "per_scene": {
            method: {str(seed): results[method, common, seed]["per_scene"]["realism"] for seed in cfg.seeds}
            for method in methods
        },
        "stages": stages,
        "wall_seconds": sum(stages.values()),
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in PACKAGES}},
        "command": " ".join(["python -m recipes.compare", *sys.argv[1:]]),
    }


def write_report(cfg: DictConfig, splits: Splits, comparison: dict[str, Any]) -> None:
    """``comparison.json``, its figures and ``index.html`` in the output folder."""
    folder = Path(cfg.output)
    write_json(folder / "comparison.json", comparison)
    if cfg.json is not None:
        write_json(cfg.json, comparison)
    plot_comparison(comparison, folder / "comparison.png")
    plot_comparison(comparison["own_best"], folder / "own_best.png")
    seed = cfg.seeds[0]
    runs = {method: read_curves(folder / f"seed_{seed}" / method) for method in cfg.methods}
    plot_curves({m: {k: v for k, v in run.items() if k in CURVES} for m, run in runs.items()}, folder / "curves.png")
    reference = read_curves(folder / f"seed_{seed}" / REFERENCE)
    plot_curves(
        {REFERENCE: {k: v for k, v in reference.items() if k.startswith(("train/loss", "tune/"))}},
        folder / "pretraining.png",
    )
    players = roll_out(
        {name: folder / f"seed_{seed}" / name / "policy.pt" for name in (REFERENCE, *cfg.methods)},
        splits.eval,
        range(min(cfg.pictures, len(splits.eval))),
        decoding=Decoding(cfg.decoding.common, cfg.evaluation.temperature),
        seed=seed,
        device=cfg.device,
    )
    plot_scenes(
        [player.scene for player in players],
        {method: [player.rollouts[method] for player in players] for method in players[0].rollouts},
        folder / "scenes.png",
    )
    write_page(
        folder,
        comparison,
        [
            Picture(folder / "comparison.png", "Differences to the reference. Paired per scene, with 95 % intervals."),
            Picture(folder / "own_best.png", "Each method at its own best top-p. Chosen on the tuning scenes."),
            Picture(
                folder / "curves.png", f"Alignment of seed {seed}. Likelihood of preferred and unpreferred rollouts."
            ),
            Picture(
                folder / "pretraining.png", f"Pre-training of seed {seed}. Next-token loss on train and tuning scenes."
            ),
            Picture(folder / "scenes.png", "Log and rollouts. Evaluation scenes, the same ones for every method."),
        ],
        players,
        config=plain(cfg),
        method="dpa_omf" if "dpa_omf" in cfg.methods else None,
    )


def _pair_accuracy(folder: Path) -> float:
    return json.loads((folder / "pair_accuracy.json").read_text(encoding="utf-8"))["pair_accuracy"]
