"""Angles and rigid frames of the plane. A pose is ``(x, y, heading)``."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def wrap_angle(angle: Tensor) -> Tensor:
    """Wrap angles to ``[-pi, pi)`` [rad].

    Args:
        angle: any shape [rad].

    Examples:
        >>> wrap_angle(torch.tensor([0.0, 3 * math.pi / 2]))
        tensor([ 0.0000, -1.5708])
    """
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def rotate(vector: Tensor, angle: Tensor) -> Tensor:
    """Rotate vectors of the plane counter-clockwise.

    Args:
        vector: ``[..., 2]``.
        angle: ``[...]`` [rad], broadcast against the vectors.

    Examples:
        >>> rotate(torch.tensor([1.0, 0.0]), torch.tensor(math.pi / 2)).round(decimals=6)
        tensor([-0., 1.])
    """
    x, y = vector.unbind(-1)
    cos, sin = angle.cos(), angle.sin()
    return torch.stack((x * cos - y * sin, x * sin + y * cos), -1)


def to_local(pose: Tensor, frame: Tensor) -> Tensor:
    """Express poses in a frame.

    Args:
        pose: ``[..., 3]``.
        frame: ``[..., 3]``, the pose of the frame itself, broadcast against ``pose``.

    Returns:
        ``[..., 3]``, heading wrapped.

    Examples:
        >>> to_local(torch.tensor([2.0, 3.0, 0.0]), torch.tensor([2.0, 1.0, math.pi / 2])).round(decimals=4)
        tensor([ 2.0000, -0.0000, -1.5708])
    """
    xy = rotate(pose[..., :2] - frame[..., :2], -frame[..., 2])
    return torch.cat((xy, wrap_angle(pose[..., 2:] - frame[..., 2:])), -1)


def to_world(pose: Tensor, frame: Tensor) -> Tensor:
    """Inverse of :func:`to_local`.

    Examples:
        >>> to_world(torch.tensor([2.0, 0.0, 0.0]), torch.tensor([2.0, 1.0, math.pi / 2])).round(decimals=4)
        tensor([2.0000, 3.0000, 1.5708])
    """
    xy = rotate(pose[..., :2], frame[..., 2]) + frame[..., :2]
    return torch.cat((xy, wrap_angle(pose[..., 2:] + frame[..., 2:])), -1)


def beside(path: Tensor, pose: Tensor, start: Tensor, share: float | Tensor) -> Tensor:
    """A path moved aside: a share of the offset of a pose from the path's start stays, as seen along the path.

    Args:
        path: ``[..., F, 3]``.
        pose: ``[..., 3]`` of who lies beside the path.
        start: ``[..., 3]`` where the path comes from.
        share: number, ``[..., 1]``, or ``[..., F]``, of each pose; 0 is the path itself.

    Returns:
        ``[..., F, 3]``.

    Examples:
        >>> straight, aside = torch.tensor([[5.0, 0.0, 0.0]]), torch.tensor([0.0, 2.0, 0.0])
        >>> beside(straight, aside, torch.zeros(3), share=0.75)
        tensor([[5.0000, 1.5000, 0.0000]])
    """
    offset = to_local(pose, start)[..., None, :]
    return to_world((share[..., None] if isinstance(share, Tensor) else share) * offset, path)
