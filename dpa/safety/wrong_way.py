"""Driving against the direction of a lane."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from dpa.safety.motion import (
    DECISION_SECONDS,
    DECISION_STEPS,
    DRIVING_SPEED,
    LANE_WIDTH,
    NOW,
    Motion,
    lasts,
)
from envs.geometry.edges import RoadEdges
from envs.geometry.frames import wrap_angle
from envs.scene import MapKind, polylines

AGAINST = math.pi / 2
"""Angle between travel and lane from which on a vehicle drives against the lane [rad]."""
WRONG_WAY_SECONDS = 1.0
"""For how long, at least [s]."""
DRIVING_LANES = (MapKind.LANE_UNDEFINED, MapKind.LANE_FREEWAY, MapKind.LANE_SURFACE_STREET)
"""Lanes of cars: cyclists may ride both ways."""


def drives_against(motion: Motion) -> Tensor | None:
    """Controlled vehicles that drive against the nearest lane for :data:`WRONG_WAY_SECONDS`.

    Each 0.5 s of travel counts that is faster than :data:`~dpa.safety.motion.DRIVING_SPEED`, lies within
    :data:`~dpa.safety.motion.LANE_WIDTH` of a lane's centre line, and points away from the direction of the nearest one
    by more than :data:`AGAINST`. Travel is motion and not heading: who reverses drives against the lane as well.

    Returns:
        ``[K, A]`` bool; None for a scene without lanes.
    """
    lines = [line for line in polylines(motion.scene, DRIVING_LANES) if len(line) >= 2]
    if not lines:
        return None
    driver = motion.driver
    knots = motion.poses[:, driver, NOW::DECISION_STEPS]
    there = motion.valid[driver, NOW::DECISION_STEPS]
    travel = knots[..., 1:, :2] - knots[..., :-1, :2]
    driving = travel.norm(dim=-1) > DRIVING_SPEED * DECISION_SECONDS
    driving &= there[:, 1:] & there[:, :-1]
    place = (knots[..., 1:, :3] + knots[..., :-1, :3]) / 2
    place[..., 2] -= motion.extent[driver, 2, None] / 2
    distance, direction = RoadEdges.from_polylines(lines).nearest(place[driving])
    x, y = travel[driving].unbind(-1)
    turn = wrap_angle(torch.atan2(y, x) - direction).abs()
    against = torch.zeros_like(driving)
    against[driving] = (turn > AGAINST) & (distance <= LANE_WIDTH)
    found = motion.controlled.new_zeros(motion.poses.shape[:2])
    found[:, driver] = lasts(against, round(WRONG_WAY_SECONDS / DECISION_SECONDS))
    return found


def wrong_way(motion: Motion) -> Tensor | None:
    """:func:`drives_against`, without the agents whose log does so too: maps err, and some logs reverse.

    Returns:
        ``[K, A]`` bool; None for a scene without lanes.
    """
    together = replace(motion, poses=torch.cat((motion.poses, motion.log.poses)))
    found = drives_against(together)
    return None if found is None else found[:-1] & ~found[-1]
