"""What lies around an agent, read in its own frame through a small network.

Attention with relative poses mixes what it sees linearly. To keep a lane or a gap, a policy needs sharp, non-linear
functions of the few nearest things, so every node also pools over the map pieces and the agents next to it.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpa.models.neighbours import gather, nearest, rows_of
from envs.geometry.frames import to_local

NEAREST_PIECES, NEAREST_AGENTS = 16, 8
"""Map pieces (with lights) and agents that a node reads one by one."""
SCALE = 10.0
"""Metres that count as one in a feature."""
FEATURES = 5
CPU_NODES = 256
"""Nodes that are pooled at a time on a CPU."""
LOWEST = -1.0
"""Below every value of GELU (its minimum is -0.17)."""


class Vicinity(nn.Module):
    """Pools over the nearest tokens of a set, seen from each node.

    Args:
        width: channels of tokens and nodes.
        nearest: tokens that a node sees at most.

    Examples:
        >>> vicinity = Vicinity(32, nearest=4)
        >>> pose, token_pose = torch.zeros(1, 2, 3), torch.randn(1, 9, 3)
        >>> vicinity(pose, torch.randn(1, 9, 32), token_pose, torch.ones(1, 1, 9, dtype=torch.bool)).shape
        torch.Size([1, 2, 32])
    """

    def __init__(self, width: int, nearest: int) -> None:
        super().__init__()
        self.nearest = nearest
        self.token = nn.Linear(width, width)
        self.relative = nn.Linear(FEATURES, width)
        self.inner = nn.Sequential(nn.GELU(), nn.Linear(width, width), nn.GELU())
        self.out = nn.Linear(width, width)

    def forward(self, pose: Tensor, tokens: Tensor, token_pose: Tensor, mask: Tensor) -> Tensor:
        """Look around.

        Args:
            pose: ``[B, Q, 3]`` of the nodes.
            tokens: ``[B, n, width]``.
            token_pose: ``[B, n, 3]``.
            mask: broadcastable to ``[B, Q, n]`` bool, true where a node may see a token.

        Returns:
            ``[B, Q, width]``; what no token contributes to is 0 before the last layer.
        """
        square, index = nearest(pose, token_pose, mask, self.nearest)
        near = square.sqrt()
        relative = to_local(gather(token_pose, index), pose[..., None, :])
        features = torch.cat(
            (relative[..., :2] / SCALE, relative[..., 2:].cos(), relative[..., 2:].sin(), near[..., None] / SCALE), -1
        )
        seen = torch.isfinite(near)[..., None]
        features = features.where(seen, features.new_zeros(()))
        pooled = self._pool(tokens, index, features, seen)
        return self.out(pooled.where(seen.any(-2), pooled.new_zeros(())))

    def _pool(self, tokens: Tensor, index: Tensor, features: Tensor, seen: Tensor) -> Tensor:
        """``[B, Q, width]``: the maximum over what each of the nearest tokens says."""
        # Part by part, so that what lies between two layers stays in the cache of a CPU: twice as fast.
        nodes = CPU_NODES if tokens.device.type == "cpu" else len(tokens) * index.shape[1]
        table, rows = self.token(tokens).flatten(0, 1) + self.relative.bias, rows_of(tokens, index)
        parts = zip(*(value.flatten(0, 1).split(nodes) for value in (rows, features, seen)), strict=True)
        pooled = [self._pool_part(table, *part) for part in parts]
        return torch.cat(pooled).view(*index.shape[:2], -1)

    def _pool_part(self, table: Tensor, rows: Tensor, features: Tensor, seen: Tensor) -> Tensor:
        """``[nodes, width]`` of ``[nodes, k, ...]``."""
        said = torch.addmm(table.index_select(0, rows.flatten()), features.flatten(0, 1), self.relative.weight.T)
        each = self.inner(said).view(*rows.shape, -1)
        # GELU is bounded below, so that an unseen token, at that bound, never wins the maximum.
        return each.masked_fill(~seen, LOWEST).amax(-2)
