"""What lies next to nodes: indices of the nearest things, and what stands at them."""

from __future__ import annotations

import torch
from torch import Tensor

TIE = 1e-4
"""Of things in order, by so much each counts as farther than the one before [m^2]."""


@torch.no_grad()
def nearest(pose: Tensor, others: Tensor, mask: Tensor, most: int, *, ordered: bool = False) -> tuple[Tensor, Tensor]:
    """The nearest things of each node, in no order.

    Args:
        pose: ``[B, Q, 3]`` of the nodes.
        others: ``[B, n, 3]``.
        mask: broadcastable to ``[B, Q, n]`` bool, true where a node may look.
        most: K, or n where that is less.

    Keyword Args:
        ordered: of things equally far, which pieces of one length and lanes of one width are, the first come first;
            otherwise rounding chooses.

    Returns:
        Squared distances ``[B, Q, K]`` [m^2], infinite where there is nothing, and indices into ``n``.

    Examples:
        >>> places = torch.tensor([[[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]])
        >>> nearest(places[:, :1], places, torch.tensor([False, True]), most=1)
        (tensor([[[25.]]]), tensor([[[1]]]))
    """
    dx = pose[:, :, None, 0] - others[:, None, :, 0]
    dy = pose[:, :, None, 1] - others[:, None, :, 1]
    square = torch.addcmul(dx.square(), dy, dy)
    if ordered:
        square = square + TIE * torch.arange(others.shape[1], device=others.device)
    square = square.masked_fill(~mask, torch.inf)
    near, index = square.topk(min(most, square.shape[-1]), largest=False, sorted=False)
    return near, index


def rows_of(values: Tensor, index: Tensor) -> Tensor:
    """Indices ``[B, Q, K]`` into ``[B, n]`` as indices into ``[B * n]``."""
    return torch.arange(len(values), device=values.device)[:, None, None] * values.shape[1] + index


def gather(values: Tensor, index: Tensor) -> Tensor:
    """``[B, n, d]`` at ``[B, Q, K]`` to ``[B, Q, K, d]``."""
    # The gradient of index_select is one sum by row; that of indexing with tensors is many times slower on a CPU.
    rows = rows_of(values, index).flatten()
    return values.flatten(0, 1).index_select(0, rows).view(*index.shape, values.shape[-1])
