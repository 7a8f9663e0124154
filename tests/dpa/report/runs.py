"""A small study with everything that a real one has. Its numbers are made up for tests."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from dpa.preferences.examples import example_groups, example_provenance
from dpa.preferences.writer import PreferenceWriter
from dpa.report.player import PlayerScene, pack_players
from dpa.report.sections.results import DPO
from dpa.report.statistics import paired_bootstrap
from envs.card import Card
from envs.sources.synthetic import red_light, straight_road
from recipes import discriminator as discriminator_recipe
from recipes import sensitivity as sensitivity_recipe
from recipes import validity as validity_recipe
from recipes.studies import spurious
from recipes.studies.study import as_json, how_made
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

AXIS = {"name": "rankings per scene", "values": {"r1": 1.0, "r4": 4.0, "r16": 16.0}, "log": True}
STAGES = {
    "pretrain": {f"pretrain {seed}": 1800.0 for seed in range(3)},
    "align": {f"align {job}": 200.0 for job in range(9)},
}
"""Seconds of each job."""
ROLLED = {"decoding": {"num_rollouts": 4}, "evaluation": {"num_rollouts": 8}}
"""Of a configuration what every experiment has."""


def write_runs(folder: Path) -> Path:
    """Write the whole study: three experiments, stages, stores, curves, studies of rankings and a scene to play."""
    write_experiment(folder, "methods", ["reference", "dpa_omf", "dpa_adef", "adversarial_afd"], published=PUBLISHED)
    write_experiment(folder, "scaling", ["reference", "r1", "r4", "r16"], headline="r16", axis=AXIS)
    snapshots = ["reference", "dpa_omf@20", "dpa_omf@40", "dpa_omf"]
    write_experiment(folder, "steps", snapshots)
    write(folder / "stages.json", STAGES)
    write(folder / "scenes.json", scenes())
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
    published: dict[str, Any] | None = None, split: str = "eval", grid: Sequence[tuple[float, float]] = GRID,
) -> dict[str, Any]:  # fmt: skip
    """Write one experiment with the files behind its rows; returns its content."""
    best = BEST if BEST in grid else COMMON
    chosen = dict.fromkeys(methods, best)
    others = [method for method in methods if method != "reference"]
    sharper = [("reference", decoding) for decoding in grid if decoding != COMMON]
    scenes = {"train": 8, "tune": 4, "eval": SCENES, "source": "made & up <by hand>"}
    content = {
        "name": name, "title": f"Made-up {name}", "paper": "table 1" if published else None,
        "question": "Is <this> a test?", "metric": "2024", "scenes": scenes | {split: SCENES}, "split": split,
        "left_out": 0, "seeds": list(SEEDS), "methods": methods, "labels": {m: label(m) for m in methods},
        "published": published or {}, "headline": headline, "versus": headline, "common": list(COMMON),
        "steps": {at: {m: int(m.partition("@")[2] or 60) * (m != "reference") for m in methods}
                  for at in ("common", "own_best")},
        "chosen": {method: list(decoding) for method, decoding in chosen.items()},
        "rows": [row(folder, m, s, d, split) for m, d in [*((m, COMMON) for m in methods), *sharper] for s in SEEDS],
        "paired": [paired(m, d, COMMON) for m, d in [*((m, COMMON) for m in others), *sharper]],
        "own_best": {
            "rows": [row(folder, method, seed, best, split) for method in methods for seed in SEEDS],
            "paired": [paired(method, best, best) for method in others],
            "versus": [paired(method, best, best, headline) for method in others if method != headline],
        },
        "tuning": [row(folder, m, s, d, split="tune") for m in methods for d in grid for s in SEEDS],
        "likelihood": [likelihood(folder, method, seed, split) for method in methods for seed in SEEDS],
        "axis": axis,
        "curves": {m: {str(seed): curves(folder, m, seed) for seed in SEEDS} for m in others if "@" not in m},
        "budget": {m: {"steps": 60, "rollouts": 960, "start": "reference"} for m in others if "@" not in m},
        "compute": {m: {"before": 300.0, "training": 600.0, "steps": 60} for m in others if "@" not in m},
        "stages": {"pretrain": 5400.0, "align": 125.0}, "worker_seconds": 5525.0,
        "config": {
            "mark": "<!--{title}-->", "methods": {"dpa_omf": {"loss": DPO}}, **ROLLED,
        },
        "revision": "0123abc", "versions": {"torch": "2.13.0"},
        "machine": "Linux x86_64, 2 CPU cores", "date": "2026-11-21",
        "command": f"python -m recipes.compare experiment={name} 'name=<b>'",
    }  # fmt: skip
    write(folder / "experiments" / f"{name}.json", content)
    return content


def label(method: str) -> str:
    """A snapshot's has its step, as recipes.experiment.summary writes it."""
    base, _, step = method.partition("@")
    return LABELS[base] + (f" @ {step}" if step else "")


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
    options = {"scenes": f"of {split}", "evaluation": {"num_rollouts": 32, "metric": ["2024", "0123"]}}
    write(
        folder / file,
        {"options": options, "mean": mean, "likelihood": {}, "scenes": ["s"] * SCENES, "per_scene": per_scene},
    )
    identity = {"method": method, "seed": seed, "top_p": decoding[0], "temperature": decoding[1], "file": file}
    return identity | {"n_scenes": SCENES, "pair_accuracy": 0.6, **mean}


def paired(
    method: str, decoding: tuple[float, float], against: tuple[float, float], other: str = "reference"
) -> dict[str, Any]:
    """Realism of a method minus that of another one."""
    sides = [(method, decoding), (other, against)]
    mine, base = ([values(name, seed, at)["realism"] for seed in SEEDS] for name, at in sides)
    found = paired_bootstrap(mine, base, 500)
    return {
        "method": method, "top_p": decoding[0], "temperature": decoding[1], "against": other,
        "against_top_p": against[0], "against_temperature": against[1], "realism_difference": found.mean,
        "ci95": [found.low, found.high], "over": found.over, "n_seeds": found.num_seeds,
    }  # fmt: skip


def likelihood(folder: Path, method: str, seed: int, split: str = "eval") -> dict[str, Any]:
    """Likelihood of ranked rollouts, and the file behind it."""
    file, per_scene = f"seed_{seed}/{method}/likelihood_{split}.json", likelihoods(method)
    mean = {figure: math.fsum(scenes) / len(scenes) for figure, scenes in per_scene.items()}
    write(folder / file, {"options": {}, "mean": mean, "scenes": ["s"] * SCENES, "per_scene": per_scene})
    return {"method": method, "seed": seed, "file": file, **mean}


def likelihoods(method: str) -> dict[str, list[float]]:
    """Likelihood in every scene: the same difference from the reference in each."""
    learns = method.startswith("dpa_omf")
    level = {
        "pair_accuracy": 0.65 if learns else 0.51, "reward_accuracy": 0.7 if learns else 0.5,
        "nll_demonstration": 4.0, "nll_preferred": 2.0 - 0.3 * learns,
        "nll_unpreferred": 2.1 + 0.4 * learns, "entropy": 1.9,
        "kl": 0.0 if method == "reference" else 0.3 * float(method.partition("@")[2] or 60) / 60,
    }  # fmt: skip
    scene = np.linspace(-0.1, 0.1, SCENES) * (method != "reference")
    return {figure: (mean + (scene if figure == "kl" else 0 * scene)).tolist() for figure, mean in level.items()}


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
        "tune/kl": [(step, 0.005 * step) for step in tuned],
        "tune/entropy": [(step, 2 - 0.001 * step) for step in tuned],
        "tune/pair_accuracy": [(step, 0.6 + 0.001 * step) for step in tuned],
    }  # fmt: skip
    for name, points in scalars.items():
        path = folder / run / "scalars" / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(f"{step},{value}\n" for step, value in points), encoding="utf-8")
    return run


ROLLOUTS = 16
"""Of a scene of the studies of rankings."""


def made(recipe: str, measured: dict[str, list[dict]]) -> dict[str, Any]:
    """How a study says that it was made."""
    return how_made(
        OmegaConf.create({"seed": 0, "device": "cpu", "num_rollouts": ROLLOUTS, "split": "tune"}),
        recipe,
        ["s"] * SCENES,
        measured,
    )


def validity() -> dict[str, Any]:
    """Two rankings in four windows; realism falls with the distance."""
    draw, measured = np.random.default_rng(0), []
    for _ in range(SCENES):
        scene: dict[str, Any] = {"random": {"realism": [0.6, 0.61]}}
        for name, slope in (("omf", 0.05), ("ade", 0.02)):
            distance = np.sort(draw.uniform(0.5, 1.5, 4))
            realism = 0.6 + slope * (1 - distance) + draw.normal(0, 0.01, 4)
            scene[name] = {"distance": distance.tolist(), "realism": realism.tolist()}
        measured.append(scene)
    policies = {"0": measured}
    return {
        "rankings": as_json(validity_recipe.summarise(policies)),
        "minus": "ade",
        "differences": as_json(validity_recipe.compare_with(policies, "ade")),
        "made": made("validity", policies),
    }


def sensitivity() -> dict[str, Any]:
    """Two variants of a distance."""
    draw, measured = np.random.default_rng(1), []
    for _ in range(SCENES):
        base = draw.uniform(1, 3, ROLLOUTS)
        others = {name: base + draw.normal(0, 0.3, ROLLOUTS) for name in ("ade", "time-aligned")}
        distances = {name: value.tolist() for name, value in ({"paper": base} | others).items()}
        measured.append({"distance": distances, "seconds": {"paper": 1.0, "time-aligned": 0.4}})
    variants = sensitivity_recipe.Variants({"0": measured}, "paper")
    found = as_json(sensitivity_recipe.summarise(variants))
    return found | {"seconds": variants.seconds, "made": made("sensitivity", {"0": measured})}


def discriminator() -> dict[str, Any]:
    """A ranking by jerk, in scenes without a collision."""
    draw, measured = np.random.default_rng(2), []
    for _ in range(SCENES):
        quantity = {name: draw.random(ROLLOUTS) for name in spurious.QUANTITIES}
        quantity["collision"] = np.zeros(ROLLOUTS)
        realism = {end: {"realism": 0.6 + draw.normal(gain, 0.01)} for end, gain in (("best", 0.01), ("worst", -0.01))}
        measured.append(
            {
                "score": (-quantity["jerk"] + draw.normal(0, 0.1, ROLLOUTS)).tolist(),
                "quantity": {name: value.tolist() for name, value in quantity.items()},
                "log": {"score": 0.5, "jerk": 0.1, "jerk_2hz": 0.1},
                "realism": dict.fromkeys(spurious.RANKINGS, realism) | {"random": {"realism": 0.6}},
            }
        )
    policies = {"0": measured}
    training = {"0": {"best": {"step": 4, "held_out_loss": 0.4, "held_out_auc": 0.91}, "curve": [], "scenes": 8}}
    found = discriminator_recipe.summary_json(spurious.summarise(policies), training)
    return found | {"made": made("discriminator", policies)}


def scenes() -> dict[str, Any]:
    """Cards of a few roads; only scenes to tune on have a light."""
    made = {"train": [straight_road(2), straight_road(3)], "tune": [red_light()], "eval": [straight_road(1)]}
    cards = {name: Card() for name in made}
    for name, of_split in made.items():
        for scene in of_split:
            cards[name].add(scene)
    origin = {"source": "made & up", "split": "<any>", "named": ["some/folder"]}
    return {
        "options": {"scenes": dict.fromkeys(made, "0123")},
        "splits": {
            name: {"counts": card.counts, "origins": [origin | {"scenes": len(made[name])}]}
            for name, card in cards.items()
        },
    }


def players() -> dict[str, Any]:
    """One scene: the reference's rollout is its log, DPA-OMF's falls behind."""
    scene = straight_road(2)
    scene.scene_id = "</script><b>made up"
    behind = {label(method): judged(scene, [slower(scene, metres)], [-1.0])
              for method, metres in (("reference", 0), ("dpa_omf", 20))}  # fmt: skip
    return pack_players([PlayerScene(scene, behind)])


def write(path: Path, content: Any) -> None:
    """Write JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, allow_nan=False), encoding="utf-8")
