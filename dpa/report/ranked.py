"""The rollouts of a scene that are nearest to its log and those farthest from it, on one window of the map."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from dpa.ranking import log_trajectory, occupancy_features, rank_of
from dpa.report.canvas import INK, blank_figure, save_figure
from dpa.report.panels import PANEL, draw_legend, draw_log_paths, draw_marks, draw_panel, first_new
from envs.render import pose_tracks
from envs.scene import Scene


class Incidents(NamedTuple):
    """Where agents of rollouts do what their log never does; E are the agents asked about."""

    collision: Tensor
    """``[R, E]`` int64: first step with a collision, counted from the step after the current one; -1 for none."""
    offroad: Tensor
    """``[R, E]`` int64: first step off the road; -1 for none."""


def incidents(scene: Scene, trajectories: Tensor, agents: Tensor) -> Incidents:
    """Find collisions and departures from the road as the preference distance sees them: while the log is valid.

    Args:
        scene: an uncollated scene.
        trajectories: ``[R, A, T, 4]`` of the present agents in order.
        agents: ``[E]`` int64, rows to look at.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2, speed=10.0, gap=15.0)
        >>> log = log_trajectory(scene, 80)
        >>> stopped = log.clone()
        >>> stopped[0] = stopped[0, :1]  # the car in front stands still
        >>> incidents(scene, torch.stack((log, stopped)), torch.tensor([0, 1])).collision
        tensor([[-1, -1],
                [11, 11]])
    """
    both = torch.cat((trajectories, log_trajectory(scene, trajectories.shape[2])[None].to(trajectories)))
    phi, valid = occupancy_features(scene, both, ("collision", "road_edge"), ego=agents)
    happens = ((phi > 0) & valid[..., None]).unbind(-1)
    return Incidents(*(first_new(each[:-1], each[-1].any(-1)) for each in happens))


def plot_ranked(
    scene: Scene, trajectories: Tensor, distance: Tensor, agents: Tensor, path: str | Path, *, each: int = 3
) -> None:
    """Draw the log, and beside it the nearest and the farthest rollouts of a scene (figure 8 of the paper).

    Args:
        scene: an uncollated scene.
        trajectories: ``[K, A, T, 4]`` x, y, z, heading of the present agents in order.
        distance: ``[K]`` of each rollout to the log.
        agents: ``[E]`` int64, rows whose collisions and departures from the road are marked.
        path: PNG to write.
        each: rollouts of either kind.

    Raises:
        ValueError: fewer rollouts than are to be drawn, or the path is no PNG.
    """
    if not 1 <= each <= len(distance) // 2:
        raise ValueError(f"each must be 1 to {len(distance) // 2}, half of the {len(distance)} rollouts, got {each}.")
    rank = rank_of(distance)
    order = rank.argsort()
    chosen = torch.cat((order[:each], order[-each:]))
    found = incidents(scene, trajectories[chosen], agents)
    figure = blank_figure(PANEL * (each + 2) + 0.4, PANEL * 2 + 1.35)
    grid = figure.add_gridspec(2, each + 2)
    log = figure.add_subplot(grid[:, :2])
    driven = pose_tracks(scene)
    draw_panel(log, scene, driven, "log")
    for position, k in enumerate(chosen.tolist()):
        axes = figure.add_subplot(grid[position // each, 2 + position % each])
        tracks = pose_tracks(scene, trajectories[k])
        title = f"rank {int(rank[k])}: distance {float(distance[k]):.2f} (rollout {k})"
        draw_panel(axes, scene, tracks, title)
        draw_log_paths(axes, scene, driven)
        draw_marks(axes, trajectories[k, agents], [first[position] for first in found])
    draw_legend(figure, [scene], [found])
    text = f"scene {scene.scene_id}: of {len(distance)} rollouts, the nearest to the log above and the farthest below"
    figure.suptitle(text, fontsize=10.5, color=INK)
    save_figure(figure, path)
