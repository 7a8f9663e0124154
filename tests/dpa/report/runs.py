"""A small study with everything that a real one has. Its numbers are made up for tests."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from dpa.preferences.examples import example_groups, example_provenance
from dpa.preferences.writer import PreferenceWriter
from dpa.report.player import PlayerScene, pack_players
from dpa.report.statistics import paired_bootstrap
from envs.sources.synthetic import straight_road
from tests.dpa.report.made_rollouts import judged, slower

SEEDS = (0, 1, 2)
SCENES = 12
GRID = ((0.95, 1.0), (0.85, 1.0), (0.85, 0.9))
COMMON, BEST = GRID[0], GRID[1]
LABELS = {
    "reference": "reference", "dpa_omf": "DPA-OMF", "dpa_adef": "DPA-ADEF", "adversarial_afd": "adversarial AFD",
    "r1": "1 ranking", "r4": "4 rankings", "r16": "16 rankings",
}  # fmt: skip
GAIN = {
    "reference": 0.0,
    "dpa_omf": 0.02,
    "dpa_adef": 0.001,
    "adversarial_afd": -0.04,
    "r1": -0.01,
    "r4": 0.01,
    "r16": 0.02,
}
FIGURES = (
    "kinematic", "interactive", "map_based", "realism", "min_ade", "collision_rate", "offroad_rate", "wrong_way",
    "red_light", "close_pass", "harsh_jerk", "preference_distance", "standing_moved", "spread",
)  # fmt: skip
PUBLISHED = {"dpa_omf": {"kinematic": 0.415, "realism": 0.739, "min_ade": 1.413, "pair_accuracy": 0.84}}

STAGES = {
    "pretrain": {f"pretrain {seed}": 1800.0 for seed in range(3)},
    "align": {f"align {job}": 200.0 for job in range(9)},
}
"""Seconds of each job."""


def write_runs(folder: Path) -> Path:
    """Write the whole study: three experiments, stages, stores, curves, studies of rankings and a scene to play."""
    write_experiment(folder, "methods", ["reference", "dpa_omf", "dpa_adef", "adversarial_afd"], published=PUBLISHED)
    axis = {"name": "rankings per scene", "values": {"r1": 1.0, "r4": 4.0, "r16": 16.0}, "log": True}
    write_experiment(folder, "scaling", ["reference", "r1", "r4", "r16"], headline="r16", axis=axis)
    snapshots = ["reference", "dpa_omf@20", "dpa_omf@40", "dpa_omf"]
    write_experiment(folder, "steps", snapshots)
    write(folder / "stages.json", STAGES)
    for seed in SEEDS[:2]:
        with PreferenceWriter(folder / f"seed_{seed}" / "preferences_train", example_provenance()) as writer:
            writer.append(example_groups(num_scenes=3))
    write(folder / "validity" / "summary.json", validity())
    write(folder / "sensitivity" / "summary.json", sensitivity())
    write(folder / "discriminator" / "summary.json", discriminator())
    write(folder / "players.json", players())
    return folder


def write_experiment(
    folder: Path, name: str, methods: list[str], *, headline: str = "dpa_omf", axis: dict[str, Any] | None = None,
    published: dict[str, Any] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Write one experiment with the files behind its rows; returns its content."""
    chosen = dict.fromkeys(methods, BEST)
    others = [method for method in methods if method != "reference"]
    sharper = [("reference", decoding) for decoding in GRID if decoding != COMMON]
    content = {
        "name": name, "title": f"Made-up {name}", "paper": "table 1", "question": "Is <this> a test?", "metric": "2024",
        "scenes": {"train": 8, "tune": 4, "eval": SCENES, "source": "made & up <by hand>"}, "seeds": list(SEEDS),
        "methods": methods, "labels": {m.partition("@")[0]: LABELS[m.partition("@")[0]] for m in methods},
        "published": published or {}, "headline": headline, "common": list(COMMON),
        "chosen": {method: list(decoding) for method, decoding in chosen.items()},
        "rows": [row(folder, m, s, d) for m, d in [*((m, COMMON) for m in methods), *sharper] for s in SEEDS],
        "paired": [paired(m, d, COMMON) for m, d in [*((m, COMMON) for m in others), *sharper]],
        "own_best": {
            "rows": [row(folder, method, seed, BEST) for method in methods for seed in SEEDS],
            "paired": [paired(method, BEST, BEST) for method in others],
        },
        "tuning": [row(folder, m, s, d, split="tune") for m in methods for d in GRID for s in SEEDS],
        "likelihood": [likelihood(method, seed) for method in methods for seed in SEEDS],
        "axis": axis,
        "curves": {m: {str(seed): curves(folder, m, seed) for seed in SEEDS} for m in others if "@" not in m},
        "stages": {"pretrain": 5400.0, "align": 125.0}, "wall_seconds": 5525.0, "config": {"mark": "<!--{title}-->"},
        "versions": {"torch": "2.13.0"}, "machine": "Linux x86_64, 2 CPU cores", "date": "2026-11-21",
        "command": f"python -m recipes.compare experiment={name} 'name=<b>'",
    }  # fmt: skip
    write(folder / "experiments" / f"{name}.json", content)
    return content


def values(method: str, seed: int, decoding: tuple[float, float]) -> dict[str, list[float]]:
    """Figures of every scene; safety in the first scene is not known."""
    draw = np.random.default_rng([seed, *map(ord, method), round(100 * decoding[0]), round(100 * decoding[1])])
    base = method.partition("@")[0]
    gain = GAIN[base] * (float(method.partition("@")[2] or 60) / 60) + 0.05 * (0.95 - decoding[0])
    scene = np.linspace(-0.1, 0.1, SCENES)
    level = {
        "realism": 0.6 + gain, "kinematic": 0.4 + gain, "interactive": 0.7 + gain, "map_based": 0.8 + gain,
        "min_ade": 1.4 - gain, "spread": 2.0 * decoding[0] * decoding[1] - gain, "preference_distance": 5.0,
    }  # fmt: skip
    found = {}
    for figure in FIGURES:
        found[figure] = (level.get(figure, 0.2 - gain) + scene + draw.normal(0, 0.01, SCENES)).round(6).tolist()
    found["red_light"][0] = None
    return found


def row(folder: Path, method: str, seed: int, decoding: tuple[float, float], split: str = "eval") -> dict[str, Any]:
    """A row, and the evaluation behind it."""
    file = f"seed_{seed}/{method}/{split}_top_p_{decoding[0]:g}_t_{decoding[1]:g}.json"
    per_scene = values(method, seed, decoding)
    known = {figure: [value for value in scenes if value is not None] for figure, scenes in per_scene.items()}
    mean = {figure: math.fsum(scenes) / len(scenes) for figure, scenes in known.items()}
    write(
        folder / file, {"options": {}, "mean": mean, "likelihood": {}, "scenes": ["s"] * SCENES, "per_scene": per_scene}
    )
    identity = {"method": method, "seed": seed, "top_p": decoding[0], "temperature": decoding[1], "file": file}
    return identity | {"n_scenes": SCENES, "pair_accuracy": 0.6, **mean}


def paired(method: str, decoding: tuple[float, float], against: tuple[float, float]) -> dict[str, Any]:
    """Realism of a method minus that of the reference."""
    sides = [(method, decoding), ("reference", against)]
    mine, base = ([values(name, seed, at)["realism"] for seed in SEEDS] for name, at in sides)
    found = paired_bootstrap(mine, base, 500)
    return {
        "method": method, "top_p": decoding[0], "temperature": decoding[1], "against": "reference",
        "against_top_p": against[0], "against_temperature": against[1], "realism_difference": found.mean,
        "ci95": [found.low, found.high], "over": found.over, "n_seeds": found.num_seeds,
    }  # fmt: skip


def likelihood(method: str, seed: int) -> dict[str, Any]:
    """Likelihood of ranked rollouts."""
    learns = method.startswith("dpa_omf")
    return {
        "method": method, "seed": seed, "file": f"seed_{seed}/{method}/likelihood_eval.json",
        "pair_accuracy": 0.65 if learns else 0.51, "nll_demonstration": 4.0, "nll_preferred": 2.0 - 0.3 * learns,
        "nll_unpreferred": 2.1 + 0.4 * learns, "entropy": 1.9,
        "kl": 0.0 if method == "reference" else 0.3 * float(method.partition("@")[2] or 60) / 60,
    }  # fmt: skip


def curves(folder: Path, method: str, seed: int) -> str:
    """Scalars of a run; returns its folder relative to the study's."""
    run = f"seed_{seed}/{method}"
    tuned, trained = range(0, 61, 10), range(1, 61)
    scalars = {
        "tune/nll_preferred": [(step, 2.1 - 0.005 * step + 0.02 * seed) for step in tuned],
        "tune/nll_unpreferred": [(step, 2.1 + 0.005 * step + 0.02 * seed) for step in tuned],
        "tune/nll_demonstration": [(step, 4.0 + 0.01 * seed) for step in tuned],
        "train/logit_std": [(step, 0.01 * step) for step in trained],
        "train/saturated": [(step, 0.0) for step in trained],
        "train/kl": [(step, 0.005 * step) for step in trained],
        "train/entropy": [(step, 2 - 0.001 * step) for step in trained],
    }  # fmt: skip
    for name, points in scalars.items():
        path = folder / run / "scalars" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{step},{value}\n" for step, value in points), encoding="utf-8")
    return run


def value(mean: float, half: float = 0.05) -> dict[str, Any]:
    """An interval as the studies of rankings write it."""
    return {"mean": mean, "ci95": [mean - half, mean + half], "scenes": SCENES}


def validity() -> dict[str, Any]:
    """Two rankings in four windows."""
    places = (0.8, 0.95, 1.05, 1.2)
    rankings = {
        name: {
            "correlation": value(-slope), "near_half": value(-slope / 2), "nearest": value(slope / 20),
            "farthest": value(-slope / 20), "distance": [value(place) for place in places],
            "realism": [value(slope * (1 - place) / 10, 0.01) for place in places],
        }
        for name, slope in (("omf", 0.7), ("ade", 0.4))
    }  # fmt: skip
    return {
        "rankings": rankings,
        "minus": "ade",
        "differences": {"omf": {"nearest": value(0.02), "farthest": value(-0.02)}},
    }


def sensitivity() -> dict[str, Any]:
    """Two variants."""
    names = ("ade", "time-aligned")
    return {
        "variants": {name: {"correlation": value(0.6), "overlap": value(0.5), "turned": value(0.1)} for name in names},
        "margins": {"0–2 %": dict.fromkeys(names, value(0.55)), "over 40 %": dict.fromkeys(names, value(0.95))},
        "rollouts": {size: {"margin": value(0.3), "ade_agrees": value(0.7)} for size in ("8", "16")},
        "seconds": {"paper": 1.0, "time-aligned": 0.4},
        "made": {"command": "python -m recipes.sensitivity policies=[a.pt]", "config": {"seed": 0}},
    }  # fmt: skip


def discriminator() -> dict[str, Any]:
    """One quantity that is ranked by, and one that nothing is known of."""
    kinds = {"discriminator": -0.6, "distance": -0.2, "ade": -0.1, "random": 0.0}
    quarters = {end: {"realism": value(gain)} for end, gain in (("best", 0.01), ("worst", -0.01))}
    return {
        "labels": {"jerk": "mean squared jerk", "collision": "collision rate"},
        "correlation": {"jerk": {kind: value(mean) for kind, mean in kinds.items()}, "collision": dict.fromkeys(kinds)},
        "realism": dict.fromkeys(("discriminator", "distance", "ade"), quarters),
        "policies": {"0": {"best": {"held_out_auc": 0.91}}},
        "auc": {"discriminator": value(0.9), "jerk": value(0.8)},
        "smoothness_minus_distance": value(0.4),
    }  # fmt: skip


def players() -> dict[str, Any]:
    """One scene with a rollout that is its log."""
    scene = straight_road(2)
    scene.scene_id = "</script><b>made up"
    return pack_players([PlayerScene(scene, {"reference": judged(scene, [slower(scene, 0)], [-1.0])})])


def write(path: Path, content: Any) -> None:
    """Write JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
