"""Why an agent of a rollout is near to its log or far from it: tracks, coupling, and features side by side."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from torch import Tensor

from dpa.ranking import FEATURES, PreferenceDistance, transport_cost
from dpa.ranking.features import feature_names
from dpa.report.canvas import INK, QUIET, RULE, blank_figure, calm, save_figure
from envs.geometry.boxes import box_corners
from envs.render import View, draw_map, frame_view, pose_tracks
from envs.scene import CURRENT_STEP, STEP_SECONDS, AgentKind, Scene

ROLLOUT_COLOR, LOG_COLOR, OTHERS_COLOR = "#d55e00", "#2a2d30", "#9aa0a6"
TIMES = LinearSegmentedColormap.from_list("times", ["#0b2a6f", "#2a78b5", "#56b4e9", "#d9f0d3"])
"""From the first step to the last: dark to light, so that it also reads in grey."""
COSTS = LinearSegmentedColormap.from_list("costs", ["#ffffff", "#c9ced3", "#71777e"]).with_extremes(bad="#f4ead8")
RIM = 4.6
"""Width of a track with its rim [points]."""
MARGIN, SMALLEST_RADIUS = 8.0, 16.0
"""Room around both tracks, and least half side of the window [m]."""
FEATURES_IN_A_ROW = 5
LEAST_RANGE = 0.04
"""Least range of values that a panel shows, as a part of the feature's clip range."""


class AgentCoupling(NamedTuple):
    """One agent of one rollout against its log; T' are the measured steps, D the features.

    ``distance`` and ``time_aligned`` are what :class:`~dpa.ranking.PreferenceDistance` gives the agent, with its own
    coupling and with each step coupled to itself.
    """

    names: tuple[str, ...]
    """Of the D features."""
    seconds: Tensor
    """``[T']`` after the current step [s]."""
    valid: Tensor
    """``[T']`` bool."""
    rollout: Tensor
    """``[T', D]`` features, clipped."""
    log: Tensor
    """``[T', D]``."""
    cost: Tensor
    """``[T', T']`` of a step of the rollout and one of the log; NaN where either is not valid."""
    coupling: Tensor
    """``[T', T']`` mass from a step of the rollout to one of the log, summing to 1."""
    parts: Tensor
    """``[D]`` part of each feature in the distance, summing to it."""
    distance: float
    time_aligned: float


def couple_agent(distance: PreferenceDistance, scene: Scene, trajectory: Tensor, agent: int) -> AgentCoupling:
    """Couple one agent of a rollout with its log, as the distance does.

    Args:
        distance: how rollouts are compared.
        scene: an uncollated scene.
        trajectory: ``[A, T, 4]`` x, y, z, heading at 10 Hz after the current step, of the present agents in order.
        agent: its row among them.

    Raises:
        ValueError: the log has no valid step for the agent, so nothing is coupled.

    Examples:
        >>> from dpa.ranking import log_trajectory
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2, speed=10.0)
        >>> log = log_trajectory(scene, 80)
        >>> slower = log - torch.linspace(0, 20, 80)[:, None] * torch.tensor([1.0, 0, 0, 0])
        >>> coupled = couple_agent(PreferenceDistance(), scene, slower, agent=0)
        >>> coupled.distance, coupled.coupling.shape
        (2.6216, torch.Size([80, 80]))
        >>> dict(zip(coupled.names, coupled.parts.tolist()))["speed"]
        2.4749
    """
    coupled = distance.couple(scene, trajectory[None], torch.tensor([agent]))
    rollout, log, valid, weights = coupled.rollouts[0, 0], coupled.log[0], coupled.valid[0], coupled.weights
    if not valid.any():
        raise ValueError(f"agent {agent} of scene {scene.scene_id} has no valid step in the log; choose another agent.")
    moved, in_step = coupled.moved, transport_cost(rollout, log, valid, valid, weights, method="time_aligned")
    cost = (weights.double() * (rollout[:, None].double() - log.double()) ** 2).sum(-1).sqrt()
    return AgentCoupling(
        names=feature_names(distance.features),
        seconds=distance.stride * STEP_SECONDS * torch.arange(1, len(valid) + 1),
        valid=valid,
        rollout=rollout,
        log=log,
        cost=torch.where(valid[:, None] & valid, cost, torch.nan),
        coupling=moved.coupling[0, 0],
        parts=moved.parts[0, 0],
        distance=float(moved.distance),
        time_aligned=float(in_step.distance),
    )


def plot_coupling(
    scene: Scene, trajectory: Tensor, agent: int, coupled: AgentCoupling, path: str | Path, *, title: str
) -> None:
    """Draw one agent: both tracks, the coupling, what each feature adds, and the features over time (figure 2).

    The colour of a track and of the edges of the matrix is time. In the matrix, grey is the cost of a pair of steps and
    dots are the coupling; a rollout like its log keeps to the diagonal, and steps that the log lacks are sand-coloured.
    In the panels of features, the rollout stands against the logged values that it is coupled with; the lines between
    the two are what it pays for.

    Args:
        scene: an uncollated scene.
        trajectory: ``[A, T, 4]`` of the present agents, see :func:`couple_agent`.
        agent: row of the agent among them.
        coupled: of the same agent, from :func:`couple_agent`.
        path: PNG to write.
        title: which scene, rollout and agent this is.

    Raises:
        ValueError: the path is no PNG.
    """
    rows = math.ceil(len(coupled.names) / FEATURES_IN_A_ROW)
    figure = blank_figure(11.6, 4.7 + 2.1 * rows)
    figure.get_layout_engine().set(w_pad=0.06, h_pad=0.05)
    top, bottom = figure.subfigures(2, 1, height_ratios=[4.7, 2.1 * rows])
    left, middle, right = top.subplots(1, 3, width_ratios=[1.0, 1.17, 0.5])
    _draw_tracks(left, scene, trajectory, agent)
    _draw_coupling(top, middle, coupled)
    _draw_parts(right, coupled)
    _draw_features(bottom, coupled, rows)
    figure.suptitle(title, fontsize=10.5, color=INK)
    save_figure(figure, path)


def agent_name(scene: Scene, agent: int) -> str:
    """What an agent is called in titles and messages.

    Args:
        scene: an uncollated scene.
        agent: row among the present agents.

    Examples:
        >>> from dpa.ranking import log_trajectory
        >>> from envs.sources.synthetic import straight_road
        >>> agent_name(straight_road(2), 1)
        'agent 1 (vehicle, id 2)'
    """
    agents, row = scene.agents, int(scene.agents.present.nonzero()[agent, 0])
    kind = "SDC" if bool(agents.sdc[row]) else AgentKind(int(agents.kind[row])).name.lower()
    return f"agent {agent} ({kind}, id {int(agents.track_id[row])})"


def _draw_tracks(axes: Axes, scene: Scene, trajectory: Tensor, agent: int) -> None:
    """The agent's rollout and log, coloured by time, over the map and the other agents' rollouts."""
    row = int(scene.agents.present.nonzero()[agent, 0])
    last = CURRENT_STEP + trajectory.shape[1]
    log, rollout = (poses[:, CURRENT_STEP : last + 1] for poses in (pose_tracks(scene), pose_tracks(scene, trajectory)))
    window_around(axes, torch.cat((log[row, :, :2], rollout[row, :, :2])))
    draw_map(axes, scene)
    others = torch.arange(len(rollout)) != row
    _draw_others(axes, rollout[others], scene.agents.extent[others])
    _draw_track(axes, log[row], scene.agents.extent[row], LOG_COLOR, zorder=12)
    _draw_track(axes, rollout[row], scene.agents.extent[row], ROLLOUT_COLOR, zorder=13)
    colors = {"log": LOG_COLOR, "rollout": ROLLOUT_COLOR, "others in the rollout": OTHERS_COLOR}
    legend = axes.legend(
        [Line2D([], [], color=color, lw=4) for color in colors.values()], colors.keys(), loc="best", fontsize=8,
        labelcolor=INK, edgecolor="none", framealpha=0.9,
    )  # fmt: skip
    legend.set_zorder(20)
    axes.set_title("tracks, dark to light in time", fontsize=9, color=INK)


def _draw_track(axes: Axes, poses: Tensor, extent: Tensor, color: str, zorder: float) -> None:
    """A track ``[T + 1, 3]`` coloured by time with a rim of one colour, and the agent's box where it ends."""
    seen = torch.isfinite(poses).all(-1)
    points = poses[:, :2].numpy()
    pieces, drawn = np.stack((points[:-1], points[1:]), 1), (seen[1:] & seen[:-1]).numpy()
    times = TIMES(np.linspace(0, 1, len(pieces)))[drawn]
    for width, colors in ((RIM, color), (0.55 * RIM, times)):
        axes.add_collection(
            LineCollection(pieces[drawn], colors=colors, linewidths=width, zorder=zorder, capstyle="round")
        )
    last = poses[seen][-1:]
    box = box_corners(torch.cat((last, extent[:2].expand(len(last), 2)), -1)).numpy()
    axes.add_collection(PolyCollection(box, facecolors="none", edgecolors=color, linewidths=1.5, zorder=zorder + 2))


def _draw_others(axes: Axes, poses: Tensor, extent: Tensor) -> None:
    """Boxes now and paths of agents ``[n, T + 1, 3]``, without the colours of classes: hues tell log from rollout."""
    axes.add_collection(LineCollection(poses[..., :2].numpy(), colors=OTHERS_COLOR, linewidths=0.8, zorder=7))
    there = torch.isfinite(poses[:, 0]).all(-1)
    boxes = box_corners(torch.cat((poses[there, 0], extent[there, :2]), -1)).numpy()
    axes.add_collection(PolyCollection(boxes, facecolors=OTHERS_COLOR, edgecolors="white", linewidths=0.4, zorder=9))


def window_around(axes: Axes, points: Tensor) -> None:
    """Frame the square that holds some points ``[n, 2]`` (NaN is left out), with a bar that gives the scale."""
    points = points[torch.isfinite(points).all(-1)]
    low, high = points.amin(0), points.amax(0)
    radius = max(float((high - low).max()) / 2 + MARGIN, SMALLEST_RADIUS)
    view = View(*((low + high) / 2).tolist(), radius)
    frame_view(axes, view)
    length = 5.0 if radius < 25 else 10.0 if radius < 50 else 20.0
    left = view.x - radius
    below = {"transform": axes.get_xaxis_transform(), "clip_on": False, "color": INK}  # a track may end in any corner
    axes.plot([left, left + length], [-0.03, -0.03], lw=1.8, solid_capstyle="butt", **below)
    axes.text(left + length + 0.03 * radius, -0.03, f"{length:g} m", va="center", fontsize=8, **below)


def _draw_coupling(figure: Figure | SubFigure, axes: Axes, coupled: AgentCoupling) -> None:
    """Cost of every pair of steps in grey, the coupling on it, and time along both edges in the tracks' colours."""
    seconds, step = coupled.seconds.numpy(), float(coupled.seconds[0])
    span = (seconds[0] - step / 2, seconds[-1] + step / 2)
    image = axes.imshow(
        coupled.cost.numpy(), origin="lower", extent=(*span, *span), cmap=COSTS, vmin=0, interpolation="nearest",
        aspect="equal",
    )  # fmt: skip
    axes.plot(span, span, color=QUIET, lw=0.9, ls=(0, (4, 3)), zorder=2)
    rows, columns = np.nonzero(coupled.coupling.numpy())
    mass = coupled.coupling.numpy()[rows, columns]
    size = np.clip(640 / len(seconds), 8, 40) * mass / mass.max()
    axes.scatter(seconds[columns], seconds[rows], s=size, color=ROLLOUT_COLOR, linewidths=0, zorder=3)
    band = 0.035 * (span[1] - span[0])
    times = np.linspace(0, 1, len(seconds))[None]
    axes.imshow(times, extent=(*span, span[0] - band, span[0]), cmap=TIMES, aspect="equal", clip_on=False)
    axes.imshow(times.T, extent=(span[0] - band, span[0], *span), cmap=TIMES, aspect="equal", origin="lower")
    axes.set_xlim(span[0] - band, span[1])
    axes.set_ylim(span[0] - band, span[1])
    axes.set_xlabel("time in the log [s]", fontsize=8.5, color=INK)
    axes.set_ylabel("time in the rollout [s]", fontsize=8.5, color=INK)
    axes.set_title(f"coupling: distance {coupled.distance:.2f}, time-aligned {coupled.time_aligned:.2f}")
    calm(axes, grid="x")
    axes.grid(visible=False)
    bar = figure.colorbar(image, ax=axes, shrink=0.82, aspect=28, pad=0.02)
    bar.set_label("cost of a pair of steps", fontsize=8, color=INK)
    bar.ax.tick_params(labelsize=7.5, colors=INK, color=RULE)
    bar.outline.set_edgecolor(RULE)


def _draw_parts(axes: Axes, coupled: AgentCoupling) -> None:
    """What each feature adds to the distance."""
    parts = coupled.parts.tolist()
    bars = axes.barh([label_of(name) for name in coupled.names], parts, color=ROLLOUT_COLOR, height=0.62)
    total = max(sum(parts), torch.finfo(torch.float32).tiny)
    axes.bar_label(bars, [f"{part:.2f}  ({part / total:.0%})" for part in parts], padding=3, fontsize=7.5, color=INK)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.75 * max(*parts, 0.01))
    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.set_title("parts of the distance")
    calm(axes, grid="x")
    axes.tick_params(axis="y", length=0)


def _draw_features(figure: SubFigure, coupled: AgentCoupling, rows: int) -> None:
    """A panel for each feature: rollout, log, and the logged values that the rollout is coupled with."""
    columns = math.ceil(len(coupled.names) / rows)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    partner = coupled_values(coupled)
    missing = np.where(coupled.valid.numpy(), 0.0, np.nan)
    seconds = coupled.seconds.numpy()
    for k, (axes, name) in enumerate(zip(panels, coupled.names, strict=False)):
        rollout, log = coupled.rollout[:, k].numpy() + missing, coupled.log[:, k].numpy() + missing
        axes.vlines(seconds, rollout, partner[:, k], color=ROLLOUT_COLOR, alpha=0.25, lw=1.3)
        axes.plot(seconds, log, color=LOG_COLOR, lw=1.2, label="log")
        axes.plot(seconds, partner[:, k], color=QUIET, lw=0, marker=".", ms=2.6, label="log, as coupled")
        axes.plot(seconds, rollout, color=ROLLOUT_COLOR, lw=1.4, label="rollout")
        unit = FEATURES[name].unit.replace("^2", "²")
        axes.set_title(label_of(name) if unit == "1" else f"{label_of(name)} [{unit}]")
        _keep_range(axes, FEATURES[name].clip, whole=unit == "1")
        calm(axes, grid="y")
    for axes in panels[len(coupled.names) :]:
        axes.set_axis_off()
    for axes in panels[-columns:]:
        axes.set_xlabel("time [s]", fontsize=8.5, color=INK)
    lines = panels[0].get_lines()
    figure.legend(
        handles=lines, loc="outside lower center", ncols=3, frameon=False, fontsize=8.5, labelcolor=INK, markerscale=3
    )


def coupled_values(coupled: AgentCoupling) -> NDArray[np.float64]:
    """``[T', D]``: features of the log at the steps that each step of the rollout is coupled with, weighed by mass."""
    mass = coupled.coupling.double()
    values = mass @ coupled.log.double() / mass.sum(-1, keepdim=True)
    return torch.where(coupled.valid[:, None], values, torch.nan).numpy()


def _keep_range(axes: Axes, clip: tuple[float, float], *, whole: bool) -> None:
    """Show a flag's whole range, and of others at least a part: differences that cost nothing should look like none."""
    axes.margins(y=0.12)
    low, high = clip if whole else axes.get_ylim()
    room = 0.08 * (high - low) if whole else max(0.0, LEAST_RANGE * (clip[1] - clip[0]) - (high - low)) / 2
    axes.set_ylim(low - room, high + room)


def label_of(name: str) -> str:
    """A feature's name for people."""
    return name.replace("_", " ")
