"""The most likely rollout of each policy beside the log, in motion: what :mod:`dpa.report.likely` draws, as a film."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from torch import Tensor

from dpa.report.canvas import INK, blank_figure
from dpa.report.likely import likeliest, mishaps_in_log
from dpa.report.panels import MARKS, draw_ground, draw_legend, draw_log_paths
from dpa.report.player import PlayerScene
from envs.render import draw_agents, draw_trails, frames_over, pose_tracks, save_picture
from envs.render.save import Frame
from envs.scene import CURRENT_STEP, LOG_STEPS, STEP_SECONDS, Scene

PANEL = 3.0
"""Side of the picture of a rollout [inches]."""
DOTS = 110
"""Pixels of an inch."""
STRIDE = 2
"""Steps of 0.1 s from one frame to the next: a film of 8 s has 41 frames."""
HELD = 8
"""Frames for which a film stands still where a scene ends."""


class Panel(NamedTuple):
    """One rollout in a film.

    Attributes:
        axes: where it is drawn.
        tracks: ``[A, 91, 3]`` of all agents, log and rollout.
        first: of each of :data:`~dpa.report.panels.MARKS`, ``[A']`` int64: the first step of the rollout at which it
            happens to a present agent, -1 for none; empty for the log, in which nothing is marked.
    """

    axes: Axes
    tracks: Tensor
    first: Sequence[Tensor] = ()


def film_likely(players: Sequence[PlayerScene], path: str | Path) -> None:
    """Film the log of each scene and, beside it, the most likely rollout of each policy, one scene after the other.

    An agent is marked, from the moment on, where it collides or leaves the road and never does so in the log.

    Args:
        players: scenes with judged rollouts of the same policies, the most likely one among them.
        path: GIF or MP4 to write.

    Raises:
        ValueError: no scenes, scenes with different policies, or the path is no film.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from dpa.ranking import PreferenceDistance, log_trajectory
        >>> from dpa.report.judged import judge_rollouts
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> log, nats = log_trajectory(scene, 80)[None], torch.tensor([-1.0])
        >>> judged = judge_rollouts(scene, log, torch.ones(2, dtype=torch.bool), nats, PreferenceDistance(), kept=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     film_likely([PlayerScene(scene, {"reference": judged})], Path(folder) / "likely.gif")
    """
    if not players:
        raise ValueError("there is no scene to film; give at least one.")
    if Path(path).suffix.lower() not in (".gif", ".mp4"):
        raise ValueError(f"a film must end in .gif or .mp4, got {path}.")
    names = [list(player.rollouts) for player in players]
    if any(each != names[0] for each in names):
        raise ValueError(f"all scenes of a film need the same policies, got {names}.")
    frames = (frame for player in players for frame in _frames(player))
    save_picture(path, frames, frame_seconds=STRIDE * STEP_SECONDS)


def _frames(player: PlayerScene) -> Iterator[Frame]:
    """The frames of one scene; map and titles are drawn once."""
    scene, titles = player.scene, ["log", *player.rollouts]
    figure = blank_figure(PANEL * len(titles), PANEL + 0.55)
    figure.set_dpi(DOTS)
    canvas = FigureCanvasAgg(figure)
    places = figure.subplots(1, len(titles), squeeze=False)[0]
    panels = _panels(player, places)
    for axes, title in zip(places, titles, strict=True):
        draw_ground(axes, scene)
        axes.set_title(title, fontsize=11, color=INK)
    for axes in places[1:]:
        draw_log_paths(axes, scene, panels[0].tracks)
    draw_legend(figure, [scene], [panel.first for panel in panels[1:]])
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # nothing may move any more
    steps = [*range(CURRENT_STEP, LOG_STEPS, STRIDE), *[LOG_STEPS - 1] * HELD]
    return frames_over(canvas, ([each for panel in panels for each in _moment(panel, scene, step)] for step in steps))


def _panels(player: PlayerScene, places: Sequence[Axes]) -> list[Panel]:
    """The log, and the most likely rollout of each policy."""
    scene, logged = player.scene, mishaps_in_log(player.scene)
    panels = [Panel(places[0], pose_tracks(scene))]
    for axes, judged in zip(places[1:], player.rollouts.values(), strict=True):
        row, first = likeliest(judged, logged)
        panels.append(Panel(axes, pose_tracks(scene, judged.poses[row]), first))
    return panels


def _moment(panel: Panel, scene: Scene, step: int) -> list[Artist]:
    """All that moves at one step, and the marks that are there by then."""
    artists = draw_trails(panel.axes, scene, panel.tracks, CURRENT_STEP, step, alpha=0.5, width=1.2)
    artists += draw_agents(panel.axes, scene, panel.tracks, step)
    now = panel.tracks[scene.agents.present, step, :2]
    for first, (marker, color) in zip(panel.first, MARKS.values(), strict=False):
        there = (first >= 0) & (first < step - CURRENT_STEP)
        if there.any():
            x, y = now[there].T.numpy()
            artists.append(
                panel.axes.scatter(x, y, s=60, marker=marker, color=color, edgecolors="white", lw=0.9, zorder=15)
            )
    seconds = f"{(step - CURRENT_STEP) * STEP_SECONDS:.1f} s"
    clock = {"ha": "right", "va": "top", "fontsize": 9, "color": INK, "zorder": 16}
    artists.append(panel.axes.text(0.98, 0.975, seconds, transform=panel.axes.transAxes, **clock))
    return artists
