"""Who is compared where: the log of a scene and rollouts of it, side by side, for one scene or several.

Sections are those of docs/realism.md, which specifies the Waymo Open Sim Agents metric. The log is treated as one
more rollout, so everything is computed once for ``C = R + 1`` scenes, the log first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dpa.realism.config import RealismConfig
from dpa.realism.quirks import Quirk
from envs.scene import CURRENT_STEP, LOG_STEPS, AgentKind, LightState, Scene, select_agents

HORIZON = LOG_STEPS - CURRENT_STEP - 1
"""Simulated steps, and steps that are scored."""
_CONTEXT = 2
"""Logged steps ahead of the scored ones that their differences reach back to (realism.md section 2.2)."""


class Generated(NamedTuple):
    """What rollouts of the Scenario Generation challenge bring along.

    Attributes:
        extent: ``[R, A, 3]``, length, width, height [m].
        kind: ``[R, A]`` int64, :class:`~envs.scene.AgentKind`.
    """

    extent: Tensor
    kind: Tensor


@dataclass(frozen=True)
class Tracks:
    """C scenes of A agents over L steps, the scored ones behind their context; the first E agents are evaluated.

    Attributes:
        position: ``[C, A, L, 3]``.
        heading: ``[C, A, L]``.
        valid: ``[C, A, L]`` bool.
        extent: ``[C, A, 3]``.
        vehicle: ``[C, A]`` bool.
        num_ego: E.
        context: steps ahead of the scored ones, that differences reach back to.
    """

    position: Tensor
    heading: Tensor
    valid: Tensor
    extent: Tensor
    vehicle: Tensor
    num_ego: int
    context: int

    @property
    def scored(self) -> slice:
        """The scored steps."""
        return slice(self.context, None)

    @property
    def boxes(self) -> Tensor:
        """``[C, T, A, 5]`` x, y, heading, length, width at the scored steps."""
        pose = torch.cat((self.position[..., :2], self.heading[..., None]), -1)[:, :, self.scored]
        size = self.extent[:, :, None, :2].expand(-1, -1, pose.shape[2], -1)
        return torch.cat((pose, size), -1).transpose(1, 2)


class Comparison(NamedTuple):
    """One scene and rollouts of it, ready to be measured.

    Attributes:
        scene: in the coordinates of the world, with the simulated agents only, the E evaluated ones first.
        simulated: ``[R, A, T, 4]``, in the same coordinates and order.
        tracks: both, side by side.
    """

    scene: Scene
    simulated: Tensor
    tracks: Tracks


def compare(scene: Scene, simulated: Tensor, config: RealismConfig, generated: Generated | None = None) -> Comparison:
    """Put the log and the rollouts of one uncollated scene side by side.

    Args:
        scene: agents that are not present at the current step take no part.
        simulated: ``[R, A, 80, 4]``, x, y, z, heading of the present agents in their order; ``[R, A, 91, 4]`` if
            ``config.scenario_generation``.
        config: which options apply.
        generated: sizes and classes of generated agents; those of the log by default.
    """
    scene, simulated = to_world(scene, simulated)
    scene = select_agents(scene, scene.agents.present)
    agents = scene.agents
    evaluated = torch.ones_like(agents.evaluated) if config.scenario_generation else agents.evaluated
    # Evaluated agents first, in ascending order of their ids (realism.md section 1.3).
    order = agents.track_id.argsort()
    order = torch.cat((order[evaluated[order]], order[~evaluated[order]]))
    scene, simulated, num_ego = select_agents(scene, order), simulated[:, order], int(evaluated.sum())
    if config.scenario_generation:
        if generated is not None:
            generated = Generated(*(part.to(order.device)[:, order] for part in generated))
        return Comparison(scene, simulated, _join_generated(scene, simulated, num_ego, generated))
    return Comparison(scene, simulated, _join(scene, simulated, num_ego, Quirk.GHOSTS in config.quirks))


def stack(tracks: Sequence[Tracks]) -> Tracks:
    """Several scenes as one: their C add up, agents are padded with such as are never there.

    Args:
        tracks: all with the same steps and context.
    """
    if len(tracks) == 1:
        return tracks[0]
    agents = max(each.valid.shape[1] for each in tracks)

    def padded(name: str) -> Tensor:
        parts = [getattr(each, name) for each in tracks]
        return torch.cat([torch.cat((p, p.new_zeros(len(p), agents - p.shape[1], *p.shape[2:])), 1) for p in parts])

    return Tracks(
        *(padded(name) for name in ("position", "heading", "valid", "extent", "vehicle")),
        num_ego=max(each.num_ego for each in tracks),
        context=tracks[0].context,
    )


def to_world(scene: Scene, simulated: Tensor) -> tuple[Scene, Tensor]:
    """Give one uncollated scene and its rollouts the coordinates that the official code works on.

    Those are the source's own in float32, and zero for all that is invalid or absent. This zero matters: accelerations
    reach back to invalid history, and red lights to absent stop points (realism.md sections 2.2 and 4.2).

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


def _join(scene: Scene, simulated: Tensor, num_ego: int, ghosts: bool) -> Tracks:
    """Put the log, then the rollouts behind their logged context, side by side (realism.md section 1.6)."""
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
    return Tracks(
        position=torch.cat((position[None], torch.cat((context, simulated[..., :3]), 2))),
        heading=torch.cat((heading[None], torch.cat((heading_context, simulated[..., 3]), 2))),
        valid=torch.cat((valid[None], simulated_valid.expand(rollouts, -1, -1))),
        extent=agents.extent.expand(rollouts + 1, -1, -1),
        vehicle=(agents.kind == AgentKind.VEHICLE).expand(rollouts + 1, -1),
        num_ego=num_ego,
        context=_CONTEXT,
    )


def _join_generated(scene: Scene, simulated: Tensor, num_ego: int, generated: Generated | None) -> Tracks:
    """Put the log and the generated scenes side by side (realism.md 7): all 91 steps, all agents, always valid."""
    agents, rollouts = scene.agents, simulated.shape[0]
    extent, kind = agents.extent.expand(rollouts, -1, -1), agents.kind.expand(rollouts, -1)
    if generated is not None:
        extent, kind = generated.extent.to(extent), generated.kind.to(kind)
    return Tracks(
        position=torch.cat((agents.position[None], simulated[..., :3])),
        heading=torch.cat((agents.heading[None], simulated[..., 3])),
        valid=torch.ones(rollouts + 1, *agents.valid.shape, dtype=torch.bool, device=simulated.device),
        extent=torch.cat((agents.extent[None], extent)),
        vehicle=torch.cat((agents.kind[None], kind)) == AgentKind.VEHICLE,
        num_ego=num_ego,
        context=0,
    )
