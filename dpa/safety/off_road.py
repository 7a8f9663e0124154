"""Who is off the road, step by step."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from envs.geometry.edges import RoadEdges


def off_road(edges: Sequence[Tensor], poses: Tensor, extent: Tensor, there: Tensor) -> Tensor:
    """Whether a corner of an agent's box is beyond the road edge (realism.md section 4.1); False where nobody is.

    Args:
        edges: polylines, each ``[n, 3]``.
        poses: ``[*, A, L, 4]`` x, y, z, heading.
        extent: ``[A, 3]`` [m].
        there: ``[*, A, L]`` bool, the agent is there.

    Returns:
        ``[*, A, L]`` bool.

    Examples:
        >>> edge = torch.tensor([[-50.0, 5, 0], [50, 5, 0]])  # drivable on its left, above 5 m
        >>> poses = torch.tensor([[[0.0, 0, 0, 0], [0, 10, 0, 0]]])
        >>> off_road([edge], poses, torch.tensor([[4.0, 2, 1]]), torch.ones(1, 2, dtype=torch.bool))
        tensor([[ True, False]])
    """
    off, size = torch.zeros_like(there), extent[:, None].expand(*poses.shape[:-1], 3)
    place, heading = poses[there].split((3, 1), -1)
    off[there] = RoadEdges.from_polylines(edges).box_offroad_distance(place, heading[:, 0], size[there]) > 0
    return off
