"""Driving past stop points: which lane an agent is on, and when it goes from behind its stop point to beyond it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_DISTANCES_PER_CHUNK = 1 << 20


@dataclass(frozen=True)
class Lanes:
    """Centre lines of lanes as one flat row of W segments.

    Attributes:
        start: ``[W, 2]`` [m].
        delta: ``[W, 2]`` [m].
        owner: ``[W]`` int64, ``feature_id`` of the lane.
        plus_for_minus: distances add the projection that they should subtract, as the code of the Waymo Open Sim
            Agents Challenge does (realism.md section 4.2).
    """

    start: Tensor
    delta: Tensor
    owner: Tensor
    plus_for_minus: bool = False

    @classmethod
    def from_polylines(
        cls, lines: Sequence[Tensor], owner: Tensor, *, to_origin: bool = False, plus_for_minus: bool = False
    ) -> Lanes | None:
        """Cut centre lines into segments; None where there is no line.

        Args:
            lines: each ``[n, 2]``, two points or more [m].
            owner: ``[len(lines)]`` int64, ``feature_id`` of each.

        Keyword Args:
            to_origin: lanes shorter than the longest one go on to the origin: the code of the challenge pads them with
                zeros (realism.md section 4.2).
            plus_for_minus: see the class.

        Examples:
            >>> Lanes.from_polylines([torch.tensor([[0.0, 0], [5, 0], [9, 0]])], torch.tensor([7])).owner
            tensor([7, 7])
        """
        if not len(lines):
            return None
        longest = max(map(len, lines))
        if to_origin:
            lines = [line if len(line) == longest else torch.cat((line, line.new_zeros(1, 2))) for line in lines]
        segments = torch.tensor([len(line) - 1 for line in lines], device=owner.device)
        return cls(
            start=torch.cat([line[:-1] for line in lines]),
            delta=torch.cat([line[1:] - line[:-1] for line in lines]),
            owner=owner.repeat_interleave(segments),
            plus_for_minus=plus_for_minus,
        )

    def of(self, feature_id: int) -> Lanes:
        """The segments of one lane."""
        own = self.owner == feature_id
        return Lanes(self.start[own], self.delta[own], self.owner[own], self.plus_for_minus)

    def nearest(self, points: Tensor) -> Tensor:
        """``feature_id`` of the lane that each point is on, the first in map order on ties: ``[n, 2]`` -> ``[n]``."""
        rows = max(1, _DISTANCES_PER_CHUNK // len(self.start))
        return self.owner[torch.cat([self.distance(part).argmin(-1) for part in points.split(rows)])]

    def distance(self, points: Tensor) -> Tensor:
        """Distances from points to segments: ``[n, 2]`` -> ``[n, W]`` [m]."""
        points, sign = points[:, None], 1.0 if self.plus_for_minus else -1.0
        t = _along(points, self.start, self.delta).clamp(0, 1)
        return (points - self.start + sign * t[..., None] * self.delta).norm(dim=-1)


def crosses_red(lanes: Lanes, lane_id: Tensor, red: Tensor, stop: Tensor, position: Tensor, valid: Tensor) -> Tensor:
    """Steps at which agents pass the stop point of the lane that they are on while its light is red.

    Args:
        lanes: of the map.
        lane_id: ``[G]`` int64, ``feature_id`` of the lane of each light.
        red: ``[G, L - 1]`` bool, the light is red at the steps after the first one.
        stop: ``[G, L, 2]``, stop points [m].
        position: ``[C, A, L, 2]``, centres [m].
        valid: ``[C, A, L]`` bool.

    Returns:
        ``[C, A, L - 1]`` bool, for the steps after the first one.

    Examples:
        >>> lanes = Lanes.from_polylines([torch.tensor([[0.0, 0], [50, 0]])], torch.tensor([7]))
        >>> position = torch.tensor([[[[8.0, 0], [9, 0], [11, 0], [12, 0]]]])
        >>> red, stop = torch.ones(1, 3, dtype=torch.bool), torch.tensor([[[10.0, 0]] * 4])
        >>> crosses_red(lanes, torch.tensor([7]), red, stop, position, torch.ones(1, 1, 4, dtype=torch.bool))
        tensor([[[False,  True, False]]])
    """
    violation = torch.zeros_like(valid[..., 1:])
    passed, lane = [], []
    for feature_id, its_red, its_stop in zip(lane_id, red, stop, strict=True):
        own = lanes.of(feature_id)
        if len(own.owner):
            passed.append(_passes(position, its_stop, own) & its_red & valid[..., 1:])
            lane.append(feature_id)
    if not passed:
        return violation
    # The lane that an agent is on is costly to find and matters only where it passes some red light.
    red_pass = torch.stack(passed, -1)
    where = red_pass.any(-1)
    if where.any():
        current = lanes.nearest(position[..., 1:, :][where])
        violation[where] = (red_pass[where] & (current[:, None] == torch.stack(lane))).any(-1)
    return violation


def _passes(position: Tensor, stop: Tensor, lane: Lanes) -> Tensor:
    """Agents go from behind the stop point of one lane to beyond it.

    Args:
        position: ``[C, A, L, 2]``.
        stop: ``[L, 2]``, stop point of the lane.
        lane: the segments of that lane.

    Returns:
        ``[C, A, L - 1]`` bool.
    """
    segment = lane.distance(stop).argmin(-1)
    start, delta = lane.start[segment], lane.delta[segment]
    at_stop, at_agent = _along(stop, start, delta), _along(position, start, delta)
    return (at_agent < at_stop)[..., :-1] & (at_agent > at_stop)[..., 1:]


def _along(points: Tensor, start: Tensor, delta: Tensor) -> Tensor:
    """Position of points along segments, 0 at the start and 1 at the end; 0 for a segment without length."""
    squared = delta.square().sum(-1)
    return torch.where(squared > 0, ((points - start) * delta).sum(-1) / squared, 0)
