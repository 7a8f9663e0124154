"""How far along a path something is."""

from __future__ import annotations

import torch
from torch import Tensor


def distance_along(path: Tensor, valid: Tensor, points: Tensor) -> Tensor:
    """Length of a path up to the place that is nearest to a point; the first one on ties.

    Holes of the path are bridged by straight lines. Beyond its ends the path does not go on, so there the distance is
    that of the end.

    Args:
        path: ``[..., L, 2]`` [m].
        valid: ``[..., L]`` bool.
        points: ``[..., 2]``, the leading dims broadcast against those of the path [m].

    Returns:
        ``[...]`` [m]; 0 for a path of one point or none.

    Examples:
        >>> path = torch.tensor([[0.0, 0], [10, 0], [10, 10]])
        >>> distance_along(path, torch.tensor([True, True, True]), torch.tensor([[4.0, 1], [12, 5], [10, 99]]))
        tensor([ 4., 15., 20.])
    """
    path = _bridged(path, valid)
    start, delta = path[..., :-1, :], path[..., 1:, :] - path[..., :-1, :]
    length = delta.norm(dim=-1)
    offset = points[..., None, :] - start
    along = (offset * delta).sum(-1) / length.square().clamp(min=1e-12)
    along = along.clamp(0, 1)
    nearest = (offset - along[..., None] * delta).square().sum(-1).argmin(-1, keepdim=True)
    arc = length.cumsum(-1) - length + along * length
    return arc.gather(-1, nearest)[..., 0]


def point_along(path: Tensor, valid: Tensor, distance: Tensor) -> Tensor:
    """The place at a distance along a path; its ends stand for what lies beyond them.

    Args:
        path: ``[..., L, 2]`` [m].
        valid: ``[..., L]`` bool.
        distance: ``[..., n]`` [m].

    Returns:
        ``[..., n, 2]``.

    Examples:
        >>> path = torch.tensor([[0.0, 0], [10, 0], [10, 10]])
        >>> point_along(path, torch.tensor([True, True, True]), torch.tensor([4.0, 15.0, 99.0]))
        tensor([[ 4.,  0.], [10.,  5.], [10., 10.]])
    """
    path = _bridged(path, valid)
    length = (path[..., 1:, :] - path[..., :-1, :]).norm(dim=-1)
    end = length.cumsum(-1).contiguous()
    segment = torch.searchsorted(end, distance.contiguous()).clamp(max=length.shape[-1] - 1)
    start, inside = end.gather(-1, segment) - length.gather(-1, segment), length.gather(-1, segment)
    share = ((distance - start) / inside.clamp(min=1e-9)).clamp(0, 1)
    index = segment[..., None].expand(*segment.shape, 2)
    return torch.lerp(path.gather(-2, index), path.gather(-2, index + 1), share[..., None])


def _bridged(path: Tensor, valid: Tensor) -> Tensor:
    """Put the valid point before, or the first one, in the place of each invalid point."""
    steps = torch.arange(valid.shape[-1], device=valid.device)
    last = torch.where(valid, steps, -1).cummax(-1).values
    index = torch.where(last < 0, valid.int().argmax(-1, keepdim=True), last)
    return path.gather(-2, index[..., None].expand(path.shape))
