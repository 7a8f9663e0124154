"""A rollout from above, small: what pictures of several rollouts of a scene are put together from."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from dpa.report.canvas import INK
from dpa.report.coupling import LOG_COLOR
from envs.render import draw_agents, draw_map, draw_trails, fit_view, frame_view
from envs.render.picture import legend_handles
from envs.scene import CURRENT_STEP, Scene

PANEL = 2.55
"""Side of the picture of a rollout [inches]."""
MARKS = {"collision": ("X", "#000000"), "off road": ("v", "#f0b400")}
"""Marker and colour; shape repeats what colour says."""
LOG_PATH = {"color": LOG_COLOR, "lw": 0.8, "ls": (0, (2, 1.5))}


def draw_ground(axes: Axes, scene: Scene) -> None:
    """Set the window of a panel and draw the map."""
    frame_view(axes, fit_view(scene, margin=10.0, smallest=25.0, largest=60.0))  # the panels are small
    draw_map(axes, scene)


def draw_panel(axes: Axes, scene: Scene, tracks: Tensor, title: str) -> None:
    """Map, agents at the current step, and where they go from there.

    Args:
        axes: to draw on.
        scene: an uncollated scene.
        tracks: ``[A, L, 3]``, of :func:`~envs.render.pose_tracks`.
        title: above it.
    """
    draw_ground(axes, scene)
    draw_trails(axes, scene, tracks, CURRENT_STEP, tracks.shape[1] - 1, alpha=1.0, width=1.5)
    draw_agents(axes, scene, tracks, CURRENT_STEP)
    axes.set_title(title, fontsize=8.5, color=INK)


def draw_log_paths(axes: Axes, scene: Scene, tracks: Tensor) -> None:
    """Where the agents of the rollout went in the log, ``[A, L, 3]``."""
    paths = tracks[scene.agents.present, CURRENT_STEP:, :2].numpy()
    axes.add_collection(LineCollection(paths, colors=LOG_COLOR, linewidths=0.7, linestyles=(0, (2, 1.5)), zorder=8))


def draw_marks(axes: Axes, poses: Tensor, first: Sequence[Tensor]) -> None:
    """Mark where agents first do what :data:`MARKS` names.

    Args:
        axes: to draw on.
        poses: ``[E, T, ...]`` x, y first.
        first: of each mark the step, ``[E]`` int64, -1 for none.
    """
    for steps, (marker, color) in zip(first, MARKS.values(), strict=True):
        there = steps >= 0
        x, y = poses[there, steps[there], :2].T.numpy()
        axes.scatter(x, y, s=34, marker=marker, color=color, edgecolors="white", lw=0.8, zorder=15)


def draw_legend(figure: Figure, scenes: Sequence[Scene], found: Sequence[Sequence[Tensor]]) -> None:
    """Below the panels: classes of agents, the path in the log, and of :data:`MARKS` those that are used.

    Args:
        figure: of the panels.
        scenes: that are drawn.
        found: of each panel, or of several together, the steps that :func:`draw_marks` took.
    """
    agents = {handle.get_label(): handle for scene in scenes for handle in legend_handles(scene)}
    marks = [
        Line2D([], [], marker=marker, ls="", ms=7, mec="white", mfc=color, label=f"{name}, not in the log")
        for place, (name, (marker, color)) in enumerate(MARKS.items())
        if any(bool((first[place] >= 0).any()) for first in found)
    ]
    handles = [*agents.values(), Line2D([], [], **LOG_PATH, label="path in the log"), *marks]
    style = {"loc": "outside lower center", "frameon": False, "fontsize": 8.5, "labelcolor": INK}
    renderer = figure.canvas.get_renderer()
    for columns in range(len(handles), 0, -1):  # as many as the figure is wide
        legend = figure.legend(handles=handles, ncols=columns, **style)
        if columns == 1 or legend.get_window_extent(renderer).width <= figure.bbox.width:
            return
        legend.remove()


def first_new(happens: Tensor, logged: Tensor) -> Tensor:
    """First step at which an agent does what it never does in the log.

    Args:
        happens: ``[..., E, T]`` bool.
        logged: ``[E]`` bool: it happens in the log.

    Returns:
        ``[..., E]`` int64; -1 for never.

    Examples:
        >>> first_new(torch.tensor([[False, True], [True, True]]), torch.tensor([False, True]))
        tensor([ 1, -1])
    """
    new = happens & ~logged[:, None]
    return torch.where(new.any(-1), new.int().argmax(-1), -1)
