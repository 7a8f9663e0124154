"""What do the options of the preference distance change?

python -m recipes.sensitivity policies=[runs/pretrain/policy.pt]

The same rollouts are ranked by the distance and by variants of it: other weights, a feature less, other couplings,
fewer steps. How far do the ranks agree, which pairs turn round, what does each cost, and how wide are pairs with more
rollouts? Run the same command again to go on after a kill.
"""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig

from dpa.preferences import nearest_farthest
from dpa.ranking import DisplacementDistance, Distance
from dpa.ranking.agreement import rank_correlation, same_order
from dpa.report.statistics import Interval, summary
from dpa.report.studies import plot_sensitivity
from envs.files import write_json
from recipes.common.cli import CONFIG, study_recipe
from recipes.common.models import given_policies
from recipes.common.rolled import Rolled
from recipes.common.scenes import open_splits
from recipes.studies.study import ADE, as_json, distances_of, how_made, over_scenes, study
from recipes.studies.tables import StudyTable, tell

MARGINS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, np.inf)
"""Bounds of the ranges of a pair's gap over the scene's mean distance."""
SMALLEST_GROUP = 8
"""Rollouts of the smallest group whose pairs are looked at."""


def measure_scene(each: Rolled, distances: dict[str, Distance]) -> dict[str, Any]:
    """Distance of every rollout by every variant, and the processor's time for it [s]."""
    found: dict[str, Any] = {"distance": {}, "seconds": {}}
    for name, distance in distances.items():
        start = time.process_time()
        ranking = distance(each.scene, each.trajectories, each.controlled)
        found["seconds"][name] = time.process_time() - start
        found["distance"][name] = ranking.distance.tolist()
    found["distance"][ADE] = DisplacementDistance()(each.scene, each.trajectories, each.controlled).ade.tolist()
    return found


class Variants:
    """The measured distances ``[policies, scenes, K]`` of every variant.

    Args:
        measured: for each policy what :func:`measure_scene` gave for each scene.
        baseline: name of the distance that variants are compared with.
    """

    def __init__(self, measured: dict[str, list[dict]], baseline: str) -> None:
        rows = list(measured.values())
        self.names = list(rows[0][0]["distance"])
        self.values = {
            name: np.array([[scene["distance"][name] for scene in row] for row in rows]) for name in self.names
        }
        self.seconds = {
            name: float(np.mean([scene["seconds"][name] for row in rows for scene in row]))
            for name in self.names
            if name != ADE
        }
        self.baseline = baseline

    @property
    def base(self) -> np.ndarray:
        """``[policies, scenes, K]`` of the distance itself."""
        return self.values[self.baseline]

    def others(self) -> list[str]:
        """Names of the variants."""
        return [name for name in self.names if name != self.baseline]

    def correlation(self, name: str) -> Interval:
        """Spearman with the distance itself, over the scenes where both tell rollouts apart.

        Raises:
            ValueError: there is no such scene.
        """
        return over_scenes(rank_correlation(self.base, self.values[name]), name)

    def overlap(self, name: str) -> Interval:
        """Share of the nearest quarter of rollouts that the variant has among its nearest quarter too."""
        quarter = self.base.shape[-1] // 4
        chosen = [value.argsort(-1, kind="stable")[..., :quarter] for value in (self.base, self.values[name])]
        shared = [
            [len(set(a) & set(b)) / quarter for a, b in zip(mine, theirs, strict=True)]
            for mine, theirs in zip(*chosen, strict=True)
        ]
        return summary(shared)

    def turned(self, name: str) -> Interval:
        """Share of the pairs of the nearest quarter with the farthest one that the variant would turn round."""
        return summary((quarter_gaps(self.base, self.values[name]) < 0).mean(-1))

    def by_margin(self, name: str, low: float, high: float) -> Interval | None:
        """Share of pairs in the same order, of those whose gap over the scene's mean lies in a range; None: no pair."""
        policies, scenes, count = self.base.shape
        i, j = np.triu_indices(count, 1)
        share = np.full((policies, scenes), np.nan)
        for place in np.ndindex(policies, scenes):
            base = self.base[place]
            gap = np.abs(base[i] - base[j]) / max(base.mean(), np.finfo(float).tiny)
            within = (gap >= low) & (gap < high) & (gap > 0)
            if within.any():
                share[place] = same_order(base, self.values[name][place])[within].mean()
        return None if np.isnan(share).any(0).all() else over_scenes(share, name)

    def pairs_of(self, rollouts: int) -> dict[str, Interval]:
        """What pairs of the nearest and farthest quarter of the first rollouts are like.

        ``margin``: gap of their distances over the scene's mean; ``ade_agrees``: share that ADE would order alike.
        """
        base, ade = self.base[..., :rollouts], self.values[ADE][..., :rollouts]
        scale = np.maximum(self.base.mean(-1, keepdims=True), np.finfo(float).tiny)
        return {
            "margin": summary((quarter_gaps(base, base) / scale).mean(-1)),
            "ade_agrees": summary((1 + np.sign(quarter_gaps(base, ade))).mean(-1) / 2),
        }


def quarter_gaps(base: np.ndarray, value: np.ndarray) -> np.ndarray:
    """What a measure says of the pairs of the nearest quarter with the farthest one.

    Args:
        base: ``[..., K]`` distances that decide the pairs, as :func:`~dpa.preferences.nearest_farthest` does.
        value: ``[..., K]`` of the same rollouts.

    Returns:
        ``[..., K // 4]``: value of the far rollout minus that of the near one.

    Examples:
        >>> quarter_gaps(np.array([0.1, 0.4, 0.2, 0.3]), np.array([1.0, 5.0, 2.0, 3.0]))
        array([4.])
    """
    flat, quarter = torch.from_numpy(base).reshape(-1, base.shape[-1]), base.shape[-1] // 4
    near, far = (side.numpy().reshape(*base.shape[:-1], quarter) for side in nearest_farthest(flat, quarter))
    return np.take_along_axis(value, far, -1) - np.take_along_axis(value, near, -1)


def summarise(variants: Variants) -> dict[str, Any]:
    """All tables of the study: ``variants`` by name, ``margins`` by range and variant, ``rollouts`` by their number."""
    rollouts, sizes = variants.base.shape[-1], []
    size = SMALLEST_GROUP
    while size <= rollouts:
        sizes.append(size)
        size *= 2
    ranges = list(pairwise(MARGINS))
    margins = {title(*each): {name: variants.by_margin(name, *each) for name in variants.others()} for each in ranges}
    return {
        "variants": {
            name: {
                "correlation": variants.correlation(name),
                "overlap": variants.overlap(name),
                "turned": variants.turned(name),
            }
            for name in variants.others()
        },
        "margins": {range_: values for range_, values in margins.items() if None not in values.values()},
        "rollouts": {size: variants.pairs_of(size) for size in sizes},
    }


def title(low: float, high: float) -> str:
    """A range of margins in words.

    Examples:
        >>> title(0.05, 0.1), title(0.4, np.inf)
        ('5–10 %', 'over 40 %')
    """
    return f"over {low:.0%}".replace("%", " %") if high == np.inf else f"{100 * low:g}–{100 * high:g} %"


@hydra.main(**CONFIG, config_name="sensitivity")
@study_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.sensitivity``."""
    if cfg.num_rollouts < SMALLEST_GROUP:
        raise ValueError(f"num_rollouts must be {SMALLEST_GROUP} or more, got {cfg.num_rollouts}.")
    distances = distances_of(cfg.rankings, "rankings")
    if cfg.baseline not in distances:
        raise ValueError(f"baseline must be one of the rankings {', '.join(distances)}, got {cfg.baseline!r}.")
    policies = given_policies(cfg)
    scenes = open_splits(cfg.scenes)[cfg.split]
    decided_by = {"rankings": {name: distance.describe() for name, distance in distances.items()}}
    measured = study(cfg, policies, scenes, lambda each: measure_scene(each, distances), decided_by)
    variants = Variants(measured, cfg.baseline)
    found, folder = summarise(variants), Path(cfg.output)
    agreement = {name: values["correlation"] for name, values in found["variants"].items()}
    picture = folder / "sensitivity.png"
    plot_sensitivity(agreement, list(found["margins"].items()), picture)
    made = how_made(cfg, "sensitivity", scenes, measured)
    write_json(folder / "summary.json", as_json(found) | {"seconds": variants.seconds, "made": made})
    tell(cfg, tables(found, variants), {"variants/sensitivity": picture})
    print(f"numbers of every scene, summary and figure: {folder}")


def tables(found: dict[str, Any], variants: Variants) -> list[StudyTable]:
    """What :func:`summarise` found, row by row; the distance itself comes first."""
    policies, scenes, rollouts = variants.base.shape
    columns = ("correlation", "overlap", "turned")
    rows = {variants.baseline: [1.0, 1.0, 0.0, variants.seconds[variants.baseline]]} | {
        name: [*(values[key] for key in columns), variants.seconds.get(name)]
        for name, values in found["variants"].items()
    }
    head = f"{scenes} scenes, {policies} policies, {rollouts} rollouts, against {variants.baseline!r}"
    titles = ["ranking", "Spearman", "same nearest quarter", "pairs turned round", "s per scene"]
    pairs = {str(size): [values["margin"], values["ade_agrees"]] for size, values in found["rollouts"].items()}
    return [
        StudyTable("variants", head, titles, rows, signed=False),
        StudyTable(
            "margins",
            "share of pairs in the same order, by the gap of their distances over the scene's mean",
            ["ranking", *found["margins"]],
            {name: [values[name] for values in found["margins"].values()] for name in variants.others()},
            signed=False,
        ),
        StudyTable(
            "pairs",
            "nearest and farthest quarter",
            ["rollouts", "margin of a pair over the scene's mean", "ADE orders alike"],
            pairs,
            signed=False,
        ),
    ]


if __name__ == "__main__":
    main()
