"""The features of the paper, and its sets of them."""

from __future__ import annotations

import torch
from torch import Tensor

from dpa.ranking.features.registry import Motion, register
from envs.devices import of_rows
from envs.geometry.edges import RoadEdges
from envs.scene import EDGE_KINDS, STEP_SECONDS, polylines


@register("collision", unit="1", clip=(0.0, 1.0), weight=10.0, spread=0.21)
def collision(motion: Motion) -> Tensor:
    """1 while the agent's box, corners rounded, overlaps another one."""
    return (motion.clearance < 0).float()


@register("road_edge", unit="m", clip=(-20.0, 40.0), weight=5.0, spread=1.7)
def road_edge(motion: Motion) -> Tensor:
    """Signed distance to the road edge of the corner farthest out; positive off the road."""
    poses, extent = motion.ego_poses(), motion.extent[motion.ego][:, None].expand(*motion.shape, 3)
    edges = RoadEdges.from_polylines(polylines(motion.scene, EDGE_KINDS)).to(poses.device)
    # The look-up costs most of phi, and an absent agent has no place to ask for.
    there = motion.ego_valid.expand(motion.shape)
    return of_rows(there, edges.box_offroad_distance, poses[..., :3], poses[..., 3], extent)


@register("clearance", unit="m", clip=(-5.0, 40.0), weight=2.0, spread=3.2)
def clearance(motion: Motion) -> Tensor:
    """Signed distance to the nearest other agent; negative in a collision."""
    return motion.clearance


@register("effort", unit="m/s^2", clip=(0.0, 12.0), weight=1.0, spread=2.1, past=2)
def effort(motion: Motion) -> Tensor:
    """Norm of the acceleration vector from the last three positions."""
    now, before, first = (motion.ego_poses(back)[..., :2] for back in range(3))
    return torch.linalg.vector_norm(now - 2 * before + first, dim=-1) / STEP_SECONDS**2


@register("speed", unit="m/s", clip=(0.0, 25.0), weight=1.0, spread=1.7, past=1)
def speed(motion: Motion) -> Tensor:
    """Norm of the velocity from the last two positions."""
    now, before = (motion.ego_poses(back)[..., :2] for back in range(2))
    return torch.linalg.vector_norm(now - before, dim=-1) / STEP_SECONDS


FULL = ("collision", "road_edge", "clearance", "effort", "speed")
FEATURE_SETS: dict[str, tuple[str, ...]] = {
    "full": FULL,
    "collision": ("collision", "clearance"),
    "progress": ("speed",),
    "comfort": ("effort",),
    **{f"without_{left_out}": tuple(name for name in FULL if name != left_out) for left_out in FULL},
}
"""The rows of the paper's table 2, and all features but one. Which ones its "collision only" has is our reading."""
