"""Crossing a stop line while the light is red."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from dpa.safety.motion import DRIVING_SPEED, LANE_WIDTH, NOW, Motion
from envs.scene import LANE_KINDS, RED_STATES, STEP_SECONDS, LightState, Scene

ALONG_LANE = math.cos(math.pi / 4)
"""Cosine of the largest angle between a vehicle and the lane whose light it obeys."""


class StopLine(NamedTuple):
    """Of one light.

    Attributes:
        point: ``[L, 2]``, its middle [m].
        along: ``[L, 2]``, unit vector along the lane.
        listed: ``[L]`` bool, the light has a state.
        red: ``[L]`` bool.
    """

    point: Tensor
    along: Tensor
    listed: Tensor
    red: Tensor


def red_light(motion: Motion) -> Tensor | None:
    """Controlled vehicles that cross a stop line at red.

    The stop line is :data:`~dpa.safety.motion.LANE_WIDTH` wide and square to the lane; the stop point is its middle. A
    vehicle crosses it in the step in which the middle of its front bumper gets from before it to it or beyond, faster
    than :data:`~dpa.safety.motion.DRIVING_SPEED` and within 45 degrees of the lane. Where lanes that part behind one
    stop point have different lights, the vehicle may have taken the free one, and nothing is counted.

    Returns:
        ``[K, A]`` bool; None for a scene in which no light rules a lane.
    """
    lines = stop_lines(motion.scene)
    if not lines:
        return None
    driver = motion.driver
    poses, there = motion.poses[:, driver, NOW:], motion.valid[driver, NOW:]
    heading = torch.stack((poses[..., 3].cos(), poses[..., 3].sin()), -1)
    front = poses[..., :2] + heading * (motion.extent[driver, 0] / 2)[:, None, None]
    moves = (front[..., 1:, :] - front[..., :-1, :]).norm(dim=-1) > DRIVING_SPEED * STEP_SECONDS
    moves &= there[:, 1:] & there[:, :-1]
    at_red, at_other = torch.zeros_like(moves), torch.zeros_like(moves)
    # Few ways lead past a given light: most are told apart by the box around them.
    low, high = front.amin(2) - LANE_WIDTH / 2, front.amax(2) + LANE_WIDTH / 2
    steps = slice(NOW + 1, NOW + 1 + moves.shape[-1])
    for point, along, listed, red in (StopLine(*(value[steps] for value in line)) for line in lines):
        if not listed.any():
            continue
        near = ((low <= point[listed].amax(0)) & (high >= point[listed].amin(0))).all(-1)
        crossed = _crosses(front[near], heading[near], point, along) & moves[near] & listed
        at_red[near] |= crossed & red
        at_other[near] |= crossed & ~red
    found = motion.controlled.new_zeros(motion.poses.shape[:2])
    found[:, driver] = (at_red & ~at_other).any(-1)
    return found


def stop_lines(scene: Scene) -> list[StopLine]:
    """Stop lines of the lights whose lane is on the map."""
    lights, road, lines = scene.lights, scene.road, []
    is_lane = torch.isin(road.kind, torch.tensor(LANE_KINDS)) & (road.count >= 2)
    for lane_id, state, stop in zip(lights.lane_id, lights.state, lights.stop_point[..., :2], strict=True):
        lane = (is_lane & (road.feature_id == lane_id)).nonzero()[:, 0]
        if len(lane):
            first, count = int(road.start[lane[0]]), int(road.count[lane[0]])
            along = _direction(road.points[first : first + count, :2], stop)
            red = torch.isin(state, torch.tensor(RED_STATES))
            lines.append(StopLine(stop, along, state != LightState.ABSENT, red))
    return lines


def _crosses(front: Tensor, heading: Tensor, point: Tensor, along: Tensor) -> Tensor:
    """Steps that end beyond a stop line and began before it.

    Args:
        front: ``[n, T + 1, 2]`` [m].
        heading: ``[n, T + 1, 2]``, unit vectors.
        point: ``[T, 2]``, middle of the line [m].
        along: ``[T, 2]``, unit vectors.

    Returns:
        ``[n, T]`` bool.
    """
    before, after = front[..., :-1, :] - point, front[..., 1:, :] - point
    ahead_before, ahead_after = (before * along).sum(-1), (after * along).sum(-1)
    passes = (ahead_before < 0) & (ahead_after >= 0)
    share = ahead_before / (ahead_before - ahead_after).clamp(max=-1e-9)
    place = torch.lerp(before, after, share[..., None])
    aside = (place[..., 0] * along[..., 1] - place[..., 1] * along[..., 0]).abs()
    return passes & (aside <= LANE_WIDTH / 2) & ((heading[..., 1:, :] * along).sum(-1) >= ALONG_LANE)


def _direction(line: Tensor, points: Tensor) -> Tensor:
    """Direction of a polyline where it is nearest to points: ``[n, 2]``, ``[L, 2]`` -> ``[L, 2]`` unit vectors."""
    start, delta = line[:-1], line[1:] - line[:-1]
    length = delta.norm(dim=-1)
    start, delta, length = start[length > 0], delta[length > 0], length[length > 0]
    offset = points[:, None] - start
    t = ((offset * delta).sum(-1) / length.square()).clamp(0, 1)
    nearest = (offset - t[..., None] * delta).norm(dim=-1).argmin(-1)
    return (delta / length[:, None])[nearest]
