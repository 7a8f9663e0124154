"""Relative poses between nodes and what they look at, and attention over such edges (SMART, arXiv 2405.15677).

An edge goes from a receiver to one of its few neighbours. Its feature is where the neighbour stands as seen from the
receiver, how it is turned, and for edges along time the gap. SMART has distance, bearing and heading; here are the
place and the direction as two numbers each, which do not jump where an angle does. Neighbours are the nearest within a
radius, at most so many, so that cost is linear in nodes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envs.geometry.frames import to_local

METRES = 10.0
"""Metres that count as one in a feature."""
PERIODS = 0.2, 6.0
"""Shortest and longest period of the first waves, in what counts as one: 2 m and 60 m of a place."""
SECONDS = 1.0
"""Seconds that count as one."""
CPU_EDGES = 4096
"""Edges that are worked on at a time on a CPU."""


class Edges(NamedTuple):
    """From each of N receivers to K neighbours.

    Attributes:
        index: ``[N, K]`` rows of what is looked at.
        valid: ``[N, K]`` bool.
        feature: ``[N, K, C]`` embedding of the relative pose.
    """

    index: Tensor
    valid: Tensor
    feature: Tensor


class FourierEmbedding(nn.Module):
    """Embeds a few numbers by sines and cosines of learned frequencies; an MLP for each number, summed.

    Args:
        inputs: numbers of an edge.
        width: channels.
        frequencies: of each number.

    Examples:
        >>> FourierEmbedding(3, 16, 4)(torch.zeros(5, 7, 3)).shape
        torch.Size([5, 7, 16])
    """

    def __init__(self, inputs: int, width: int, frequencies: int) -> None:
        super().__init__()
        waves = torch.logspace(-math.log10(PERIODS[1]), -math.log10(PERIODS[0]), frequencies)
        self.frequency = nn.Parameter(waves.expand(inputs, -1).clone())
        self.first = nn.Parameter(torch.empty(inputs, 2 * frequencies + 1, width))
        self.bias = nn.Parameter(torch.zeros(inputs, 1, width))
        self.norm, self.out = nn.LayerNorm(width), nn.Linear(width, width)
        nn.init.normal_(self.first, std=(2 * frequencies + 1) ** -0.5)

    def forward(self, value: Tensor) -> Tensor:
        """``[*, inputs]`` to ``[*, width]``."""
        # Part by part, so that what lies between two layers stays in the cache of a CPU.
        rows = value.flatten(0, -2)
        parts = rows.split(CPU_EDGES if value.device.type == "cpu" else max(1, len(rows)))
        return torch.cat([self._embed(part) for part in parts]).view(*value.shape[:-1], self.out.out_features)

    def _embed(self, value: Tensor) -> Tensor:
        value = value.T[..., None]  # [inputs, n, 1]
        angle = 2 * math.pi * value * self.frequency[:, None]
        waves = torch.cat((angle.cos(), angle.sin(), value), -1)
        said = torch.baddbmm(self.bias, waves, self.first).relu().sum(0)
        return self.out(F.relu(self.norm(said)))


def relative(receiver: Tensor, sender: Tensor) -> Tensor:
    """Place and direction of poses ``[*, 3]`` seen from others: ``[*, 4]``.

    Examples:
        >>> relative(torch.tensor([0.0, 0.0, 0.0]), torch.tensor([0.0, 20.0, 0.0]))
        tensor([0., 2., 1., 0.])
    """
    local = to_local(sender, receiver)
    return torch.cat((local[..., :2] / METRES, local[..., 2:].cos(), local[..., 2:].sin()), -1)


class EdgeAttention(nn.Module):
    """Attention of nodes to their neighbours, whose keys and values know the relative pose; gated, then a feed-forward.

    Args:
        width: channels.
        heads: attention heads.
        feed: inner channels of the feed-forward layer.
        dropout: on both branches.
        own: nodes look at nodes of their own kind, which are normed alike.
    """

    def __init__(self, width: int, heads: int, feed: int, dropout: float, *, own: bool) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.norm_source = None if own else nn.LayerNorm(width)
        self.query, self.source = nn.Linear(width, width), nn.Linear(width, 2 * width)
        self.edge = nn.Linear(width, 2 * width, bias=False)
        self.gate, self.skip, self.out = nn.Linear(2 * width, width), nn.Linear(width, width), nn.Linear(width, width)
        self.norm_feed = nn.LayerNorm(width)
        self.feed = nn.Sequential(nn.Linear(width, feed), nn.ReLU(), nn.Dropout(dropout), nn.Linear(feed, width))
        self.dropout = nn.Dropout(dropout)

    def remember(self, source: Tensor) -> Tensor:
        """Keys and values ``[n, 2 * width]`` of what is looked at ``[n, width]``, without the edges' share."""
        norm = self.norm if self.norm_source is None else self.norm_source
        return self.source(norm(source))

    def forward(self, x: Tensor, remembered: Tensor, edges: Edges) -> Tensor:
        """Nodes ``[N, width]`` after looking at their neighbours among ``remembered`` (:meth:`remember`)."""
        normed = self.norm(x)
        query = self.query(normed) * (x.shape[-1] // self.heads) ** -0.5
        nodes = max(1, CPU_EDGES // max(1, edges.index.shape[1])) if x.device.type == "cpu" else max(1, len(x))
        parts = zip(*(value.split(nodes) for value in (query, *edges)), strict=True)
        seen = torch.cat([self._look(remembered, *part) for part in parts])
        gate = self.gate(torch.cat((seen, normed), -1)).sigmoid()
        x = x + self.dropout(self.out(seen + gate * (self.skip(normed) - seen)))
        return x + self.dropout(self.feed(self.norm_feed(x)))

    def _look(self, remembered: Tensor, query: Tensor, index: Tensor, valid: Tensor, feature: Tensor) -> Tensor:
        """``[n, width]``: what some nodes see over their edges."""
        rows, count = index.shape
        there = remembered.index_select(0, index.flatten())
        both = torch.addmm(there, feature.flatten(0, 1), self.edge.weight.T).view(
            rows, count, 2, self.heads, query.shape[-1] // self.heads
        )
        keys, values = both.unbind(2)  # [n, k, heads, d]
        score = (keys * query.view(rows, 1, *keys.shape[2:])).sum(-1)
        score = score.masked_fill(~valid[..., None], torch.finfo(score.dtype).min)
        weight = score.softmax(1) * valid[..., None]
        return (values * weight[..., None]).sum(1).flatten(1)
