"""Two agents in one place, one shortly after the other."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dpa.safety.motion import NOW, Motion
from envs.geometry.boxes import signed_box_distance
from envs.geometry.frames import wrap_angle

LAGS = (3, 6, 9)
"""Times between two visits of a place that are looked at [0.1 s]: all below 1 s."""
STRIDE = 2
"""Footprints are taken every so many steps of 0.1 s."""
CROSSING = math.radians(30)
"""Headings that differ by less follow or overtake each other (FHWA-HRT-08-051 draws the same line) [rad]."""
MOVED = 1.0
"""An agent that moves less stands: what passes over its place without hitting it does not exist [m]."""


def close_pass(motion: Motion) -> Tensor:
    """Controlled agents in a pair whose post-encroachment time is below 1 s.

    The footprint (box) of one agent overlaps the footprint that the other one has 0.3, 0.6 or 0.9 s before or after,
    while their headings differ by more than :data:`CROSSING`: they cross, merge or meet, and do not follow. A pair whose
    footprints overlap at one and the same time collides and is not counted here, nor is one without a vehicle.

    The time between the visits of a crossing place grows from the post-encroachment time by the time that the two need
    to clear it, which at any ordinary speed is longer than the gaps between these lags.

    Returns:
        ``[K, A]`` bool.
    """
    boxes, there = _footprints(motion)
    rollout, one, other = _near_pairs(motion, boxes, there)
    near = torch.zeros_like(rollout, dtype=torch.bool)
    collides = _visits(boxes, there, rollout, one, other, 0)
    for lag in LAGS:
        near |= _visits(boxes, there, rollout, one, other, lag)
        near |= _visits(boxes, there, rollout, other, one, lag)
    near &= ~collides
    found = motion.controlled.new_zeros(motion.poses.shape[:2])
    found[rollout[near], one[near]] = True
    found[rollout[near], other[near]] = True
    return found & motion.controlled


def _footprints(motion: Motion) -> tuple[Tensor, Tensor]:
    """Boxes ``[K, A, T + 1, 5]`` from the current step on, and whether they are there ``[A, T + 1]``."""
    poses = motion.poses[:, :, NOW:]
    size = motion.extent[:, None, :2].expand(*poses.shape[:-1], 2)
    return torch.cat((poses[..., [0, 1, 3]], size), -1), motion.valid[:, NOW:]


def _near_pairs(motion: Motion, boxes: Tensor, there: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rollout and agents, each ``[P]`` int64, of the pairs whose ways overlap: one is controlled, one is a vehicle."""
    xy, gone = boxes[..., :2], ~there[..., None]
    low, high = xy.masked_fill(gone, torch.inf).amin(2), xy.masked_fill(gone, -torch.inf).amax(2)
    moves = (high - low).norm(dim=-1) > MOVED
    reach = (motion.extent[:, :2].norm(dim=-1) / 2)[:, None]
    low, high = low - reach, high + reach
    meet = ((low[:, :, None] <= high[:, None]) & (low[:, None] <= high[:, :, None])).all(-1)
    meet &= moves[:, :, None] & moves[:, None]
    for quality in (motion.controlled, motion.vehicle):
        meet &= quality[:, None] | quality
    return meet.triu(1).nonzero().unbind(-1)


def _visits(boxes: Tensor, there: Tensor, rollout: Tensor, first: Tensor, second: Tensor, lag: int) -> Tensor:
    """Pairs of which the second is, some steps later, where the first was.

    Args:
        boxes: ``[K, A, T + 1, 5]``.
        there: ``[A, T + 1]`` bool.
        rollout: ``[P]`` int64.
        first: ``[P]`` int64.
        second: ``[P]`` int64.
        lag: steps of 0.1 s; 0 asks for a collision, at any angle.

    Returns:
        ``[P]`` bool.
    """
    early, late = slice(0, boxes.shape[2] - lag, STRIDE), slice(lag, None, STRIDE)
    xy, heading, reach = boxes[..., :2], boxes[..., 2], boxes[0, :, 0, 3:].norm(dim=-1) / 2
    gap = xy[rollout, first, early] - xy[rollout, second, late]
    close = gap.square().sum(-1) < (reach[first] + reach[second]).square()[:, None]
    close &= there[first, early] & there[second, late]
    pair, step = close.nonzero().unbind(-1)
    step = step * STRIDE
    if lag:
        turn = heading[rollout[pair], first[pair], step] - heading[rollout[pair], second[pair], step + lag]
        crossing = wrap_angle(turn).abs() > CROSSING
        pair, step = pair[crossing], step[crossing]
    was, comes = boxes[rollout[pair], first[pair], step], boxes[rollout[pair], second[pair], step + lag]
    found = torch.zeros_like(rollout, dtype=torch.bool)
    found[pair[signed_box_distance(was, comes, rounding=0.0) < 0]] = True
    return found
