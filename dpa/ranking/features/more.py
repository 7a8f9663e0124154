"""Features that the paper does not have: red lights, lanes, and the time to a collision."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dpa.ranking.features.registry import CONTEXT, Motion, register
from envs.devices import of_rows
from envs.geometry.edges import RoadEdges
from envs.geometry.following import LONGEST_TIME, time_to_collision
from envs.geometry.frames import wrap_angle
from envs.geometry.lights import crosses_red
from envs.scene import LANE_KINDS, STEP_SECONDS, polylines
from envs.signals import SignalMap


@register("red_light", unit="1", clip=(0.0, 1.0), weight=10.0, spread=0.041, past=1)
def red_light(motion: Motion) -> Tensor:
    """1 at the step at which the agent passes the stop point of its lane while the light is red (realism.md 4.2).

    Where not every step is measured, at the first one measured from then on. Nobody does where a scene has no lights or
    no surface streets.
    """
    road = SignalMap(motion.scene, motion.poses.device)
    if road.lanes is None:
        return motion.poses.new_zeros(motion.shape)
    lane_id, red, stop = road.lights
    span = motion.logged
    red, stop = red[:, span.start : span.stop - 1], stop[:, span]
    position, valid = motion.poses[:, motion.ego, :, :2], motion.valid[motion.ego].expand(motion.shape[0], -1, -1)
    crossed = crosses_red(road.lanes, lane_id, red, stop, position, valid) & valid[..., :-1]
    first, last, stride = CONTEXT - 1, int(motion.steps[-1]), int(motion.steps[0]) - CONTEXT + 1
    return crossed[..., first:last].unflatten(-1, (-1, stride)).any(-1).float()


@register("lane_deviation", unit="m", clip=(0.0, 10.0), weight=1.0, spread=0.97)
def lane_deviation(motion: Motion) -> Tensor:
    """Distance in the plane of the agent's centre from the nearest centre line of a lane of any kind."""
    return motion_on_lanes(motion, "lane_deviation")[0]


@register("heading_error", unit="rad", clip=(0.0, math.pi), weight=1.0, spread=0.46)
def heading_error(motion: Motion) -> Tensor:
    """Angle between the agent's heading and the direction of the nearest lane.

    It is the direction of the lane and not that of travel, which an agent that stands does not have.
    """
    direction = motion_on_lanes(motion, "heading_error")[1]
    return wrap_angle(motion.ego_poses()[..., 3] - direction).abs()


@register("time_to_collision", unit="s", clip=(0.0, LONGEST_TIME), weight=1.0, spread=0.55, past=1)
def time_to_collision_(motion: Motion) -> Tensor:
    """Time until the agent reaches its leader at present speeds, cut at 5 s (realism.md section 3.2).

    A leader whose log lacks the step before has no speed, and leads nobody.
    """
    poses, steps = motion.poses, motion.steps
    now, before = poses[:, :, steps], poses[:, :, steps - 1]
    speed = torch.linalg.vector_norm(now[..., :2] - before[..., :2], dim=-1) / STEP_SECONDS
    valid = (motion.valid[:, steps] & motion.valid[:, steps - 1]).expand(speed.shape)
    extent = motion.extent.expand(len(poses), -1, -1)
    return time_to_collision(now[..., :2], now[..., 3], speed, extent, valid, motion.ego)


def motion_on_lanes(motion: Motion, name: str) -> tuple[Tensor, Tensor]:
    """Distance to the nearest lane [m] and its direction [rad], each ``[R, E, T']``; 0 where the log is not valid.

    Raises:
        ValueError: the scene has no lane.
    """
    lines = [line for line in polylines(motion.scene, LANE_KINDS) if len(line) >= 2]
    if not lines:
        raise ValueError(f"scene {motion.scene.scene_id} has no lane, which the feature {name!r} needs; leave it out.")
    ground = motion.ego_poses()[..., :3].clone()
    ground[..., 2] -= motion.extent[motion.ego][:, None, 2] / 2
    lanes = RoadEdges.from_polylines(lines).to(ground.device)
    there = motion.ego_valid.expand(motion.shape)
    found = of_rows(there, lambda places: torch.stack(lanes.nearest(places), -1), ground)
    return found[..., 0], found[..., 1]
