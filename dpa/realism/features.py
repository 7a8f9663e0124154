"""What the realism metric measures of every evaluated agent, at each step, in the log and in the rollouts.

Sections refer to the specification of the Waymo Open Sim Agents metric (SPEC). The log is treated as one more rollout,
so everything is computed once for ``C = R + 1`` scenes, the log first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from dpa.realism.config import Differences, RealismConfig
from dpa.realism.lights import red_light_violation
from dpa.realism.quirks import Quirk
from envs.geometry.boxes import nearest_box_distance
from envs.geometry.edges import RoadEdges
from envs.geometry.frames import rotate, wrap_angle
from envs.scene import (
    CURRENT_STEP,
    EDGE_KINDS,
    LOG_STEPS,
    STEP_SECONDS,
    AgentKind,
    LightState,
    Scene,
    polylines,
    select_agents,
)

HORIZON = LOG_STEPS - CURRENT_STEP - 1
"""Simulated steps, and steps that are scored."""

_CONTEXT = 2
"""Logged steps ahead of the scored ones that their differences reach back to (SPEC section 2.2)."""
_OFF_MAP = -1e10
"""Distance to the road edge of an agent that is not there [m]."""

_LONGEST_TTC = 5.0
"""Time to collision is cut at this value [s]."""
_FOLLOW_ANGLE = math.radians(75)
"""A leader's heading differs by at most this angle [rad]."""
_FOLLOW_ANGLE_SMALL_OVERLAP = math.radians(10)
"""The same where the two overlap sideways by less than :data:`_SMALL_OVERLAP` [rad]."""
_SMALL_OVERLAP = 0.5
"""Overlap sideways below which a leader must be nearly parallel [m]."""


@dataclass(frozen=True)
class Features:
    """Measurements of E evaluated agents in ascending order of track id at T scored steps (80, or 91 if generated).

    Attributes:
        values: name to ``[C, E, T]``; float for continuous features, bool for ``collision_per_step``,
            ``offroad_per_step`` and, if asked for, ``traffic_light_violation_per_step``.
        displacement: ``[R, E]``, mean distance from the log over all 91 steps [m].
        valid: ``[E, context + T]`` bool, the agent is there in the log, from the context of differences on (two steps;
            none of generated scenes).
        vehicle: ``[C, E]`` bool.
        track_id: ``[E]`` int64.
    """

    values: dict[str, Tensor]
    displacement: Tensor
    valid: Tensor
    vehicle: Tensor
    track_id: Tensor

    @property
    def scored(self) -> Tensor:
        """``[E, T]`` bool: steps of :attr:`values` at which the agent is there in the log."""
        return self.valid[:, -self.values["linear_speed"].shape[-1] :]


class Generated(NamedTuple):
    """What rollouts of the Scenario Generation challenge bring along.

    Attributes:
        extent: ``[R, A, 3]``, length, width, height [m].
        kind: ``[R, A]`` int64, :class:`~envs.scene.AgentKind`.
    """

    extent: Tensor
    kind: Tensor


@dataclass(frozen=True)
class _Tracks:
    """C scenes of A simulated agents over L steps: the scored ones behind their context.

    Attributes:
        position: ``[C, A, L, 3]``.
        heading: ``[C, A, L]``.
        valid: ``[C, A, L]`` bool.
        extent: ``[C, A, 3]``.
        vehicle: ``[C, A]`` bool.
        ego: ``[E]`` int64, the evaluated agents.
        context: steps ahead of the scored ones, that differences reach back to.
    """

    position: Tensor
    heading: Tensor
    valid: Tensor
    extent: Tensor
    vehicle: Tensor
    ego: Tensor
    context: int

    @property
    def scored(self) -> slice:
        """The scored steps."""
        return slice(self.context, None)


def measure(scene: Scene, simulated: Tensor, config: RealismConfig, generated: Generated | None = None) -> Features:
    """Measure the log and the rollouts of one uncollated scene.

    Args:
        scene: the scene; agents that are not present at the current step take no part.
        simulated: ``[R, A, 80, 4]``, x, y, z, heading of the present agents in their order; ``[R, A, 91, 4]`` if
            ``config.scenario_generation``.
        config: which options apply.
        generated: sizes and classes of generated agents; those of the log by default.
    """
    scene, simulated = to_world(scene, simulated)
    scene = select_agents(scene, scene.agents.present)
    agents = scene.agents
    if config.scenario_generation:
        tracks = _join_generated(scene, simulated, agents.track_id.argsort(), generated)
    else:
        ego = agents.evaluated.nonzero()[:, 0]
        tracks = _join(scene, simulated, ego[agents.track_id[ego].argsort()], Quirk.GHOSTS in config.quirks)
    ego = tracks.ego
    distance = _nearest_object(tracks, config.corner_rounding)
    edges = RoadEdges.from_polylines(
        polylines(scene, EDGE_KINDS),
        every_ring=Quirk.LONGEST_RING not in config.quirks,
        height_stretch=config.height_stretch,
        points_at_zero=Quirk.POINTS_AT_ZERO in config.quirks,
    )
    road_edge = _road_edge(tracks, edges)
    values = {
        **_kinematics(tracks, config),
        "distance_to_nearest_object": distance,
        "collision_per_step": distance < 0,
        "time_to_collision": _time_to_collision(tracks, config),
        "distance_to_road_edge": road_edge,
        "offroad_per_step": road_edge > 0,
    }
    if config.traffic_lights:
        values["traffic_light_violation_per_step"] = _red_lights(tracks, scene, config)
    if config.scenario_generation:  # there is no log to be displaced from
        displacement = simulated.new_zeros(len(simulated), len(ego))
    else:
        displacement = _displacement(scene, simulated, ego, Quirk.HISTORY_IN_ADE in config.quirks)
    return Features(
        values=values,
        displacement=displacement,
        valid=tracks.valid[1, ego] if config.scenario_generation else agents.valid[ego, -HORIZON - _CONTEXT :],
        vehicle=tracks.vehicle[:, ego],
        track_id=agents.track_id[ego],
    )


def to_world(scene: Scene, simulated: Tensor) -> tuple[Scene, Tensor]:
    """Give one uncollated scene and its rollouts the coordinates that the official code works on.

    Those are the source's own in float32, and zero for all that is invalid or absent. This zero matters: accelerations
    reach back to invalid history, and red lights to absent stop points (SPEC sections 2.2 and 4.2).

    Args:
        scene: a scene.
        simulated: ``[R, A, 80, 4]``, x, y, z, heading.
    """

    def move(points: Tensor) -> Tensor:
        return (points.double() + scene.origin).to(points.dtype)

    agents, lights = scene.agents.clone(recurse=False), scene.lights.clone(recurse=False)
    agents.position = torch.where(agents.valid[..., None], move(agents.position), 0)
    agents.heading = torch.where(agents.valid, agents.heading, 0)
    absent = lights.state == LightState.ABSENT
    lights.stop_point = torch.where(absent[..., None], 0, move(lights.stop_point))
    road = scene.road.clone(recurse=False)
    road.points = move(road.points)
    moved = scene.clone(recurse=False)
    moved.agents, moved.lights, moved.road = agents, lights, road
    moved.origin = torch.zeros_like(scene.origin)
    return moved, torch.cat((move(simulated[..., :3]), simulated[..., 3:]), -1)


def _join(scene: Scene, simulated: Tensor, ego: Tensor, ghosts: bool) -> _Tracks:
    """Put the log, then the rollouts behind their logged context, side by side (SPEC section 1.6)."""
    agents = scene.agents
    steps = slice(-HORIZON - _CONTEXT, None)
    valid = agents.valid[:, steps]
    position, heading = agents.position[:, steps], agents.heading[:, steps]

    rollouts = simulated.shape[0]
    context = position[:, :_CONTEXT].expand(rollouts, -1, -1, -1)
    heading_context = heading[:, :_CONTEXT].expand(rollouts, -1, -1)
    simulated_valid = valid.clone()
    simulated_valid[:, _CONTEXT:] = True
    if ghosts:
        valid = simulated_valid
    return _Tracks(
        position=torch.cat((position[None], torch.cat((context, simulated[..., :3]), 2))),
        heading=torch.cat((heading[None], torch.cat((heading_context, simulated[..., 3]), 2))),
        valid=torch.cat((valid[None], simulated_valid.expand(rollouts, -1, -1))),
        extent=agents.extent.expand(rollouts + 1, -1, -1),
        vehicle=(agents.kind == AgentKind.VEHICLE).expand(rollouts + 1, -1),
        ego=ego,
        context=_CONTEXT,
    )


def _join_generated(scene: Scene, simulated: Tensor, ego: Tensor, generated: Generated | None) -> _Tracks:
    """Put the log and the generated scenes side by side (SPEC section 7): all 91 steps, all agents, always valid."""
    agents, rollouts = scene.agents, simulated.shape[0]
    extent, kind = agents.extent.expand(rollouts, -1, -1), agents.kind.expand(rollouts, -1)
    if generated is not None:
        extent, kind = generated.extent.to(extent), generated.kind.to(kind)
    return _Tracks(
        position=torch.cat((agents.position[None], simulated[..., :3])),
        heading=torch.cat((agents.heading[None], simulated[..., 3])),
        valid=torch.ones(rollouts + 1, *agents.valid.shape, dtype=torch.bool, device=simulated.device),
        extent=torch.cat((agents.extent[None], extent)),
        vehicle=torch.cat((agents.kind[None], kind)) == AgentKind.VEHICLE,
        ego=ego,
        context=0,
    )


def _difference(value: Tensor, kind: Differences) -> Tensor:
    """Change in one step along the last dim; NaN where a neighbour is missing.

    Central: half the difference of the two neighbours. Backward: the difference to the one before.
    """
    if kind == "central":
        return pad((value[..., 2:] - value[..., :-2]) / 2, (1, 1), value=torch.nan)
    return pad(value[..., 1:] - value[..., :-1], (1, 0), value=torch.nan)


def _turn(angle: Tensor, kind: Differences) -> Tensor:
    """Change of an angle in one step, wrapped over the steps that it spans [rad]."""
    steps = 2 if kind == "central" else 1
    return wrap_angle(steps * _difference(angle, kind)) / steps


def _speed(position: Tensor, kind: Differences) -> Tensor:
    """Speed from positions in two or three dims: ``[..., L, D]`` -> ``[..., L]`` [m/s]."""
    step = _difference(position.transpose(-1, -2), kind)
    return step.square().sum(-2).sqrt() / STEP_SECONDS


def _kinematics(tracks: _Tracks, config: RealismConfig) -> dict[str, Tensor]:
    """Speeds and accelerations of the evaluated agents (SPEC section 2)."""
    position, heading = tracks.position[:, tracks.ego], tracks.heading[:, tracks.ego]
    if Quirk.INVALID_AT_ORIGIN not in config.quirks:
        valid = tracks.valid[:, tracks.ego]
        position, heading = position.where(valid[..., None], torch.nan), heading.where(valid, torch.nan)
    kind = config.differences
    speed, turn = _speed(position, kind), _turn(heading, kind)
    if kind == "central":
        angular_acceleration = _turn(turn, kind) / STEP_SECONDS**2
    else:  # the code of 2023 wraps a difference of speeds as if it were one of angles
        angular_acceleration = _turn(turn / STEP_SECONDS, kind) / STEP_SECONDS
    values = {
        "linear_speed": speed,
        "linear_acceleration": _difference(speed, kind) / STEP_SECONDS,
        "angular_speed": turn / STEP_SECONDS,
        "angular_acceleration": angular_acceleration,
    }
    return {name: value[..., tracks.scored] for name, value in values.items()}


def _nearest_object(tracks: _Tracks, rounding: float) -> Tensor:
    """Signed distance of the evaluated agents to the nearest other box (SPEC section 3.1) -> ``[C, E, T]`` [m]."""
    pose = torch.cat((tracks.position[..., :2], tracks.heading[..., None]), -1)[:, :, tracks.scored]
    size = tracks.extent[:, :, None, :2].expand(-1, -1, pose.shape[2], -1)
    boxes = torch.cat((pose, size), -1).transpose(1, 2)
    valid = tracks.valid[:, :, tracks.scored].transpose(1, 2)
    return nearest_box_distance(boxes, valid, tracks.ego, rounding).transpose(1, 2)


def _time_to_collision(tracks: _Tracks, config: RealismConfig) -> Tensor:
    """Time until evaluated agents reach their leaders at present speeds (SPEC section 3.2) -> ``[C, E, T]`` [s]."""
    speed = _speed(tracks.position[..., :2], config.differences)[..., tracks.scored]
    position, heading = tracks.position[:, :, tracks.scored, :2], tracks.heading[:, :, tracks.scored]
    valid = tracks.valid[:, :, tracks.scored]
    length, width = tracks.extent[..., 0, None], tracks.extent[..., 1, None]
    result = []
    for ego in tracks.ego.tolist():
        turn = heading - heading[:, ego, None]
        if Quirk.UNWRAPPED_TURN not in config.quirks:
            turn = wrap_angle(turn)
        turn = turn.abs()
        cos, sin = turn.cos().abs(), turn.sin().abs()
        ahead, aside = rotate(position - position[:, ego, None], -heading[:, ego, None]).unbind(-1)
        gap = ahead - length[:, ego, None] / 2 - (length * cos + width * sin) / 2
        overlap = aside.abs() - width[:, ego, None] / 2 - (length * sin + width * cos) / 2
        aligned = (turn <= _FOLLOW_ANGLE) & ((overlap < -_SMALL_OVERLAP) | (turn <= _FOLLOW_ANGLE_SMALL_OVERLAP))
        followed = (gap > 0) & (overlap < 0) & aligned & valid
        nearest, leader = torch.where(followed, gap, torch.inf).min(1)
        closing = speed[:, ego] - speed.gather(1, leader[:, None])[:, 0]
        result.append(torch.where(closing > 0, (nearest / closing).clamp(max=_LONGEST_TTC), _LONGEST_TTC))
    return torch.stack(result, 1)


def _road_edge(tracks: _Tracks, edges: RoadEdges) -> Tensor:
    """Signed distance of the evaluated agents to the road edge (SPEC section 4.1) -> ``[C, E, T]`` [m]."""
    position = tracks.position[:, tracks.ego, tracks.scored]
    heading = tracks.heading[:, tracks.ego, tracks.scored]
    valid = tracks.valid[:, tracks.ego, tracks.scored]
    extent = tracks.extent[:, tracks.ego, None].expand(position.shape)
    result = position.new_full(valid.shape, _OFF_MAP)
    result[valid] = edges.box_offroad_distance(position[valid], heading[valid], extent[valid])
    return result


def _red_lights(tracks: _Tracks, scene: Scene, config: RealismConfig) -> Tensor:
    """Steps at which the evaluated agents drive through red lights (SPEC section 4.2) -> ``[C, E, T]`` bool."""
    # A crossing compares a step with the one before it; nothing is crossed at the first step of a generated scene.
    before = max(tracks.context - 1, 0)
    position, valid = tracks.position[:, tracks.ego, before:, :2], tracks.valid[:, tracks.ego, before:]
    violation = red_light_violation(scene, position, valid, config.quirks)
    return violation if tracks.context else pad(violation, (1, 0))


def _displacement(scene: Scene, simulated: Tensor, ego: Tensor, with_history: bool) -> Tensor:
    """Mean distance from the log (SPEC section 5) -> ``[R, E]`` [m]; NaN where the log has no step."""
    position, valid = scene.agents.position[ego], scene.agents.valid[ego]
    error = (simulated[:, ego, :, :3] - position[:, -HORIZON:]).norm(dim=-1)
    steps = valid if with_history else valid[:, -HORIZON:]
    return (error * valid[:, -HORIZON:]).sum(-1) / steps.sum(-1)
