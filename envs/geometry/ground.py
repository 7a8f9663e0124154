"""Height of the road under moving agents, for policies that predict ``(x, y, heading)`` only."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from envs.devices import on_host, require

LEVEL_STRETCH = 3.0
"""Weight of height in "nearest", so that a bridge is far from the road below it (realism.md section 4.1)."""
_PAIRS_ON_DEVICE = 1 << 24
"""Pairs of a place and a map point whose distances are in memory together on a device."""
KNOT_STEPS = 5
"""Steps of 0.1 s between two looks at the map; heights between them are interpolated."""


class Ground:
    """Heights of a map's points, asked for by place and level.

    On a CPU a tree finds the nearest point; a device looks at all of them, and of points equally near takes the first.

    Args:
        points: ``[N, 3]`` map points [m]; places are asked for on their device.

    Raises:
        ValueError: there is no point.

    Examples:
        >>> ground = Ground(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 8.0], [5.0, 0.0, 2.0]]))
        >>> ground.height(torch.tensor([[0.5, 0.0], [0.5, 0.0]]), level=torch.tensor([0.0, 9.0]))
        tensor([1., 8.])
    """

    def __init__(self, points: Tensor) -> None:
        if len(points) == 0:
            raise ValueError("the map has no point, so the ground has no height; give the scene a road edge.")
        points = points.detach()
        self._height = points[:, 2].float()
        self._points = _stretched(points[:, :2], points[:, 2])
        self._tree = cKDTree(self._points.numpy()) if on_host(points) else None

    def height(self, xy: Tensor, level: Tensor) -> Tensor:
        """Height of the nearest map point on the level given.

        Args:
            xy: ``[..., 2]`` [m].
            level: ``[...]`` height near which the point should lie [m].

        Returns:
            ``[...]`` [m].
        """
        query = torch.cat((xy, LEVEL_STRETCH * level[..., None]), -1).detach()
        if self._tree is not None:
            return self._height[torch.from_numpy(np.asarray(self._tree.query(query.numpy())[1]))]
        flat, rows = query.double().view(-1, 3), max(1, _PAIRS_ON_DEVICE // len(self._points))
        nearest = [
            torch.cdist(some, self._points, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)
            for some in flat.split(rows)
        ]
        return self._height[torch.cat(nearest)].view(level.shape)


def _stretched(xy: Tensor, z: Tensor) -> Tensor:
    """Places ``[*, 3]`` float64 between which the distance is what "nearest" means."""
    return torch.cat((xy.double(), LEVEL_STRETCH * z.double()[..., None]), -1)


def lift(poses: Tensor, start: Tensor, points: Tensor) -> Tensor:
    """Give rollouts the height of the road: ``z(t) = z(current) + h(xy_t) - h(xy_current)``.

    h is looked up every 0.5 s on the level of the last look-up, so that an agent follows a ramp and does not jump to
    the bridge above it; between look-ups it is interpolated.

    Args:
        poses: ``[R, A, T, 3]`` x, y, heading at 10 Hz from the step after the current one on.
        start: ``[A, 3]`` x, y, z at the current step, of the agents' centres [m].
        points: ``[N, 3]`` map points [m]; they and ``start`` are brought to the device of the poses.

    Returns:
        ``[R, A, T, 4]`` x, y, z, heading.

    Raises:
        ValueError: another number of agents, or a pose that is not finite.

    Examples:
        >>> kerb = torch.tensor([[x, 0.0, float(x > 5)] for x in range(20)])
        >>> poses = torch.arange(1.0, 11.0)[:, None] * torch.tensor([1.0, 0.0, 0.0])
        >>> lift(poses[None, None], torch.tensor([[0.0, 0.0, 0.75]]), kerb)[0, 0, -1]
        tensor([10.0000,  0.0000,  1.7500,  0.0000])
    """
    if poses.shape[1] != len(start):
        raise ValueError(
            f"poses of {poses.shape[1]} agents do not fit the starts of {len(start)}; give the same agents."
        )

    def refused() -> str:
        agent = int((~torch.isfinite(poses)).any(-1).any(-1).any(0).nonzero()[0])
        return f"a pose of agent {agent} is not finite, so it has no height; mend the rollout."

    require(torch.isfinite(poses).all(), refused)
    ground = Ground(points.to(poses.device))
    start = start.to(poses)
    first = ground.height(start[:, :2], start[:, 2]).expand(poses.shape[:2])
    rise = climb(ground, poses, start[:, 2].expand(poses.shape[:2]), first)
    return torch.cat((poses[..., :2], (start[:, 2, None] + rise)[..., None], poses[..., 2:]), -1)


def climb(ground: Ground, poses: Tensor, height: Tensor, below: Tensor) -> Tensor:
    """How far agents rise as they move, see :func:`lift`.

    Args:
        ground: of the map.
        poses: ``[..., T, 3]`` or ``[..., T, 2]``, x, y at 10 Hz from the step after the current one on.
        height: ``[...]``, z of the agents' centres at the current step [m].
        below: ``[...]``, height of the ground below them [m].

    Returns:
        ``[..., T]``, change of z since the current step [m].

    Examples:
        >>> ground = Ground(torch.tensor([[x, 0.0, float(x > 5)] for x in range(20)]))
        >>> ahead = torch.arange(1.0, 11.0)[:, None] * torch.tensor([[[1.0, 0.0]]])
        >>> climb(ground, ahead, torch.tensor([0.75]), torch.tensor([0.0]))[0, [0, 4, 9]]
        tensor([0., 0., 1.])
    """
    knots = _knots(poses.shape[-2])
    # The height above the ground is kept in every look-up, so that an agent that stands finds the same point again.
    above, heights = height - below, [below]
    for knot in knots[1:]:
        heights.append(ground.height(poses[..., knot - 1, :2], heights[-1] + above))
    return _interpolate(knots, torch.stack(heights, -1) - below[..., None])


def _knots(steps: int) -> list[int]:
    """Steps at which the map is looked at: the current one (0), every :data:`KNOT_STEPS`-th, the last one."""
    return [*range(0, steps, KNOT_STEPS), steps]


def _interpolate(knots: list[int], values: Tensor) -> Tensor:
    """Values ``[..., len(knots)]`` at the knots -> ``[..., knots[-1]]`` at the steps 1, 2, ..., knots[-1]."""
    steps = torch.arange(1, knots[-1] + 1, device=values.device)
    left = (steps - 1) // KNOT_STEPS
    start, end = left * KNOT_STEPS, ((left + 1) * KNOT_STEPS).clamp(max=knots[-1])
    part = ((steps - start) / (end - start)).to(values)
    return torch.lerp(values[..., left], values[..., left + 1], part)
