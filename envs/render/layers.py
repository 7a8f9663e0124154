"""What a picture shows, layer by layer: the map (never changes), trails (one set per rollout), agents (per step)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from numpy.typing import NDArray
from torch import Tensor

from envs.geometry.boxes import box_corners
from envs.render import style
from envs.scene import CURRENT_STEP, LOG_STEPS, Scene, polylines


class View(NamedTuple):
    """A square window on the scene.

    Attributes:
        x: centre, in the scene's frame [m].
        y: centre, in the scene's frame [m].
        radius: half the side of the square [m].
    """

    x: float
    y: float
    radius: float


def fit_view(scene: Scene, *, margin: float = 15.0, smallest: float = 35.0, largest: float = 90.0) -> View:
    """The square that holds the logged paths of the evaluated agents, or as much of it as is readable.

    Args:
        scene: one uncollated scene.
        margin: room around the paths [m].
        smallest: least radius [m].
        largest: greatest radius; beyond it the view centres on the SDC's current position [m].

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> fit_view(straight_road(num_vehicles=1, speed=5.0))
        View(x=17.5, y=-2.5, radius=37.5)
    """
    agents = scene.agents
    seen = agents.position[agents.evaluated][..., :2][agents.valid[agents.evaluated]]
    low, high = seen.amin(0), seen.amax(0)
    radius = float((high - low).max()) / 2 + margin
    centre = (low + high) / 2 if radius <= largest else agents.position[agents.sdc][0, CURRENT_STEP, :2]
    return View(*centre.tolist(), min(max(radius, smallest), largest))


def frame_view(axes: Axes, view: View) -> None:
    """Turn axes into a window on a scene: limits, equal scales, no ticks."""
    axes.set_xlim(view.x - view.radius, view.x + view.radius)
    axes.set_ylim(view.y - view.radius, view.y + view.radius)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#d5d8da")


def pose_tracks(scene: Scene, trajectories: Tensor | None = None) -> Tensor:
    """Poses of all agents at all steps: the log, or the log up to now and simulated poses after it.

    Args:
        scene: one uncollated scene.
        trajectories: ``[A', T, 3]`` (x, y, heading) or ``[A', T, 4]`` (x, y, z, heading, the order of realism.md 1.5)
            of the A' agents present at the current step, in scene order, from the step after the current one; NaN where
            an agent is not there. None gives the log.

    Returns:
        ``[A, L, 3]`` x, y, heading; NaN where the agent is absent.

    Raises:
        ValueError: the trajectories do not fit the scene.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(num_vehicles=2)
        >>> pose_tracks(scene, torch.zeros(2, 80, 3))[0, 9:12, 0]
        tensor([-1.,  0.,  0.])
    """
    agents = scene.agents
    poses = torch.where(agents.valid[..., None], agents.poses, torch.nan)
    if trajectories is None:
        return poses
    num_present, horizon = int(agents.present.sum()), LOG_STEPS - CURRENT_STEP - 1
    shape = tuple(trajectories.shape)
    if len(shape) != 3 or shape[0] != num_present or not 1 <= shape[1] <= horizon or shape[2] not in (3, 4):
        raise ValueError(
            f"scene {scene.scene_id}: trajectories must be [A'={num_present}, T<={horizon}, 3 or 4], one row for each "
            f"agent present at the current step, got {shape}. Select the agents with scene.agents.present."
        )
    if shape[2] == 4:
        trajectories = trajectories[..., [0, 1, 3]]
    poses[:, CURRENT_STEP + 1 :] = torch.nan
    poses[agents.present, CURRENT_STEP + 1 : CURRENT_STEP + 1 + shape[1]] = trajectories.detach().cpu().to(poses)
    return poses


def draw_map(axes: Axes, scene: Scene) -> None:
    """Draw the map of one uncollated scene: road surface, areas, lines, edges and stop signs."""
    axes.set_facecolor(style.GROUND_COLOR)
    for order, layer in enumerate(style.MAP_LAYERS):
        found = [line[:, :2].numpy() for line in polylines(scene, layer.kinds)]
        if found:
            _draw_layer(axes, layer, found, zorder=1 + order / 10)


def _draw_layer(axes: Axes, layer: style.MapLayer, found: list[NDArray[np.float32]], zorder: float) -> None:
    if layer.paint == "dot":
        x, y = np.concatenate(found).T
        axes.scatter(x, y, s=layer.width**2, marker="8", color=layer.color, edgecolors="white", lw=0.6, zorder=zorder)
    elif layer.paint in ("lane", "area"):
        areas = [_strip(line, layer.width) for line in found if len(line) > 1] if layer.paint == "lane" else found
        axes.add_collection(PolyCollection(areas, facecolors=layer.color, edgecolors="none", zorder=zorder))
    else:
        dashes = (0, (4, 4)) if layer.paint == "dashes" else "solid"
        lines = LineCollection(
            found, colors=layer.color, linewidths=layer.width, linestyles=dashes, zorder=zorder, capstyle="round"
        )
        axes.add_collection(lines)


def draw_trails(
    axes: Axes, scene: Scene, tracks: Tensor, first: int, last: int, *, alpha: float = 0.9, width: float = 1.6
) -> list[Artist]:
    """Draw the path of every agent between two steps, fading with time.

    Args:
        axes: where to draw.
        scene: one uncollated scene; gives classes and the SDC.
        tracks: ``[A, L, 3]`` from :func:`pose_tracks`.
        first: first step.
        last: last step, drawn as well.
        alpha: opacity at ``first``; it falls to a fifth at ``last``.
        width: of the line [points].
    """
    path = tracks[:, first : last + 1, :2].numpy()
    pieces = np.stack((path[:, :-1], path[:, 1:]), 2)
    fade = np.linspace(alpha, alpha / 5, pieces.shape[1])
    colors = np.repeat(_agent_colors(scene)[:, None], pieces.shape[1], 1)
    colors[..., 3] = fade
    drawn = np.isfinite(pieces).all((2, 3)) & (np.abs(pieces[:, :, 1] - pieces[:, :, 0]).max(-1) > 0)
    trail = LineCollection(
        pieces[drawn], colors=colors[drawn], linewidths=width, zorder=7, capstyle="butt", joinstyle="round"
    )
    return [axes.add_collection(trail)]


def draw_agents(axes: Axes, scene: Scene, tracks: Tensor, step: int) -> list[Artist]:
    """Draw traffic lights and the boxes of the agents at one step, each with a light nose that shows its heading.

    Args:
        axes: where to draw.
        scene: one uncollated scene; gives boxes, classes, the SDC and the lights.
        tracks: ``[A, L, 3]`` from :func:`pose_tracks`.
        step: 0 to 90.
    """
    there = torch.isfinite(tracks[:, step]).all(-1)
    pose, extent = tracks[there, step], scene.agents.extent[there]
    corners = box_corners(torch.cat((pose, extent[:, :2]), -1))
    front = (corners[:, 0] + corners[:, 3]) / 2
    # A third of the way back on both sides: with the middle of the front it makes an arrow head.
    left, right = torch.lerp(corners[:, 0], corners[:, 1], 0.33), torch.lerp(corners[:, 3], corners[:, 2], 0.33)
    noses = torch.stack((front, left, right), 1)
    colors = _agent_colors(scene)[there.numpy()]
    halo = torch.isin(scene.agents.kind[there], torch.tensor(style.SMALL_KINDS)).numpy()
    x, y = pose[:, :2].T.numpy()
    dots = axes.scatter(x[halo], y[halo], s=70, c=colors[halo] * (1, 1, 1, 0.3), linewidths=0, zorder=8.5)
    boxes = PolyCollection(corners.numpy(), facecolors=colors, edgecolors="white", linewidths=0.4, zorder=9)
    heads = PolyCollection(noses.numpy(), facecolors=(1, 1, 1, 0.6), edgecolors="none", zorder=10)
    return [*_draw_lights(axes, scene, step), dots, axes.add_collection(boxes), axes.add_collection(heads)]


def _draw_lights(axes: Axes, scene: Scene, step: int) -> list[Artist]:
    state, artists = scene.lights.state[:, step], []
    for group, (marker, color) in style.LIGHT_STYLE.items():
        members = torch.tensor([style.LIGHT_GROUP.get(int(s)) == group for s in state], dtype=torch.bool)
        if members.any():
            x, y = scene.lights.stop_point[members, step, :2].T.numpy()
            artists.append(axes.scatter(x, y, s=22, marker=marker, color=color, edgecolors="white", lw=0.6, zorder=11))
    return artists


def _agent_colors(scene: Scene) -> NDArray[np.float64]:
    """``[A, 4]`` red, green, blue, opacity."""
    names = [
        style.SDC_COLOR if sdc else style.AGENT_COLORS[kind]
        for kind, sdc in zip(scene.agents.kind.tolist(), scene.agents.sdc.tolist(), strict=True)
    ]
    return np.array([to_rgba(name) for name in names])


def _strip(line: NDArray[np.float32], width: float) -> NDArray[np.float32]:
    """``[2 n, 2]`` outline of a polyline ``[n, 2]`` as wide as a lane; data units, so it scales with any window."""
    tangent = np.gradient(line, axis=0)
    length = np.hypot(tangent[:, 0], tangent[:, 1])
    normal = np.stack((-tangent[:, 1], tangent[:, 0]), -1) / np.maximum(length, 1e-6)[:, None]
    return np.concatenate((line + normal * width / 2, (line - normal * width / 2)[::-1]))
