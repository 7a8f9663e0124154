"""Does a distance to the log tell realism (figure 3 of the paper)?

python -m recipes.validity policies=[runs/pretrain/policy.pt]

Each scene is rolled out many times and its rollouts are sorted by a distance to the log. A window slides over them,
from the nearest to the farthest: the realism of the rollouts in it against their mean distance. Run the same command
again to go on after a kill.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
import numpy as np
from omegaconf import DictConfig
from torch import Tensor

from dpa.ranking import DisplacementDistance, Distance
from dpa.ranking.agreement import rank_correlation
from dpa.realism import RealismConfig, realism_of_groups
from dpa.report.statistics import Interval, paired_bootstrap, summary
from dpa.report.studies import plot_validity
from envs.files import write_json
from recipes.common.cli import CONFIG, finite, study_recipe
from recipes.common.models import given_policies
from recipes.common.rolled import Rolled
from recipes.common.scenes import open_splits
from recipes.studies.study import (
    ADE,
    RANDOM_GROUPS,
    as_json,
    distances_of,
    how_made,
    over_scenes,
    random_groups,
    study,
    with_realism,
)
from recipes.studies.tables import StudyTable, tell


def windows(distance: Tensor, size: int, stride: int) -> list[Tensor]:
    """Rollouts in each window over the order of a distance, nearest first; ties go to the smaller index.

    Args:
        distance: ``[K]``.
        size: rollouts of a window.
        stride: from one window to the next.

    Examples:
        >>> import torch
        >>> windows(torch.tensor([0.3, 0.1, 0.2, 0.4]), size=2, stride=2)
        [tensor([1, 2]), tensor([0, 3])]
    """
    order = distance.argsort(stable=True)
    return [order[first : first + size] for first in range(0, len(order) - size + 1, stride)]


def measure_scene(
    each: Rolled, distances: dict[str, Distance], window: int, stride: int, metric: RealismConfig, seed: int
) -> dict[str, Any]:
    """Mean distance and realism of every window of every ranking, and of random groups.

    Args:
        each: scene and rollouts.
        distances: rankings by name; displacement from the log is one more, ``ade``.
        window: rollouts of a window.
        stride: from one window to the next.
        metric: the realism metric.
        seed: of the random groups.
    """
    rankings = {name: distance(each.scene, each.trajectories, each.controlled) for name, distance in distances.items()}
    values = {name: ranking.distance for name, ranking in rankings.items()}
    values[ADE] = DisplacementDistance()(each.scene, each.trajectories, each.controlled).ade
    groups = {name: windows(value, window, stride) for name, value in values.items()}
    groups["random"] = random_groups(each, window, seed, "validity")
    flat = [group for each_group in groups.values() for group in each_group]
    scores = iter(realism_of_groups(each.scene, each.trajectories, flat, metric))
    found: dict[str, Any] = {}
    for name, members in groups.items():
        found[name] = {"realism": [finite(next(scores).realism) for _ in members]}
        if name in values:
            found[name]["distance"] = [values[name][group].mean().item() for group in members]
    return found


def summarise(measured: dict[str, list[dict]]) -> dict[str, dict[str, Any]]:
    """What every ranking is worth, with intervals over policies and scenes.

    Args:
        measured: for each policy what :func:`measure_scene` gave for each scene.

    Returns:
        For each ranking ``correlation`` (Spearman of mean distance and realism over the windows of a scene; -1 is
        best), ``nearest`` and ``farthest`` (realism of the first and the last window minus that of random groups),
        ``near_half`` (the correlation over the nearer half of the windows alone), each an
        :class:`~dpa.report.statistics.Interval`, and the curves ``distance`` (over the scene's mean) and ``realism``
        (minus that of random groups) with one interval for each window. Scenes where a distance or the realism is the
        same for all windows say nothing about a correlation and are left out of it; scenes without realism (nothing of
        one of its features is scored) are left out of everything.

    Raises:
        ValueError: no scene has realism, or none tells its windows apart.
    """
    rows = _with_realism(measured)
    names = [name for name in rows[0][0] if name != "random"]
    random = np.array([[np.mean(scene["random"]["realism"]) for scene in row] for row in rows])
    found = {}
    for name in names:
        distance, score = _by_window(rows, name, "distance"), _by_window(rows, name, "realism")
        gain = score - random[..., None]
        relative = distance / np.maximum(distance.mean(-1, keepdims=True), np.finfo(float).tiny)
        found[name] = {
            "correlation": over_scenes(rank_correlation(distance, score), name),
            "near_half": over_scenes(near_correlation(distance, score), name),
            "nearest": summary(gain[..., 0]),
            "farthest": summary(gain[..., -1]),
            "distance": [summary(relative[..., place]) for place in range(relative.shape[-1])],
            "realism": [summary(gain[..., place]) for place in range(gain.shape[-1])],
        }
    return found


def compare_with(measured: dict[str, list[dict]], other: str) -> dict[str, dict[str, Interval]]:
    """Each ranking minus another one, scene by scene: its correlation ``near_half`` (below 0: it tells realism better),
    and the realism of its ``nearest`` and its ``farthest`` window.

    Raises:
        ValueError: no scene has realism, or none tells the windows of both apart.
    """
    rows = _with_realism(measured)
    names = [name for name in rows[0][0] if name != "random"]

    score = {name: _by_window(rows, name, "realism") for name in names}
    near = {name: near_correlation(_by_window(rows, name, "distance"), score[name]) for name in names}
    return {
        name: {
            "near_half": over_scenes(near[name] - near[other], f"{name} and {other}"),
            "nearest": paired_bootstrap(score[name][..., 0], score[other][..., 0]),
            "farthest": paired_bootstrap(score[name][..., -1], score[other][..., -1]),
        }
        for name in names
        if name != other
    }


def near_correlation(distance: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Spearman of distance and realism over the nearer half of the windows: ``[..., windows]`` -> ``[...]``."""
    half = max(2, (distance.shape[-1] + 1) // 2)
    return rank_correlation(distance[..., :half], score[..., :half])


def _by_window(rows: list[list[dict]], name: str, key: str) -> np.ndarray:
    """``[policies, scenes, windows]`` of a ranking."""
    return np.array([[scene[name][key] for scene in row] for row in rows])


def _with_realism(measured: dict[str, list[dict]]) -> list[list[dict]]:
    """For each policy the scenes that have realism under all of them."""
    rows = list(measured.values())
    places = with_realism(rows, lambda scene: scene["random"]["realism"])
    return [[row[place] for place in places] for row in rows]


@hydra.main(**CONFIG, config_name="validity")
@study_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.validity``."""
    if cfg.window < 1 or cfg.stride < 1 or cfg.window + cfg.stride > cfg.num_rollouts:
        raise ValueError(
            f"window and stride must be 1 or more and two windows must fit into num_rollouts, got window={cfg.window}, "
            f"stride={cfg.stride} and num_rollouts={cfg.num_rollouts}; say num_rollouts={cfg.window + cfg.stride}."
        )
    if left := (cfg.num_rollouts - cfg.window) % cfg.stride:
        raise ValueError(
            f"the farthest {left} of num_rollouts={cfg.num_rollouts} are in no window: window={cfg.window} moves by "
            f"stride={cfg.stride}; say num_rollouts={cfg.num_rollouts - left}."
        )
    distances = distances_of(cfg.rankings, "rankings")
    if not distances:
        raise ValueError("rankings is empty: there is nothing to compare with the ADE; name at least one distance.")
    if cfg.against not in (*distances, ADE):
        raise ValueError(f"against must be one of {', '.join((*distances, ADE))}, got {cfg.against!r}.")
    metric = RealismConfig.load(str(cfg.metric))
    policies = given_policies(cfg)
    scenes = open_splits(cfg.scenes)[cfg.split]
    decided_by = {
        "window": cfg.window,
        "stride": cfg.stride,
        "metric": metric.describe(),
        "rankings": {name: distance.describe() for name, distance in distances.items()},
    }
    measured = study(
        cfg,
        policies,
        scenes,
        lambda each: measure_scene(each, distances, cfg.window, cfg.stride, metric, cfg.seed),
        decided_by,
    )
    found, paired = summarise(measured), compare_with(measured, cfg.against)
    folder = Path(cfg.output)
    picture = folder / "validity.png"
    plot_validity(found, picture)
    made = how_made(cfg, "validity", scenes, measured)
    content = {"rankings": as_json(found), "minus": cfg.against, "differences": as_json(paired), "made": made}
    write_json(folder / "summary.json", content)
    head = f"{len(scenes)} scenes, {len(measured)} policies, {cfg.metric}"
    tell(cfg, tables(found, paired, head, cfg.against), {"rankings/validity": picture})
    print(
        f"windows of {cfg.window} of {cfg.num_rollouts} rollouts; realism minus that of {RANDOM_GROUPS} random groups; "
        "95 % intervals"
    )
    print(f"numbers of every scene, summary and figure: {folder}")


def tables(
    found: dict[str, dict[str, Any]], paired: dict[str, dict[str, Interval]], title: str, against: str
) -> list[StudyTable]:
    """What :func:`summarise` and :func:`compare_with` found, row by row."""
    columns = ("correlation", "near_half", "nearest", "farthest")
    titles = ["ranking", "Spearman of distance and realism", "nearer half", "nearest window", "farthest window"]
    return [
        StudyTable(
            "rankings", title, titles, {name: [values[key] for key in columns] for name, values in found.items()}
        ),
        StudyTable(
            "differences",
            f"the correlation, and realism, minus that of {against!r}",
            ["ranking", "Spearman, nearer half", "nearest window", "farthest window"],
            {name: list(values.values()) for name, values in paired.items()},
        ),
    ]


if __name__ == "__main__":
    main()
