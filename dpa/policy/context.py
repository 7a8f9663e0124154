"""What the policy sees of a scene: map pieces, lights and histories, each in a frame of its own.

Long polylines are cut into pieces of about ten metres. A piece, a light or an agent is a pose plus features measured
from that pose, so nothing here depends on where the scene lies or how it is turned (but for which of the farthest
pieces are seen, where there are more than ``max_pieces``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from tensordict import TensorClass
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from envs.geometry.frames import rotate, to_local, wrap_angle
from envs.participants import MAX_CONTROLLED, Control, check_control, choose_controlled, simulated_agents
from envs.scene import CURRENT_STEP, LOG_STEPS, STEP_SECONDS, Agents, Lights, LightState, RoadMap, Scene, check_episode

PIECE_POINTS = 5
"""Points that describe a piece."""
HISTORY = CURRENT_STEP + 1
POSITION_SCALE = 10.0
"""Metres that count as one in a feature."""
REACH_GRID = 4.0
"""Places nearer to each other than this count as one in the choice of map pieces [m]."""
NUM_LIGHT_STATES = len(LightState)


@dataclass(frozen=True)
class ContextOptions:
    """How a scene is cut up for the policy.

    Attributes:
        max_pieces: map pieces kept, those nearest to where any present agent is or may soon be.
        piece_length: target length of a map piece [m].
        max_controlled: agents that the policy moves at most.
        decision_steps: F.
        horizon: T.
        control: whom the policy may move, as in :class:`~envs.traffic.TrafficEnv`.
        arrivals: agents that the log brings in later take part, as in :class:`~envs.traffic.TrafficEnv`.

    Raises:
        ValueError: a number that is not positive, an episode longer than a log, or a control that is none.
    """

    max_pieces: int = 512
    piece_length: float = 12.0
    max_controlled: int = MAX_CONTROLLED
    decision_steps: int = 5
    horizon: int = 16
    control: Control = "all"
    arrivals: bool = False

    def __post_init__(self) -> None:
        for name in ("max_pieces", "piece_length", "max_controlled", "decision_steps", "horizon"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}.")
        check_control(self.control)
        check_episode(self.decision_steps, self.horizon)


class SceneContext(TensorClass["nocast"]):
    """Inputs of the policy for one scene, or for a padded batch of them (``*`` is nothing or ``S``).

    Attributes:
        map_pose: ``[*, P, 3]`` middle of a piece, heading along it.
        map_points: ``[*, P, PIECE_POINTS, 2]`` in the frame of the piece [m].
        map_kind: ``[*, P]`` :class:`~envs.scene.MapKind`.
        map_light: ``[*, P]`` light state of the piece's lane at the current step, plus one (0: none).
        map_valid: ``[*, P]`` bool.
        light_pose: ``[*, G, 3]`` stop point, heading of the lane.
        light_state: ``[*, G, HISTORY]`` :class:`~envs.scene.LightState` plus one.
        light_valid: ``[*, G]`` bool.
        history: ``[*, A, HISTORY, 3]`` logged poses in the agent's current frame; 0 where invalid.
        history_valid: ``[*, A, HISTORY]`` bool.
        extent: ``[*, A, 3]`` [m].
        kind: ``[*, A]`` :class:`~envs.scene.AgentKind`.
        recent: ``[*, A, F + 1, 3]`` poses of the last decision before the episode.
        valid: ``[*, A]`` bool, the agent is there at the current step; false for padding and arrivals.
        controlled: ``[*, A]`` bool.
        logged: ``[*, A, T * F, 3]`` logged poses to come; where invalid, what
            :func:`~envs.participants.simulated_agents` holds there: read it under its mask.
        logged_valid: ``[*, A, T * F]`` bool.
    """

    map_pose: Tensor
    map_points: Tensor
    map_kind: Tensor
    map_light: Tensor
    map_valid: Tensor
    light_pose: Tensor
    light_state: Tensor
    light_valid: Tensor
    history: Tensor
    history_valid: Tensor
    extent: Tensor
    kind: Tensor
    recent: Tensor
    valid: Tensor
    controlled: Tensor
    logged: Tensor
    logged_valid: Tensor


AGENT_FIELDS = ("history", "history_valid", "extent", "kind", "recent", "valid", "controlled", "logged", "logged_valid")
"""Fields of a :class:`SceneContext` that have one row for each agent."""


def make_context(scene: Scene, options: ContextOptions | None = None) -> SceneContext:
    """Cut up one uncollated scene; its agents are those of a simulation: the present ones, then arrivals.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> make_context(straight_road(2)).history.shape
        torch.Size([2, 11, 3])
    """
    options = options or ContextOptions()
    steps = options.decision_steps * options.horizon
    scene = simulated_agents(scene, arrivals=options.arrivals, last_step=CURRENT_STEP + steps)
    agents = scene.agents
    poses, current = agents.poses, agents.poses[:, CURRENT_STEP]
    valid_history = agents.valid[:, :HISTORY]
    future = slice(HISTORY, HISTORY + steps)
    pieces = _map_pieces(scene.road, scene.lights, _reach(agents, options), options)
    map_pose, map_points, map_kind, map_light = pieces
    light_pose = _light_poses(scene.road, scene.lights)
    return SceneContext(
        map_pose=map_pose,
        map_points=map_points,
        map_kind=map_kind,
        map_light=map_light,
        map_valid=torch.ones(len(map_kind), dtype=torch.bool),
        light_pose=light_pose,
        light_state=scene.lights.state[:, :HISTORY] + 1,
        light_valid=scene.lights.state[:, CURRENT_STEP] != LightState.ABSENT,
        history=to_local(poses[:, :HISTORY], current[:, None]) * valid_history[..., None],
        history_valid=valid_history,
        extent=agents.extent,
        kind=agents.kind,
        recent=agents.recent(options.decision_steps),
        valid=agents.present,
        controlled=choose_controlled(scene, options.max_controlled, options.control),
        logged=poses[:, future],
        logged_valid=agents.valid[:, future],
        batch_size=[],
    )


def collate_contexts(contexts: Sequence[SceneContext]) -> SceneContext:
    """Pad contexts to a batch of batch size ``[S]``; padding is 0 and invalid."""
    return SceneContext(
        **{
            field.name: pad_sequence([getattr(context, field.name) for context in contexts], batch_first=True)
            for field in fields(SceneContext)
        },
        batch_size=[len(contexts)],
    )


def keep_agents(context: SceneContext, index: Tensor) -> SceneContext:
    """Keep some agents of one uncollated context."""
    context = context.clone(recurse=False)
    for name in AGENT_FIELDS:
        setattr(context, name, getattr(context, name)[index])
    return context


def _reach(agents: Agents, options: ContextOptions) -> Tensor:
    """``[n, 2]``: where present agents are, and would be each second of the episode at constant velocity."""
    seconds = torch.arange(0.0, options.decision_steps * options.horizon * STEP_SECONDS + 0.5)
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
