"""Vocabularies of a grid: one motion for each cell in which motions end (after TrajTok, the winner of WOSAC 2025)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

LENGTH = 2.0
"""Of a cell, in its widths: along the way a motion may be farther off than aside."""
MAJORITY = 3
"""Of the eight cells around an empty one: from so many on it is filled."""


class Cells(NamedTuple):
    """Cells of a rectangle, row by row, the outermost of them empty.

    Attributes:
        shape: rows and columns.
        place: ``[cells, 2]`` middle of each [m].
        count: ``[cells]`` motions that end there.
        mean: ``[cells, 4, F]`` of their x, y, and cosine and sine of their headings.
    """

    shape: tuple[int, int]
    place: Tensor
    count: Tensor
    mean: Tensor


def grid(motions: Tensor, size: int, width: float) -> Tensor:
    """The mean of all motions, and of their mirror images, that end in one cell.

    An empty cell beside three that are not has the mean of theirs, bent so that it ends in its middle: what logs lack
    between their motions and beside them. Standing still comes first.

    Args:
        motions: ``[n, F, 3]`` of one class.
        size: entries at most, the cells with most motions.
        width: of a cell [m]; it is :data:`LENGTH` times as long.

    Returns:
        ``[V, F, 3]``, V less than ``size`` where fewer cells hold all motions.

    Examples:
        >>> ends = torch.tensor([[4.0, 0.0, 0.0], [4.0, 1.1, 0.1]])[:, None]
        >>> [[round(x, 1) for x in end] for end in grid(ends, 99, 1.0)[:, 0, :2].tolist()]
        [[0.0, 0.0], [2.0, -1.0], [2.0, 0.0], [2.0, 1.0], [4.0, -1.1], [4.0, 0.0], [4.0, 1.1], [6.0, 0.0]]
    """
    cells = _fill(_in_cells(motions, width))
    x, y, cos, sin = cells.mean.unbind(1)
    entries = torch.stack((x, y, torch.atan2(sin, cos)), -1)
    moves = cells.count.masked_fill((cells.place == 0).all(-1), 0)
    chosen = moves.argsort(descending=True, stable=True)[: min(size - 1, int((moves > 0).sum()))]
    return torch.cat((torch.zeros_like(motions[:1]), entries[chosen.sort().values]))


def _in_cells(motions: Tensor, width: float) -> Cells:
    """Where motions and their mirror images end."""
    both = torch.cat((torch.zeros_like(motions[:1]), motions, motions * motions.new_tensor([1.0, -1.0, -1.0])))
    side = motions.new_tensor([LENGTH * width, width])
    cell = (both[:, -1, :2] / side).round().long()
    first = cell.amin(0) - 1
    rows, columns = (cell.amax(0) - first + 2).tolist()
    index = ((cell - first) * torch.tensor([columns, 1])).sum(-1)
    values = torch.stack((both[..., 0], both[..., 1], both[..., 2].cos(), both[..., 2].sin()), 1)
    total = values.new_zeros(rows * columns, *values.shape[1:]).index_add_(0, index, values)
    count = torch.bincount(index, minlength=len(total)).to(values.dtype)
    place = (torch.cartesian_prod(torch.arange(rows), torch.arange(columns)) + first) * side
    return Cells((rows, columns), place, count, total / count.clamp(min=1)[:, None, None])


def _fill(cells: Cells) -> Cells:
    """Empty cells of which enough neighbours are not have their mean, and count less than any motion."""

    def around(value: Tensor) -> Tensor:
        """Sum over a cell and the eight around it, ``[cells, n]``."""
        planes = value.T.reshape(-1, 1, *cells.shape)
        return F.conv2d(planes, value.new_ones(1, 1, 3, 3), padding=1).flatten(1).T

    empty = cells.count == 0
    others = around((~empty)[:, None].to(cells.mean.dtype))
    near = (around(cells.mean.flatten(1)) / others.clamp(min=1)).view_as(cells.mean)
    ramp = torch.linspace(0, 1, near.shape[-1] + 1, dtype=near.dtype)[1:]
    near[:, :2] += (cells.place - near[:, :2, -1])[..., None] * ramp
    filled = empty & (others[:, 0] >= MAJORITY)
    mean = torch.where(filled[:, None, None], near, cells.mean)
    return cells._replace(count=torch.where(filled, 0.5, cells.count), mean=mean)
