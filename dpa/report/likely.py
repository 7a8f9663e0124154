"""The most likely rollout of each policy beside the log (figures 5 and 9 of the paper)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.axes import Axes
from torch import Tensor

from dpa.report.canvas import blank_figure, save_figure
from dpa.report.judged import JudgedRollouts, logged_mishaps
from dpa.report.panels import PANEL, draw_legend, draw_log_paths, draw_marks, draw_panel, first_new
from dpa.report.player import PlayerScene
from envs.render import pose_tracks
from envs.scene import Scene

COLUMNS = 4
"""Most panels of a row."""


def plot_likely(players: Sequence[PlayerScene], path: str | Path) -> None:
    """Draw the log of each scene, and after it the most likely rollout of each policy.

    Marked is who first collides or leaves the road there and never does so in the log, of all agents, by the measures
    of the realism metric.

    Args:
        players: scenes with judged rollouts of the same policies, the most likely one among them.
        path: PNG to write.

    Raises:
        ValueError: no scenes, or the path is no PNG.

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
        ...     plot_likely([PlayerScene(scene, {"reference": judged})], Path(folder) / "likely.png")
    """
    if not players:
        raise ValueError("there is no scene to draw; give at least one.")
    panels = 1 + max(len(player.rollouts) for player in players)
    columns = min(panels, COLUMNS)
    rows = -(-panels // columns)
    figure = blank_figure(PANEL * columns + 0.4, (PANEL + 0.35) * rows * len(players) + 0.8)
    grid = figure.add_gridspec(rows * len(players), columns)
    found: list[list[Tensor]] = []
    for number, player in enumerate(players):
        places = [figure.add_subplot(grid[number * rows + each // columns, each % columns]) for each in range(panels)]
        for axes in places[1 + len(player.rollouts) :]:
            axes.set_axis_off()
        found += _draw_scene(places, player.scene, player.rollouts)
    draw_legend(figure, [player.scene for player in players], found)
    save_figure(figure, path)


def _draw_scene(places: Sequence[Axes], scene: Scene, rollouts: Mapping[str, JudgedRollouts]) -> list[list[Tensor]]:
    """The log in the first place, a policy in each that follows; returns of each policy the steps that are marked."""
    driven = pose_tracks(scene)
    logged = mishaps_in_log(scene)
    draw_panel(places[0], scene, driven, f"log of {scene.scene_id}")
    found = []
    for axes, (name, judged) in zip(places[1:], rollouts.items(), strict=False):
        found.append(_draw_likeliest(axes, scene, name, judged, logged))
        draw_log_paths(axes, scene, driven)
    return found


def mishaps_in_log(scene: Scene) -> list[Tensor]:
    """Of each of :data:`~dpa.report.panels.MARKS`, ``[A]`` bool: it happens to the present agent in the log."""
    return [flags[scene.agents.present].any(-1) for flags in logged_mishaps(scene)]


def likeliest(judged: JudgedRollouts, logged: Sequence[Tensor]) -> tuple[int, list[Tensor]]:
    """The row of the most likely rollout, and of each of :data:`~dpa.report.panels.MARKS` its first steps.

    Args:
        judged: rollouts of a policy.
        logged: from :func:`mishaps_in_log`.

    Returns:
        The row, and ``[A]`` int64 each: the first step at which an agent does what it never does in the log; -1: none.
    """
    row = int(judged.likelihood_rank.argmin())
    happens = judged.collides[row], judged.offroad[row]
    return row, [first_new(flags, before) for flags, before in zip(happens, logged, strict=True)]


def _draw_likeliest(
    axes: Axes, scene: Scene, name: str, judged: JudgedRollouts, logged: Sequence[Tensor]
) -> list[Tensor]:
    row, first = likeliest(judged, logged)
    poses, nats, distance = judged.poses[row], float(judged.log_likelihood[row]), float(judged.distance[row])
    draw_panel(axes, scene, pose_tracks(scene, poses), f"{name}\n{nats:.2f} nats per token, distance {distance:.1f}")
    draw_marks(axes, poses, first)
    return first
