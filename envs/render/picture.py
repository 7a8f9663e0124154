"""Whole pictures: a step of a scene, and frames of an animation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from torch import Tensor

from envs.render.layers import View, draw_agents, draw_map, draw_trails, fit_view, frame_view, pose_tracks
from envs.render.style import AGENT_COLORS, INK_COLOR, LIGHT_GROUP, LIGHT_STYLE, SDC_COLOR, STOP_SIGN_COLOR
from envs.scene import CURRENT_STEP, LOG_STEPS, STEP_SECONDS, AgentKind, MapKind, Scene


def render_frames(
    scene: Scene,
    trajectories: Tensor | None = None,
    *,
    steps: Iterable[int] = range(LOG_STEPS),
    view: View | None = None,
    trails: bool = True,
    pixels: int = 900,
) -> Iterator[NDArray[np.uint8]]:
    """Render one picture for each step; the map is drawn only once.

    Args:
        scene: one uncollated scene.
        trajectories: ``[A', T, 3 or 4]``, see :func:`pose_tracks`; the log by default.
        steps: steps to render, each 0 to 90.
        view: window, the same for all pictures; :func:`fit_view` by default.
        trails: draw the paths behind agents (thin) and ahead of them (fading).
        pixels: H and W of a picture.

    Yields:
        ``[H, W, 3]`` uint8.

    Raises:
        ValueError: a step outside the scene, or trajectories that do not fit it.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> [frame.shape for frame in render_frames(straight_road(), steps=[10, 50], pixels=200)]
        [(200, 200, 3), (200, 200, 3)]
    """
    tracks = pose_tracks(scene, trajectories)
    # Line widths and letters are in points: a constant size in inches makes every resolution the same picture.
    figure = Figure(figsize=(6, 6), dpi=pixels / 6)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    frame_view(axes, view or fit_view(scene))
    draw_map(axes, scene)
    _draw_legend(axes, scene)
    yield from frames_over(canvas, (_draw_moment(axes, scene, tracks, step, trails) for step in steps))


def frames_over(canvas: FigureCanvasAgg, moments: Iterable[Sequence[Artist]]) -> Iterator[NDArray[np.uint8]]:
    """Frames of an animation: what the figure has is drawn once, and what moves over it.

    Args:
        canvas: of a figure.
        moments: the artists of each frame, made just before it, which are taken away again.

    Yields:
        ``[H, W, 3]`` uint8.
    """
    canvas.draw()
    background = canvas.copy_from_bbox(canvas.figure.bbox)
    for artists in moments:
        canvas.restore_region(background)
        for artist in sorted(artists, key=lambda each: each.get_zorder()):
            artist.axes.draw_artist(artist)
            artist.remove()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def render_frame(
    scene: Scene,
    trajectories: Tensor | None = None,
    *,
    step: int = CURRENT_STEP,
    view: View | None = None,
    trails: bool = True,
    pixels: int = 900,
) -> NDArray[np.uint8]:
    """Render one step; the arguments are those of :func:`render_frames`.

    Returns:
        ``[H, W, 3]`` uint8.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> render_frame(straight_road(), pixels=300).shape
        (300, 300, 3)
    """
    return next(render_frames(scene, trajectories, steps=[step], view=view, trails=trails, pixels=pixels))


def _draw_moment(axes: Axes, scene: Scene, tracks: Tensor, step: int, trails: bool) -> list[Artist]:
    """Everything that moves; the artists are returned so that an animation can take them away again."""
    if not 0 <= step < LOG_STEPS:
        raise ValueError(f"step must be 0 to {LOG_STEPS - 1}, got {step}.")
    artists: list[Artist] = []
    if trails:
        artists += draw_trails(axes, scene, tracks, 0, step, alpha=0.35, width=0.8)
        artists += draw_trails(axes, scene, tracks, step, LOG_STEPS - 1)
    artists += draw_agents(axes, scene, tracks, step)
    clock = f"{(step - CURRENT_STEP) * STEP_SECONDS:+.1f} s"
    return [*artists, axes.text(0.985, 0.975, clock, transform=axes.transAxes, ha="right", va="top", **_LETTERS)]


_LETTERS = {
    "fontsize": 9,
    "color": INK_COLOR,
    "zorder": 12,
    "bbox": {"boxstyle": "round,pad=0.35", "facecolor": (1, 1, 1, 0.85), "edgecolor": "none"},
}


def legend_handles(scene: Scene) -> list[Line2D]:
    """Marks of the agent classes, the stop signs and the states of lights that a scene has."""
    kinds = sorted(set(scene.agents.kind[~scene.agents.sdc].tolist()))
    marks = [("SDC", "s", SDC_COLOR)] + [(AgentKind(k).name.capitalize(), "s", AGENT_COLORS[k]) for k in kinds]
    if (scene.road.kind == MapKind.STOP_SIGN).any():
        marks.append(("Stop sign", "o", STOP_SIGN_COLOR))
    groups = {LIGHT_GROUP[state] for state in scene.lights.state.unique().tolist() if state in LIGHT_GROUP}
    marks += [(f"Light: {group}", *mark) for group, mark in LIGHT_STYLE.items() if group in groups]
    return [
        Line2D([], [], marker=marker, ls="", ms=6, mec="white", mfc=color, label=name) for name, marker, color in marks
    ]


def _draw_legend(axes: Axes, scene: Scene) -> None:
    """What the scene has, and a bar of 20 m (on the ground, so that it is right in any window)."""
    legend = axes.legend(
        handles=legend_handles(scene), loc="upper left", fontsize=8, labelcolor=INK_COLOR, frameon=True,
        facecolor="white", edgecolor="none", framealpha=0.85, handletextpad=0.2, borderpad=0.5, borderaxespad=0.6,
        labelspacing=0.35,
    )  # fmt: skip
    legend.set_zorder(12)
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    x, y, bar = left + 0.03 * (right - left), low + 0.03 * (high - low), 20.0
    axes.plot([x, x + bar], [y, y], color=INK_COLOR, lw=1.6, solid_capstyle="butt", zorder=12)
    axes.text(
        x + bar / 2, y + 0.008 * (high - low), "20 m", ha="center", va="bottom", fontsize=8, color=INK_COLOR, zorder=12
    )
