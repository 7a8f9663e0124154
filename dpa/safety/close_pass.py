"""Two agents in one place, one shortly after the other."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dpa.safety.motion import NOW, Motion
from envs.geometry.boxes import signed_box_distance
from envs.geometry.frames import wrap_angle

LAGS = (10, 7, 4)
"""Times between two visits of a place that are looked at, the longest first: it finds most pairs [0.1 s]."""
STRIDE = 2
"""Footprints are taken every so many steps of 0.1 s."""
CROSSING = math.radians(30)
"""Headings that differ by less follow or overtake each other (FHWA-HRT-08-051 draws the same line) [rad]."""
MOVED = 1.0
"""An agent that moves less stands: what passes over its place without hitting it does not exist [m]."""


def close_pass(motion: Motion) -> Tensor:
    """Controlled agents in a pair whose post-encroachment time is below 1 s.

    The footprint (box) of one agent overlaps the footprint that the other one has 0.4, 0.7 or 1 s before or after,
    while their headings differ by more than :data:`CROSSING`: they cross, merge or meet, and do not follow. A pair
    whose footprints overlap at one and the same time collides and is not counted here, nor is one without a vehicle.

    Footprints that overlap 1 s apart leave less than 1 s between one agent's leaving and the other's coming. The
    reverse holds up to the grid: at speeds up to 20 m/s every time below 0.8 s is found, and from there on most are.

    Returns:
        ``[K, A]`` bool.
    """
    boxes, there = _footprints(motion)
    pairs = _near_pairs(motion, boxes, there)
    near = []
    for lag in LAGS:
        for ahead in (0, 1):
            visits = _visits(boxes, there, pairs[[0, 1 + ahead, 2 - ahead]], lag)
            near.append(pairs[:, visits])
            pairs = pairs[:, ~visits]
    near = torch.cat(near, 1)
    rollout, one, other = near[:, ~_visits(boxes, there, near, 0)]
    found = motion.controlled.new_zeros(motion.poses.shape[:2])
    found[rollout, one] = True
    found[rollout, other] = True
    return found & motion.controlled


def _footprints(motion: Motion) -> tuple[Tensor, Tensor]:
    """Boxes ``[K, A, T + 1, 5]`` from the current step on, and whether they are there ``[A, T + 1]``."""
    poses = motion.poses[:, :, NOW:]
    size = motion.extent[:, None, :2].expand(*poses.shape[:-1], 2)
    return torch.cat((poses[..., [0, 1, 3]], size), -1), motion.valid[:, NOW:]


def _near_pairs(motion: Motion, boxes: Tensor, there: Tensor) -> Tensor:
    """Rollout and two agents, ``[3, P]`` int64, where ways overlap, one is controlled and one is a vehicle."""
    xy, gone = boxes[..., :2], ~there[..., None]
    low, high = xy.masked_fill(gone, torch.inf).amin(2), xy.masked_fill(gone, -torch.inf).amax(2)
    moves = (high - low).norm(dim=-1) > MOVED
    reach = (motion.extent[:, :2].norm(dim=-1) / 2)[:, None]
    low, high = low - reach, high + reach
    meet = ((low[:, :, None] <= high[:, None]) & (low[:, None] <= high[:, :, None])).all(-1)
    meet &= moves[:, :, None] & moves[:, None]
    for quality in (motion.controlled, motion.vehicle):
        meet &= quality[:, None] | quality
    return meet.triu(1).nonzero().T


def _visits(boxes: Tensor, there: Tensor, pairs: Tensor, lag: int) -> Tensor:
    """Pairs of which the second is, some steps later, where the first was.

    Args:
        boxes: ``[K, A, T + 1, 5]``.
        there: ``[A, T + 1]`` bool.
        pairs: ``[3, P]`` int64, rollout, first, second.
        lag: steps of 0.1 s; 0 asks for a collision, at any angle.

    Returns:
        ``[P]`` bool.
    """
    rollout, first, second = pairs
    row, later = rollout * boxes.shape[1] + first, rollout * boxes.shape[1] + second
    early, late = slice(0, max(0, boxes.shape[2] - lag), STRIDE), slice(lag, None, STRIDE)
    reach = boxes[0, :, 0, 3:].norm(dim=-1) / 2
    squared = 0
    for axis in (0, 1):
        place = boxes[..., axis].flatten(0, 1)
        gap = place[:, early].index_select(0, row) - place[:, late].index_select(0, later)
        squared = gap.square_().add_(squared)
    close = squared < (reach[first] + reach[second]).square()[:, None]
    pair, step = close.nonzero().T
    step = step * STRIDE
    here = there[first[pair], step] & there[second[pair], step + lag]
    pair, step = pair[here], step[here]
    was, comes = (boxes.flatten(0, 1)[who[pair], at] for who, at in ((row, step), (later, step + lag)))
    if lag:
        crossing = wrap_angle(was[:, 2] - comes[:, 2]).abs() > CROSSING
        pair, was, comes = pair[crossing], was[crossing], comes[crossing]
    found = torch.zeros_like(rollout, dtype=torch.bool)
    found[pair[signed_box_distance(was, comes, rounding=0.0) < 0]] = True
    return found
