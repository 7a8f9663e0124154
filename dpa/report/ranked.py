"""The rollouts of a scene that are nearest to its log and those farthest from it, on one window of the map."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from torch import Tensor

from dpa.ranking import log_trajectory, occupancy_features, rank_of
from dpa.report.canvas import INK, blank_figure, save_figure
from dpa.report.coupling import LOG_COLOR
from envs.render import draw_agents, draw_map, draw_trails, fit_view, frame_view, pose_tracks
from envs.render.picture import legend_handles
from envs.scene import CURRENT_STEP, Scene

MARKS = {"collision": ("X", "#000000"), "off road": ("v", "#f0b400")}
"""Marker and colour; shape repeats what colour says."""
PANEL = 2.55
"""Side of the picture of a rollout [inches]."""
LEGEND_ENTRY = 1.45
"""Width of an entry of the legend [inches]."""
LOG_PATH = {"color": LOG_COLOR, "lw": 0.8, "ls": (0, (2, 1.5))}


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
    happens = (phi > 0) & valid[..., None]
    new = happens[:-1] & ~happens[-1:].any(2, keepdim=True)
    first = torch.where(new.any(2), new.int().argmax(2), -1)
    return Incidents(*first.unbind(-1))


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
    width = PANEL * (each + 2) + 0.4
    figure = blank_figure(width, PANEL * 2 + 1.35)
    grid = figure.add_gridspec(2, each + 2)
    log = figure.add_subplot(grid[:, :2])
    _panel(log, scene, pose_tracks(scene), "log")
    for position, k in enumerate(chosen.tolist()):
        axes = figure.add_subplot(grid[position // each, 2 + position % each])
        tracks = pose_tracks(scene, trajectories[k])
        title = f"rank {int(rank[k])}: distance {float(distance[k]):.2f} (rollout {k})"
        _panel(axes, scene, tracks, title)
        _log_paths(axes, scene)
        for first, (marker, color) in zip(found, MARKS.values(), strict=True):
            _mark(axes, trajectories[k, agents], first[position], marker, color)
    handles = [*legend_handles(scene), Line2D([], [], **LOG_PATH, label="path in the log"), *_marks(found)]
    rows = math.ceil(len(handles) * LEGEND_ENTRY / width)
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=math.ceil(len(handles) / rows),
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
    )
    text = f"scene {scene.scene_id}: of {len(distance)} rollouts, the nearest to the log above and the farthest below"
    figure.suptitle(text, fontsize=10.5, color=INK)
    save_figure(figure, path)


def _panel(axes: Axes, scene: Scene, tracks: Tensor, title: str) -> None:
    frame_view(axes, fit_view(scene, margin=10.0, smallest=25.0, largest=60.0))  # the panels are small
    draw_map(axes, scene)
    draw_trails(axes, scene, tracks, CURRENT_STEP, tracks.shape[1] - 1, alpha=1.0, width=1.5)
    draw_agents(axes, scene, tracks, CURRENT_STEP)
    axes.set_title(title, fontsize=8.5, color=INK)


def _log_paths(axes: Axes, scene: Scene) -> None:
    """Where the agents of the rollout went in the log."""
    paths = pose_tracks(scene)[scene.agents.present, CURRENT_STEP:, :2].numpy()
    axes.add_collection(LineCollection(paths, colors=LOG_COLOR, linewidths=0.7, linestyles=(0, (2, 1.5)), zorder=8))


def _mark(axes: Axes, poses: Tensor, first: Tensor, marker: str, color: str) -> None:
    """Mark where each agent (``[E, T, 4]``) is at a step (``[E]``, -1 for none)."""
    there = first >= 0
    x, y = poses[there, first[there], :2].T.numpy()
    axes.scatter(x, y, s=34, marker=marker, color=color, edgecolors="white", lw=0.8, zorder=15)


def _marks(found: Incidents) -> list[Line2D]:
    """Legend of the marks that are used."""
    return [
        Line2D([], [], marker=marker, ls="", ms=7, mec="white", mfc=color, label=f"{name}, not in the log")
        for first, (name, (marker, color)) in zip(found, MARKS.items(), strict=True)
        if bool((first >= 0).any())
    ]
