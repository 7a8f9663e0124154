"""What a discriminator sees of an agent: its motion, its neighbours and the road, all from the agent's own frame.

Logs and rollouts have to look alike in everything but the motion. Both are cut where the log of an agent has its first
hole, and neighbours vanish there on both sides; otherwise the discriminator would learn who is missing.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dpa.ranking import occupancy_features
from envs.geometry.frames import rotate, to_local, wrap_angle
from envs.scene import CURRENT_STEP, STEP_SECONDS, AgentKind, Scene

ROAD = ("road_edge", "clearance", "lane_deviation", "heading_error")
"""Features of :data:`~dpa.ranking.FEATURES` that are seen by default."""
OWN = ("forward", "lateral", "speed", "turn", "forward_acceleration", "lateral_acceleration")
"""The agent's own motion since the step before [m/s, m/s, m/s, rad/s, m/s^2, m/s^2]."""
KINDS = (AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST)
NEIGHBOURS = 4
"""Nearest other agents that are seen."""
NEIGHBOUR_WIDTH = 5
"""x, y, cosine and sine of the heading, and whether there is one."""
FARTHEST = 50.0
"""A neighbour further than this in x or y is seen there [m]."""
_ROLLOUTS_AT_ONCE = 8


def width_of(road: Sequence[str] = ROAD) -> int:
    """D: numbers that are seen of an agent at a step.

    Examples:
        >>> width_of()
        33
    """
    return len(OWN) + len(KINDS) + NEIGHBOUR_WIDTH * NEIGHBOURS + len(road)


def until_first_hole(scene: Scene, decision_steps: int = 1) -> Scene:
    """The scene with every log invalid from the decision of its first hole after the current step on.

    A tokenized log follows the log up to the first hole and no further, so nothing behind it can be compared; nor can
    the steps before it in the same decision, whose token leads to where the log has nothing.

    Args:
        scene: uncollated.
        decision_steps: F, of a token; 1 cuts at the hole itself.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(1)
        >>> scene.agents.valid[0, 20] = False
        >>> int(scene.agents.valid.sum()), int(until_first_hole(scene).agents.valid.sum())
        (90, 20)
        >>> int(until_first_hole(scene, decision_steps=5).agents.valid.sum())
        16
    """
    cut = scene.clone(recurse=False)
    cut.agents = scene.agents.clone(recurse=False)
    valid = scene.agents.valid.clone()
    later = valid[:, CURRENT_STEP + 1 :]
    steps, whole = torch.arange(later.shape[1], device=later.device), later.shape[1]
    first = later.int().cummin(-1).values.sum(-1)
    kept = torch.where(first < whole, first - first % decision_steps, whole)
    valid[:, CURRENT_STEP + 1 :] = (steps < kept[:, None]) & valid[:, CURRENT_STEP, None]
    cut.agents.valid = valid
    return cut


def observed_motion(
    scene: Scene,
    trajectories: Tensor,
    *,
    ego: Tensor | None = None,
    stride: int = 5,
    road: Sequence[str] = ROAD,
    decision_steps: int = 1,
) -> tuple[Tensor, Tensor]:
    """What is seen of every measured agent at every measured step.

    Motion is measured between measured steps: with ``stride`` 5 from one decision of 0.5 s to the next, so that poses
    inside a decision, which interpolation makes, do not tell logs from rollouts.

    Args:
        scene: uncollated.
        trajectories: ``[R, A, T, 4]`` x, y, z, heading at 10 Hz after the current step, of the present agents in order.
        ego: ``[E]`` int64, rows of the agents to look at; all of them by default.
        stride: look at every ``stride``-th step, 1 to 10.
        road: names of :data:`~dpa.ranking.FEATURES`.
        decision_steps: steps of a token, of trajectories that were decoded from tokens: the one with a hole in it
            counts for nothing, see :func:`until_first_hole`.

    Returns:
        values ``[R, E, T // stride, D]`` (:data:`OWN`, class, neighbours, ``road``), 0 where not valid, and valid
        ``[E, T // stride]`` bool, which depends on the log alone.

    Raises:
        ValueError: a stride beyond the history, an unknown name, or trajectories that do not fit the scene.

    Examples:
        >>> from dpa.ranking import log_trajectory
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2, speed=10.0)
        >>> values, valid = observed_motion(scene, log_trajectory(scene, 80)[None])
        >>> values.shape, bool(valid.all())
        (torch.Size([1, 2, 16, 33]), True)
        >>> values[0, 0, 0, : len(OWN)].round(decimals=2).abs()
        tensor([10.,  0., 10.,  0.,  0.,  0.])
    """
    if not 1 <= stride <= CURRENT_STEP:
        raise ValueError(f"stride must be 1 to {CURRENT_STEP} (the history of a scene), got {stride}.")
    scene = until_first_hole(scene, decision_steps)
    ego = torch.arange(trajectories.shape[1]) if ego is None else ego
    phi, phi_valid = occupancy_features(scene, trajectories, road, ego=ego, stride=stride)
    poses, there = _tracks(scene, trajectories, stride)
    valid = phi_valid & (there[:, 2:] & there[:, 1:-1] & there[:, :-2])[ego]
    kind = scene.agents.kind[scene.agents.present][ego, None] == torch.tensor(KINDS)
    parts = (
        own_motion(poses[:, ego], stride * STEP_SECONDS),
        kind[None, :, None].expand(*phi.shape[:-1], len(KINDS)).to(phi),
        torch.cat([_neighbours(part[:, :, 2:], there[:, 2:], ego) for part in poses.split(_ROLLOUTS_AT_ONCE)]),
        phi,
    )
    return torch.where(valid[..., None], torch.cat(parts, -1), 0.0), valid


def own_motion(poses: Tensor, seconds: float) -> Tensor:
    """Velocity, speed, turn rate and acceleration in the frame of the step before.

    Args:
        poses: ``[*, 2 + T, 3]`` x, y, heading.
        seconds: between two poses.

    Returns:
        ``[*, T, 6]`` in the order of :data:`OWN`.

    Examples:
        >>> poses = torch.tensor([[0.0, 0, 0], [0.0, 1, 1.5708], [0.0, 3, 1.5708]])
        >>> own_motion(poses, 0.5)[0].round(decimals=2).abs()
        tensor([4., 0., 4., 0., 4., 0.])
    """
    velocity = poses[..., :2].diff(dim=-2) / seconds
    now, before, frame = velocity[..., 1:, :], velocity[..., :-1, :], poses[..., 1:-1, 2]
    turn = wrap_angle(poses[..., 2:, 2] - frame)[..., None] / seconds
    speed = torch.linalg.vector_norm(now, dim=-1, keepdim=True)
    return torch.cat((rotate(now, -frame), speed, turn, rotate((now - before) / seconds, -frame)), -1)


def _tracks(scene: Scene, trajectories: Tensor, stride: int) -> tuple[Tensor, Tensor]:
    """Measured poses ``[R, A, 2 + T', 3]`` and validity ``[A, 2 + T']``, the last two of the log in front."""
    agents, present, steps = scene.agents, scene.agents.present, trajectories.shape[2]
    first = CURRENT_STEP - stride
    measured = torch.arange(first, CURRENT_STEP + 1 + steps - steps % stride, stride)
    before = agents.poses[present][:, first : CURRENT_STEP + 1 : stride].to(trajectories)
    after = trajectories[:, :, stride - 1 :: stride, [0, 1, 3]]
    return torch.cat((before.expand(len(after), -1, -1, -1), after), 2), agents.valid[present][:, measured]


def _neighbours(poses: Tensor, there: Tensor, ego: Tensor) -> Tensor:
    """The nearest other agents in the frame of each measured one, ``[R, E, T, NEIGHBOURS * NEIGHBOUR_WIDTH]``."""
    own, other = poses[:, ego, None], poses[:, None]
    gap = torch.linalg.vector_norm(other[..., :2] - own[..., :2], dim=-1)
    absent = ~there.expand(len(ego), -1, -1).clone()
    absent[torch.arange(len(ego)), ego] = True
    gap = gap.masked_fill(absent, torch.inf)
    nearest = gap.topk(min(NEIGHBOURS, gap.shape[2]), dim=2, largest=False)
    row = nearest.indices[..., None].expand(*nearest.indices.shape, poses.shape[-1])
    chosen = other.expand(-1, len(ego), -1, -1, -1).gather(2, row)
    local = to_local(chosen, own)
    seen = nearest.values < torch.inf
    columns = (
        local[..., :2].clamp(-FARTHEST, FARTHEST),
        local[..., 2:].cos(),
        local[..., 2:].sin(),
        torch.ones_like(local[..., :1]),
    )
    found = poses.new_zeros(len(poses), len(ego), poses.shape[2], NEIGHBOURS, NEIGHBOUR_WIDTH)
    found[:, :, :, : seen.shape[2]] = (torch.cat(columns, -1) * seen[..., None]).transpose(2, 3)
    return found.flatten(-2)
