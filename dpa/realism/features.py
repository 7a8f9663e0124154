"""What the realism metric measures of every evaluated agent, at each step, in the log and in the rollouts.

Sections are those of docs/realism.md, which specifies the Waymo Open Sim Agents metric.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from dpa.realism.config import Differences, RealismConfig
from dpa.realism.lights import red_light_violation
from dpa.realism.quirks import Quirk
from dpa.realism.tracks import HORIZON, Comparison, Tracks, stack
from envs.devices import of_rows
from envs.geometry.boxes import nearest_box_distance
from envs.geometry.edges import RoadEdges
from envs.geometry.following import time_to_collision
from envs.geometry.frames import wrap_angle
from envs.scene import EDGE_KINDS, STEP_SECONDS, Scene, polylines

_OFF_MAP = -1e10
"""Distance to the road edge of an agent that is not there [m]."""


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
        kind: ``[E]`` :class:`~envs.scene.AgentKind` in the log.
    """

    values: dict[str, Tensor]
    displacement: Tensor
    valid: Tensor
    vehicle: Tensor
    track_id: Tensor
    kind: Tensor

    def of(self, rollouts: Tensor) -> Features:
        """The measurements of some of the rollouts, ``[R']`` int64; the log stays."""
        kept = pad(rollouts + 1, (1, 0))
        values = {name: value[kept] for name, value in self.values.items()}
        return replace(self, values=values, displacement=self.displacement[rollouts], vehicle=self.vehicle[kept])

    @property
    def scored(self) -> Tensor:
        """``[E, T]`` bool: steps of :attr:`values` at which the agent is there in the log."""
        return self.valid[:, -self.values["linear_speed"].shape[-1] :]


def measure(comparisons: Sequence[Comparison], config: RealismConfig) -> list[Features]:
    """Measure the logs and the rollouts of some scenes.

    What needs the agents only is computed for all scenes together, what needs the map for each.

    Args:
        comparisons: from :func:`dpa.realism.tracks.compare`, with the same configuration.
        config: which options apply.
    """
    together = stack([each.tracks for each in comparisons])
    distance = _nearest_object(together, config.corner_rounding)
    joint = {
        **_kinematics(together, config),
        "distance_to_nearest_object": distance,
        "collision_per_step": distance < 0,
        "time_to_collision": _time_to_collision(together, config),
    }
    sizes = [len(each.tracks.valid) for each in comparisons]
    parts = {name: value.split(sizes) for name, value in joint.items()}
    return [
        _finish(each, {name: part[index][:, : each.tracks.num_ego] for name, part in parts.items()}, config)
        for index, each in enumerate(comparisons)
    ]


def _finish(comparison: Comparison, values: dict[str, Tensor], config: RealismConfig) -> Features:
    """Add to the measurements of one scene what its map and its log give."""
    scene, simulated, tracks = comparison
    road_edge = _road_edge(tracks, scene, config)
    values |= {"distance_to_road_edge": road_edge, "offroad_per_step": road_edge > 0}
    if config.traffic_lights:
        values["traffic_light_violation_per_step"] = _red_lights(tracks, scene, config)
    agents, ego = scene.agents, slice(tracks.num_ego)
    if config.scenario_generation:  # there is no log to be displaced from
        displacement, valid = simulated.new_zeros(len(simulated), tracks.num_ego), tracks.valid[0, ego]
    else:
        displacement = _displacement(scene, simulated, tracks.num_ego, Quirk.HISTORY_IN_ADE in config.quirks)
        valid = agents.valid[ego, -HORIZON - tracks.context :]
    return Features(
        values=values,
        displacement=displacement,
        valid=valid,
        vehicle=tracks.vehicle[:, ego],
        track_id=agents.track_id[ego],
        kind=agents.kind[ego],
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


def _kinematics(tracks: Tracks, config: RealismConfig) -> dict[str, Tensor]:
    """Speeds and accelerations of the evaluated agents (realism.md section 2)."""
    ego = slice(tracks.num_ego)
    position, heading = tracks.position[:, ego], tracks.heading[:, ego]
    if Quirk.INVALID_AT_ORIGIN not in config.quirks:
        valid = tracks.valid[:, ego]
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


def _nearest_object(tracks: Tracks, rounding: float) -> Tensor:
    """Signed distance of the evaluated agents to the nearest other box (realism.md 3.1) -> ``[C, E, T]`` [m]."""
    boxes = tracks.boxes
    valid = tracks.valid[:, :, tracks.scored].transpose(1, 2)
    ego = torch.arange(tracks.num_ego, device=boxes.device)
    return nearest_box_distance(boxes, valid, ego, rounding).transpose(1, 2)


def _time_to_collision(tracks: Tracks, config: RealismConfig) -> Tensor:
    """Time until evaluated agents reach their leaders at present speeds (realism.md 3.2) -> ``[C, E, T]`` [s]."""
    known = tracks.position[..., :2]
    if Quirk.INVALID_AT_ORIGIN not in config.quirks:
        known = known.where(tracks.valid[..., None], torch.nan)
    speed = _speed(known, config.differences)[..., tracks.scored]
    position, heading = tracks.position[:, :, tracks.scored, :2], tracks.heading[:, :, tracks.scored]
    valid = tracks.valid[:, :, tracks.scored]
    return time_to_collision(
        position,
        heading,
        speed,
        tracks.extent,
        valid,
        torch.arange(tracks.num_ego, device=position.device),
        unwrapped_turn=Quirk.UNWRAPPED_TURN in config.quirks,
    )


def _road_edge(tracks: Tracks, scene: Scene, config: RealismConfig) -> Tensor:
    """Signed distance of the evaluated agents to the road edge (realism.md section 4.1) -> ``[C, E, T]`` [m]."""
    edges = RoadEdges.from_polylines(
        polylines(scene, EDGE_KINDS),
        every_ring=Quirk.LONGEST_RING not in config.quirks,
        height_stretch=config.height_stretch,
        points_at_zero=Quirk.POINTS_AT_ZERO in config.quirks,
    )
    ego = slice(tracks.num_ego)
    position, heading = tracks.position[:, ego, tracks.scored], tracks.heading[:, ego, tracks.scored]
    valid = tracks.valid[:, ego, tracks.scored]
    extent = tracks.extent[:, ego, None].expand(position.shape)
    return torch.where(valid, of_rows(valid, edges.box_offroad_distance, position, heading, extent), _OFF_MAP)


def _red_lights(tracks: Tracks, scene: Scene, config: RealismConfig) -> Tensor:
    """Steps at which the evaluated agents drive through red lights (realism.md section 4.2) -> ``[C, E, T]`` bool."""
    # A crossing compares a step with the one before it; nothing is crossed at the first step of a generated scene.
    before, ego = max(tracks.context - 1, 0), slice(tracks.num_ego)
    position, valid = tracks.position[:, ego, before:, :2], tracks.valid[:, ego, before:]
    violation = red_light_violation(scene, position, valid, config.quirks)
    return violation if tracks.context else pad(violation, (1, 0))


def _displacement(scene: Scene, simulated: Tensor, num_ego: int, with_history: bool) -> Tensor:
    """Mean distance from the log (realism.md section 5) -> ``[R, E]`` [m]; NaN where the log has no step."""
    position, valid = scene.agents.position[:num_ego], scene.agents.valid[:num_ego]
    error = (simulated[:, :num_ego, :, :3] - position[:, -HORIZON:]).norm(dim=-1)
    steps = valid if with_history else valid[:, -HORIZON:]
    return (error * valid[:, -HORIZON:]).sum(-1) / steps.sum(-1)
