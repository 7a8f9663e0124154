"""A map as policies read it: polylines cut into pieces, each with a pose, and the lights with theirs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from envs.episode import HISTORY
from envs.geometry.frames import rotate, wrap_angle
from envs.scene import CURRENT_STEP, LANE_KINDS, LOG_STEPS, STEP_SECONDS, Agents, Lights, LightState, RoadMap, Scene

GRID = 4.0
"""Places nearer to each other than this count as one in the choice of pieces [m]."""
NUM_LIGHT_STATES = len(LightState)
"""Of a piece or a light: states plus one, 0 for none."""
ROUNDING = 1e-3
"""Of a piece: by so much a line may be too long without a further piece, wherever a scene lies."""


@dataclass(frozen=True)
class PieceOptions:
    """How a map is cut up.

    Attributes:
        max_pieces: pieces kept, those nearest to where any present agent is or may soon be.
        piece_length: target length of a piece [m].

    Raises:
        ValueError: a number that is not positive.
    """

    max_pieces: int
    piece_length: float

    def __post_init__(self) -> None:
        for name in ("max_pieces", "piece_length"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}.")


class Pieces(NamedTuple):
    """Runs of the polylines of one scene, in the order of the map.

    Attributes:
        pose: ``[P, 3]`` middle of a piece, heading along it.
        points: ``[P, n, 2]`` in the frame of the piece [m].
        kind: ``[P]`` :class:`~envs.scene.MapKind`.
        light: ``[P]`` light state of the piece's lane at the current step, plus one (0: none).
        valid: ``[P]`` bool, all of them.
    """

    pose: Tensor
    points: Tensor
    kind: Tensor
    light: Tensor
    valid: Tensor


def _places_ahead(agents: Agents, steps: int) -> Tensor:
    """``[n, 2]``: where present agents are, and would be each second of an episode at constant velocity.

    Args:
        agents: of one uncollated scene.
        steps: of 0.1 s, of the episode.
    """
    seconds = torch.arange(0.0, steps * STEP_SECONDS + 0.5)
    ahead = agents.velocity[agents.present, CURRENT_STEP, None] * seconds[:, None]
    places = (agents.position[agents.present, CURRENT_STEP, None, :2] + ahead).flatten(0, 1)
    return torch.unique((places / GRID).round(), dim=0) * GRID  # the standing ones count once


def cut_map(scene: Scene, steps: int, options: PieceOptions, num_points: int, *, evenly: bool = False) -> Pieces:
    """Cut the map of one uncollated scene into pieces and keep those nearest to where its agents may be.

    Args:
        scene: as it was recorded.
        steps: of 0.1 s, of the episode.
        options: length and number of pieces.
        num_points: that describe a piece, odd.

    Keyword Args:
        evenly: pieces of a line are equally long, their points too, wherever points of the line lie; otherwise they
            are runs of its points, which short pieces would often have but one of.
    """
    road, lights, places = scene.road, scene.lights, _places_ahead(scene.agents, steps)
    owner, points = (_even if evenly else _runs)(road, options.piece_length, num_points)
    middle = points[:, num_points // 2]
    near = torch.cdist(middle, places).amin(1).argsort(stable=True)[: options.max_pieces]
    near = near.sort().values  # map order, so that equal scenes give equal tensors
    points, middle, owner = points[near], middle[near], owner[near]
    chord = points[:, -1] - points[:, 0]
    heading = torch.atan2(chord[:, 1], chord[:, 0])
    lone = road.count[owner] == 1  # stop signs
    heading[lone] = headings_of_nearest_lanes(road, middle[lone])
    local = rotate(points - middle[:, None], -heading[:, None])
    state = torch.zeros(len(road.kind), dtype=torch.int64)
    for lane, now in zip(lights.lane_id.tolist(), lights.state[:, CURRENT_STEP].tolist(), strict=True):
        state[road.feature_id == lane] = now + 1
    pose = torch.cat((middle, heading[:, None]), -1)
    return Pieces(pose, local, road.kind[owner], state[owner], torch.ones(len(owner), dtype=torch.bool))


class _Cut(NamedTuple):
    """Polylines cut into pieces, all ``[pieces]``.

    Attributes:
        owner: the polyline.
        first: its first point.
        last: its last point.
        number: of a piece along it.
        count: pieces of it.
    """

    owner: Tensor
    first: Tensor
    last: Tensor
    number: Tensor
    count: Tensor


def _cut(road: RoadMap, length: float, rounding: float = 0.0) -> tuple[_Cut, Tensor]:
    """Pieces of about a length, and how far along all lines together each point lies ``[points]``."""
    step = (road.points[1:, :2] - road.points[:-1, :2]).norm(dim=-1)
    arc = torch.cat((step.new_zeros(1), step.double().cumsum(0)))
    first = road.start.clamp(max=len(arc) - 1)  # features without points may come last
    last = first + (road.count - 1).clamp(min=0)
    pieces = ((arc[last] - arc[first]) / length - rounding).ceil().clamp(min=1).long() * (road.count > 0)
    owner = torch.repeat_interleave(torch.arange(len(pieces)), pieces)
    number = torch.arange(len(owner)) - torch.repeat_interleave(pieces.cumsum(0) - pieces, pieces)
    return _Cut(owner, first[owner], last[owner], number, pieces[owner]), arc


def _runs(road: RoadMap, length: float, num: int) -> tuple[Tensor, Tensor]:
    """Runs of points: owner ``[pieces]``, and ``[pieces, num, 2]`` points at equal shares of the indices of each."""
    cut, arc = _cut(road, length)
    share = (arc[cut.last] - arc[cut.first]) / cut.count.clamp(min=1)
    start = torch.searchsorted(arc, arc[cut.first] + share * cut.number).clamp(cut.first, cut.last)
    following = torch.cat((start[1:], start[:1]))
    end = torch.where(cut.number == cut.count - 1, cut.last, following)
    at = start[:, None] + (end - start)[:, None] * torch.linspace(0, 1, num)
    low = at.floor().long()
    high = torch.minimum(low + 1, end[:, None])
    points = road.points[:, :2]
    return cut.owner, torch.lerp(points[low], points[high], (at - low)[..., None].to(points.dtype))


def _even(road: RoadMap, length: float, num: int) -> tuple[Tensor, Tensor]:
    """Equal parts: owner ``[pieces]``, and ``[pieces, num, 2]`` points at equal distances along the line."""
    cut, arc = _cut(road, length, ROUNDING)
    first, last = cut.first[:, None], cut.last[:, None]
    share = (cut.number[:, None] + torch.linspace(0, 1, num, dtype=arc.dtype)) / cut.count[:, None]
    at = arc[first] + share * (arc[last] - arc[first])
    low = (torch.searchsorted(arc, at, right=True) - 1).minimum(last - 1).maximum(first)
    high = (low + 1).minimum(last)
    within = ((at - arc[low]) / (arc[high] - arc[low]).clamp(min=1e-9)).clamp(0, 1)
    points = road.points[:, :2]
    return cut.owner, torch.lerp(points[low], points[high], within[..., None].to(points.dtype))


def light_poses(road: RoadMap, lights: Lights) -> Tensor:
    """``[G, 3]``: stop points, headed along their lane at its nearest point, or along the nearest lane."""
    poses = torch.zeros(len(lights.lane_id), 3)
    if not len(poses):
        return poses
    listed = lights.state[:, :HISTORY] != LightState.ABSENT
    latest = torch.where(listed.any(-1), HISTORY - 1 - listed.flip(-1).int().argmax(-1), LOG_STEPS - 1)
    poses[:, :2] = lights.stop_point[torch.arange(len(poses)), latest, :2]
    lane = (road.feature_id == lights.lane_id[:, None]) & (road.count > 1)
    known = lane.any(-1)
    if known.any():
        owner = lane[known].int().argmax(-1)
        poses[known, 2] = _lane_headings(road, owner, poses[known, :2])
    poses[~known, 2] = headings_of_nearest_lanes(road, poses[~known, :2])
    return poses


def headings_of_nearest_lanes(road: RoadMap, places: Tensor) -> Tensor:
    """``[n]``: what has a place ``[n, 2]`` but no direction is headed along the nearest lane; 0 without lanes.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> headings_of_nearest_lanes(straight_road(2).road, torch.tensor([[10.0, 4.0]])).sin().abs() < 1e-6
        tensor([True])
    """
    if not len(places):
        return places.new_zeros(0)
    owner = torch.repeat_interleave(torch.arange(len(road.count)), road.count)
    lane = torch.isin(road.kind, torch.tensor(LANE_KINDS)) & (road.count > 1)
    points = lane[owner].nonzero()[:, 0]
    if not len(points):
        return places.new_zeros(len(places))
    nearest = torch.cdist(places, road.points[points, :2]).argmin(1)
    return _lane_headings(road, owner[points[nearest]], places)


def _lane_headings(road: RoadMap, owner: Tensor, places: Tensor) -> Tensor:
    """``[n]``: heading of each place's polyline, ``owner``, which has two points or more, at its nearest point."""
    first, last = road.start[owner], road.count[owner] - 1
    along = torch.arange(int(last.max()) + 1)
    points = road.points[(first[:, None] + along.minimum(last[:, None])), :2]
    nearest = (points - places[:, None]).norm(dim=-1).masked_fill(along > last[:, None], torch.inf).argmin(-1)
    rows = torch.arange(len(owner))
    ahead = points[rows, (nearest + 1).minimum(last)] - points[rows, (nearest - 1).clamp(min=0)]
    return wrap_angle(torch.atan2(ahead[:, 1], ahead[:, 0]))
