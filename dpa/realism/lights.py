"""Driving through red lights, as the 2025 challenge counts it (SPEC section 4.2)."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass

import torch
from torch import Tensor

from dpa.realism.quirks import Quirk
from envs.scene import LightState, MapKind, Scene

_RED = (LightState.ARROW_STOP, LightState.STOP)
_DISTANCES_PER_CHUNK = 1 << 20


@dataclass(frozen=True)
class _Lanes:
    """Segments of the surface streets in map order.

    Attributes:
        start: ``[W, 2]`` [m].
        delta: ``[W, 2]`` [m].
        owner: ``[W]`` int64, ``feature_id`` of the lane.
    """

    start: Tensor
    delta: Tensor
    owner: Tensor


def red_light_violation(scene: Scene, position: Tensor, valid: Tensor, quirks: Set[Quirk] = frozenset(Quirk)) -> Tensor:
    """Steps at which agents pass the stop point of the lane that they are on while its light is red.

    Args:
        scene: an uncollated scene in the frame of the world (:func:`dpa.realism.tracks.to_world`), for its lanes
            and lights.
        position: ``[C, E, L, 2]``, centres at the last L of the 91 steps [m].
        valid: ``[C, E, L]`` bool.
        quirks: of the official code that are kept.

    Returns:
        ``[C, E, L - 1]`` bool, for the steps after the first one.
    """
    violation = torch.zeros_like(valid[..., 1:])
    lanes = _surface_lanes(scene, Quirk.LANES_TO_ORIGIN in quirks)
    if lanes is None:
        return violation
    sign = 1.0 if Quirk.PLUS_FOR_MINUS in quirks else -1.0
    lane_ids, states, stops = _signals(scene, position.shape[2])
    passed, lane = [], []
    for lane_id, state, stop in zip(lane_ids, states, stops, strict=True):
        own = lanes.owner == lane_id
        if own.any():
            red = torch.isin(state, torch.tensor(_RED, device=state.device))[1:]
            if Quirk.ABSENT_STOP_AT_ORIGIN not in quirks:
                red = red & (state != LightState.ABSENT)[:-1]
            passed.append(_passes(position, stop, lanes.start[own], lanes.delta[own], sign) & red & valid[..., 1:])
            lane.append(lane_id)
    if not passed:
        return violation
    # The lane that an agent is on is costly to find and matters only where it passes some red light.
    red_pass = torch.stack(passed, -1)
    where = red_pass.any(-1)
    current = _current_lane(position[..., 1:, :][where], lanes, sign)
    violation[where] = (red_pass[where] & (current[:, None] == torch.stack(lane))).any(-1)
    return violation


def _surface_lanes(scene: Scene, to_origin: bool) -> _Lanes | None:
    """Segments of the lanes; the official code pads each lane to the longest one with zeros.

    Every shorter lane so gains a segment from its last point to the origin of the world.
    """
    road = scene.road
    index = ((road.kind == MapKind.LANE_SURFACE_STREET) & (road.count >= 2)).nonzero()[:, 0]
    if not len(index):
        return None
    world_origin = road.points.new_zeros(1, 2)
    longest = int(road.count[index].max())
    lines = []
    for start, count in zip(road.start[index].tolist(), road.count[index].tolist(), strict=True):
        points = road.points[start : start + count, :2]
        lines.append(torch.cat((points, world_origin)) if to_origin and count < longest else points)
    segments = torch.tensor([len(line) - 1 for line in lines], device=index.device)
    return _Lanes(
        start=torch.cat([line[:-1] for line in lines]),
        delta=torch.cat([line[1:] - line[:-1] for line in lines]),
        owner=road.feature_id[index].repeat_interleave(segments),
    )


def _signals(scene: Scene, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Lanes ``[G]``, states ``[G, L]`` and stop points ``[G, L, 2]`` of the lights at the last L steps."""
    lights = scene.lights
    return lights.lane_id, lights.state[:, -steps:], lights.stop_point[:, -steps:, :2]


def _passes(position: Tensor, stop: Tensor, start: Tensor, delta: Tensor, sign: float) -> Tensor:
    """Agents go from behind the stop point of one lane to beyond it.

    Args:
        position: ``[C, E, L, 2]``.
        stop: ``[L, 2]``, stop point of the lane.
        start: ``[W', 2]``, segments of the lane.
        delta: ``[W', 2]``.
        sign: see :func:`_distance`.

    Returns:
        ``[C, E, L - 1]`` bool.
    """
    segment = _distance(stop, start, delta, sign).argmin(-1)
    start, delta = start[segment], delta[segment]
    at_stop, at_agent = _along(stop, start, delta), _along(position, start, delta)
    return (at_agent < at_stop)[..., :-1] & (at_agent > at_stop)[..., 1:]


def _current_lane(points: Tensor, lanes: _Lanes, sign: float) -> Tensor:
    """``feature_id`` of the lane that each point is on, the first in map order on ties: ``[n, 2]`` -> ``[n]``."""
    rows = max(1, _DISTANCES_PER_CHUNK // len(lanes.start))
    nearest = [_distance(part, lanes.start, lanes.delta, sign).argmin(-1) for part in points.split(rows)]
    return lanes.owner[torch.cat(nearest)]


def _distance(points: Tensor, start: Tensor, delta: Tensor, sign: float) -> Tensor:
    """Distance from points to segments with ``sign=-1``: ``[n, 2]``, ``[W, 2]`` -> ``[n, W]``.

    The official code adds the projection where it should subtract it, which is ``sign=1``.
    """
    points = points[:, None]
    t = _along(points, start, delta).clamp(0, 1)
    return (points - start + sign * t[..., None] * delta).norm(dim=-1)


def _along(points: Tensor, start: Tensor, delta: Tensor) -> Tensor:
    """Position of points along segments, 0 at the start and 1 at the end; 0 for a segment without length."""
    squared = delta.square().sum(-1)
    return torch.where(squared > 0, ((points - start) * delta).sum(-1) / squared, 0)
