"""Who is off the road, step by step."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from envs.devices import of_rows
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
        >>> import torch
        >>> edge = torch.tensor([[-50.0, 5, 0], [50, 5, 0]])  # drivable on its left, above 5 m
        >>> poses = torch.tensor([[[0.0, 0, 0, 0], [0, 10, 0, 0]]])
        >>> off_road([edge], poses, torch.tensor([[4.0, 2, 1]]), torch.ones(1, 2, dtype=torch.bool))
        tensor([[ True, False]])
    """
    beyond, size = RoadEdges.from_polylines(edges).box_offroad_distance, extent[:, None].expand(*there.shape, 3)
    return of_rows(there, beyond, poses[..., :3], poses[..., 3], size) > 0
