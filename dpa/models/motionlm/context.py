"""What MotionLM sees of a scene: map pieces and lights, and its agents' histories, each in a frame of its own.

Long polylines are cut into pieces of about ten metres. A piece, a light or an agent is a pose plus features measured
from that pose, so nothing here depends on where the scene lies or how it is turned (but for which of the farthest
pieces are seen, where there are more than ``max_pieces``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorClass
from torch import Tensor

from envs.episode import HISTORY, Episode
from envs.geometry.frames import rotate, wrap_angle
from envs.scene import CURRENT_STEP, LOG_STEPS, STEP_SECONDS, Agents, Lights, LightState, RoadMap, Scene

PIECE_POINTS = 5
"""Points that describe a piece."""
POSITION_SCALE = 10.0
"""Metres that count as one in a feature."""
REACH_GRID = 4.0
"""Places nearer to each other than this count as one in the choice of map pieces [m]."""
NUM_LIGHT_STATES = len(LightState)


@dataclass(frozen=True)
class ContextOptions:
    """How a scene is cut up for MotionLM.

    Attributes:
        max_pieces: map pieces kept, those nearest to where any present agent is or may soon be.
        piece_length: target length of a map piece [m].

    Raises:
        ValueError: a number that is not positive.
    """

    max_pieces: int = 512
    piece_length: float = 12.0

    def __post_init__(self) -> None:
        for name in ("max_pieces", "piece_length"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}.")


class SceneContext(TensorClass["nocast"]):
    """Inputs of MotionLM for one scene, or for a padded batch of them (``*`` is nothing or ``S``).

    Attributes:
        episode: its agents.
        map_pose: ``[*, P, 3]`` middle of a piece, heading along it.
        map_points: ``[*, P, PIECE_POINTS, 2]`` in the frame of the piece [m].
        map_kind: ``[*, P]`` :class:`~envs.scene.MapKind`.
        map_light: ``[*, P]`` light state of the piece's lane at the current step, plus one (0: none).
        map_valid: ``[*, P]`` bool.
        light_pose: ``[*, G, 3]`` stop point, heading of the lane.
        light_state: ``[*, G, HISTORY]`` :class:`~envs.scene.LightState` plus one.
        light_valid: ``[*, G]`` bool.
    """

    of_agents: ClassVar[tuple[str, ...]] = ()
    episode: Episode
    map_pose: Tensor
    map_points: Tensor
    map_kind: Tensor
    map_light: Tensor
    map_valid: Tensor
    light_pose: Tensor
    light_state: Tensor
    light_valid: Tensor


def featurize(scene: Scene, episode: Episode, options: ContextOptions | None = None) -> SceneContext:
    """Cut up one uncollated scene.

    Examples:
        >>> from envs.episode import make_episode
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> featurize(scene, make_episode(scene)).map_points.shape[1:]
        torch.Size([5, 2])
    """
    options = options or ContextOptions()
    places = _reach(scene.agents, episode.logged.shape[-2])
    map_pose, map_points, map_kind, map_light = _map_pieces(scene.road, scene.lights, places, options)
    return SceneContext(
        episode=episode,
        map_pose=map_pose,
        map_points=map_points,
        map_kind=map_kind,
        map_light=map_light,
        map_valid=torch.ones(len(map_kind), dtype=torch.bool),
        light_pose=_light_poses(scene.road, scene.lights),
        light_state=scene.lights.state[:, :HISTORY] + 1,
        light_valid=scene.lights.state[:, CURRENT_STEP] != LightState.ABSENT,
        batch_size=[],
    )


def _reach(agents: Agents, steps: int) -> Tensor:
    """``[n, 2]``: where present agents are, and would be each second of the episode at constant velocity."""
    seconds = torch.arange(0.0, steps * STEP_SECONDS + 0.5)
    ahead = agents.velocity[agents.present, CURRENT_STEP, None] * seconds[:, None]
    places = (agents.position[agents.present, CURRENT_STEP, None, :2] + ahead).flatten(0, 1)
    return torch.unique((places / REACH_GRID).round(), dim=0) * REACH_GRID  # the standing ones count once


def _map_pieces(
    road: RoadMap, lights: Lights, places: Tensor, options: ContextOptions
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Poses, points, kinds and lights of the pieces nearest to some places (``[n, 2]``)."""
    owner, start, end = _cut(road, options.piece_length)
    points = _resample(road.points[:, :2], start, end)
    middle = points[:, PIECE_POINTS // 2]
    near = torch.cdist(middle, places).amin(1).argsort(stable=True)[: options.max_pieces]
    near = near.sort().values  # map order, so that equal scenes give equal tensors
    points, middle, owner = points[near], middle[near], owner[near]
    chord = points[:, -1] - points[:, 0]
    heading = torch.atan2(chord[:, 1], chord[:, 0])
    local = rotate(points - middle[:, None], -heading[:, None])
    state = torch.zeros(len(road.kind), dtype=torch.int64)
    for lane, now in zip(lights.lane_id.tolist(), lights.state[:, CURRENT_STEP].tolist(), strict=True):
        state[road.feature_id == lane] = now + 1
    return torch.cat((middle, heading[:, None]), -1), local, road.kind[owner], state[owner]


def _cut(road: RoadMap, length: float) -> tuple[Tensor, Tensor, Tensor]:
    """Cut polylines into runs of points: owner, first and last point of each run, all ``[pieces]``."""
    step = (road.points[1:, :2] - road.points[:-1, :2]).norm(dim=-1)
    arc = torch.cat((step.new_zeros(1), step.double().cumsum(0)))
    first = road.start.clamp(max=len(arc) - 1)  # features without points may come last
    last = first + (road.count - 1).clamp(min=0)
    total = arc[last] - arc[first]
    pieces = (total / length).ceil().clamp(min=1).long() * (road.count > 0)
    owner = torch.repeat_interleave(torch.arange(len(pieces)), pieces)
    number = torch.arange(len(owner)) - torch.repeat_interleave(pieces.cumsum(0) - pieces, pieces)
    share = total[owner] / pieces[owner].clamp(min=1)
    cut = torch.searchsorted(arc, arc[first][owner] + share * number).clamp(first[owner], last[owner])
    following = torch.cat((cut[1:], cut[:1]))
    ends_line = torch.cat((owner[1:] != owner[:-1], torch.ones(min(1, len(owner)), dtype=torch.bool)))
    return owner, cut, torch.where(ends_line, last[owner], following)


def _resample(points: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """``[pieces, PIECE_POINTS, 2]``: points at equal shares of the indices of each run."""
    share = torch.linspace(0, 1, PIECE_POINTS)
    at = start[:, None] + (end - start)[:, None] * share
    low = at.floor().long()
    high = torch.minimum(low + 1, end[:, None])
    return torch.lerp(points[low], points[high], (at - low)[..., None].to(points.dtype))


def _light_poses(road: RoadMap, lights: Lights) -> Tensor:
    """``[G, 3]``: stop points, headed along the lane at its nearest point; 0 heading for a lane that the map lacks."""
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
    return poses


def _lane_headings(road: RoadMap, owner: Tensor, places: Tensor) -> Tensor:
    """``[n]``: heading of each place's polyline, ``owner``, which has two points or more, at its nearest point."""
    first, last = road.start[owner], road.count[owner] - 1
    along = torch.arange(int(last.max()) + 1)
    points = road.points[(first[:, None] + along.minimum(last[:, None])), :2]
    nearest = (points - places[:, None]).norm(dim=-1).masked_fill(along > last[:, None], torch.inf).argmin(-1)
    rows = torch.arange(len(owner))
    ahead = points[rows, (nearest + 1).minimum(last)] - points[rows, (nearest - 1).clamp(min=0)]
    return wrap_angle(torch.atan2(ahead[:, 1], ahead[:, 0]))
