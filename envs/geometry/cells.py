"""Points of the world gathered in nested boxes, so that those near each other share what is near them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_CELL_SIZES = (32.0, 8.0, 1.0)
"""Sides of the cells in which queries share their candidate segments, from coarse to fine [m]."""


@dataclass(frozen=True)
class Boxes:
    """One level of nested boxes of query points.

    Attributes:
        centre: ``[3, m]`` [m].
        half: ``[3, m]``, half sides, no larger than the points inside need [m].
        parent: ``[m]`` int64, the box of the coarser level around each.
    """

    centre: Tensor
    half: Tensor
    parent: Tensor


def nested_boxes(points: Tensor, stretch: float) -> tuple[list[Boxes], Tensor]:
    """Gather points in boxes.

    Args:
        points: ``[3, n]`` [m].
        stretch: how much a metre of height counts; cells are lower than they are wide by twice that.

    Returns:
        The levels from coarse to fine, and the finest box ``[n]`` int64 of each point.
    """
    low = high = points
    inner_to_outer: list[Tensor] = []
    sides: list[tuple[Tensor, Tensor]] = []
    for size in reversed(_CELL_SIZES):
        cell, owner = torch.unique(_cell_key(low, size, stretch), return_inverse=True)
        index = owner.expand(3, -1)
        low = low.new_full((3, len(cell)), torch.inf).scatter_reduce_(1, index, low, "amin")
        high = high.new_full((3, len(cell)), -torch.inf).scatter_reduce_(1, index, high, "amax")
        inner_to_outer.append(owner)
        sides.append((low, high))
    leaf, *parents = inner_to_outer
    parents.append(torch.zeros_like(low[0], dtype=torch.int64))
    levels = [
        Boxes((low + high) / 2, (high - low) / 2, parent) for (low, high), parent in zip(sides, parents, strict=True)
    ]
    return levels[::-1], leaf


def _cell_key(points: Tensor, size: float, stretch: float) -> Tensor:
    """One int64 for the cell of each point, ``[3, n]`` -> ``[n]``; far cells share a key, which costs only time."""
    sides = torch.tensor([[size], [size], [size / (2 * stretch)]], device=points.device)
    limit = 1 << 20
    x, y, z = (points / sides).floor_().clamp_(-limit, limit - 1).long().add_(limit)
    return (x * 2 * limit + y) * 2 * limit + z
