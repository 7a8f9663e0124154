"""Attention that sees relative poses, at the memory of plain attention.

Every token has a pose. Writing ``g`` for the rigid motion of a pose and ``rho(g)`` for its 3 x 3 matrix, the product
``rho(g_i)^-1 rho(g_j)`` depends on the pose of j seen from i only. So queries, keys and values are split into blocks of
three channels, each multiplied by the matrix of its OWN token, and the output by the inverse matrix of the query:
scores and values then hold relative poses, nothing of size (queries x keys) is built but the scores, and keys and
values can be cached in the frame of the scene (cf. Miyato et al., "GTA", ICLR 2024).

On top each query has a *gaze*: a point that it chooses in its own frame and a width. The log-weight
``-w |c_i - x_j|^2 / 2`` is linear in features of j up to a term that softmax cancels, so it costs three more channels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from envs.geometry.frames import rotate

METRES = 10.0
"""Metres that count as one in the matrices."""
GAZE = 4
"""Channels after those of a head: three of its gaze, and a zero, since fused attention likes multiples of four."""
DECISIONS = 4
"""Decisions that attend at a time where all are given: later nodes, which none of them may see, are left out."""


class KeyValues(NamedTuple):
    """Keys and values of tokens, in the frame of the scene.

    Attributes:
        keys: ``[B, H, n, D + GAZE]``.
        values: ``[B, H, n, D + GAZE]``, the last ones 0: fused attention wants keys and values of one width.
    """

    keys: Tensor
    values: Tensor


class NodeMasks(NamedTuple):
    """What nodes see of each other.

    Attributes:
        own: broadcastable to ``[B * A, 1, decisions, remembered decisions]`` bool, along the own past.
        everybody: broadcastable to ``[B, 1, m, n]``, added to the scores (:func:`added`): nothing of a later decision.
    """

    own: Tensor
    everybody: Tensor


def added(mask: Tensor) -> Tensor:
    """A mask that is true where one may look, as what is added to scores: made once, it serves all layers.

    Examples:
        >>> added(torch.tensor([True, False]))
        tensor([0., -inf])
    """
    return torch.zeros(mask.shape, device=mask.device).masked_fill(~mask, -torch.inf)


class RelativeAttention(nn.Module):
    """Multi-head attention between tokens with poses, invariant to moving and turning the scene.

    Args:
        width: channels of a token.
        heads: H; ``width`` is a multiple of 2 H.
        gaze: width of a head's gaze at the start of training [m], of the first and of the last head.

    Raises:
        ValueError: ``width`` is no multiple of twice the ``heads``.

    Examples:
        >>> attention = RelativeAttention(32, heads=2)
        >>> x, pose = torch.randn(1, 5, 32), torch.randn(1, 5, 3)
        >>> attention(x, pose, attention.remember(x, pose)).shape
        torch.Size([1, 5, 32])
    """

    def __init__(self, width: int, heads: int, gaze: tuple[float, float] = (8.0, 60.0)) -> None:
        super().__init__()
        if width % (2 * heads):
            raise ValueError(f"width must be a multiple of twice the heads, got {width} and {heads}.")
        self.heads, self.dim = heads, width // heads
        self.blocks = self.dim // 4
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.gaze = nn.Linear(width, 3 * heads)
        self.out = nn.Linear(width, width)
        nn.init.zeros_(self.gaze.weight)
        nn.init.zeros_(self.gaze.bias)
        widths = torch.logspace(*torch.tensor(gaze).log10().tolist(), heads)
        self.register_buffer("precision", widths.pow(-2))

    def remember(self, x: Tensor, pose: Tensor) -> KeyValues:
        """Keys and values of tokens ``x`` ``[B, n, width]`` at ``pose`` ``[B, n, 3]``."""
        key, value = self._split(self.key_value(x), 2)
        pose = pose[:, None]
        turn, place = _turn(pose[..., 2]), _place(pose)
        xy = (pose[..., :2] / METRES).expand(*key.shape[:-1], 2)
        window = torch.cat((xy, -(xy[..., :1] ** 2 + xy[..., 1:] ** 2) / 2, torch.zeros_like(xy[..., :1])), -1)
        still = torch.zeros_like(window)
        return KeyValues(self._move(key, turn, place, window), self._move(value, turn, place, still))

    def forward(self, x: Tensor, pose: Tensor, memory: KeyValues, mask: Tensor | None = None) -> Tensor:
        """Attend from tokens to remembered ones.

        Args:
            x: ``[B, m, width]`` queries.
            pose: ``[B, m, 3]``.
            memory: of n tokens.
            mask: broadcastable to ``[B, H, m, n]``: bool, true where a query may look, or :func:`added` to the scores.

        Returns:
            ``[B, m, width]``.
        """
        seen = self._attend(self._queries(x, pose), memory, mask)
        return self._merge(seen, pose)

    def _queries(self, x: Tensor, pose: Tensor) -> Tensor:
        """``[B, H, m, D + GAZE]``."""
        (query,) = self._split(self.query(x), 1)
        pose = pose[:, None]
        return self._query(query, pose, self._gaze(x, pose))

    @staticmethod
    def _attend(query: Tensor, memory: KeyValues, mask: Tensor | None) -> Tensor:
        # Places relative to each other are differences of large numbers, which bfloat16 would lose.
        with torch.autocast(query.device.type, enabled=False):
            return F.scaled_dot_product_attention(query, memory.keys, memory.values, attn_mask=mask, scale=1.0)

    def _merge(self, seen: Tensor, pose: Tensor) -> Tensor:
        """Heads ``[B, H, m, D + GAZE]`` to ``[B, m, width]``, in the frames of the queries."""
        return self.out(self._back(seen[..., : self.dim], pose[:, None]).transpose(1, 2).flatten(2))

    def _split(self, x: Tensor, parts: int) -> tuple[Tensor, ...]:
        """``[B, n, parts * width]`` to ``parts`` times ``[B, H, n, D]``, in float32 whatever the layer gave."""
        return tuple(x.float().unflatten(-1, (parts, self.heads, self.dim)).permute(2, 0, 3, 1, 4))

    def _blocks(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Vectors ``[..., blocks, 2]``, their weights ``[..., blocks]``, and the channels without geometry."""
        vector, weight, rest = x.split((2 * self.blocks, self.blocks, self.dim - 3 * self.blocks), -1)
        return vector.unflatten(-1, (self.blocks, 2)), weight, rest

    def _move(self, x: Tensor, turn: Tensor, place: Tensor, more: Tensor) -> Tensor:
        """Multiply by rho(g): turn the vectors and shift them by weight times position; then ``more`` channels."""
        vector, weight, rest = self._blocks(x)
        vector = turned(vector, turn) + weight[..., None] * place
        return torch.cat((vector.flatten(-2), weight, rest, more), -1)

    def _query(self, x: Tensor, pose: Tensor, more: Tensor) -> Tensor:
        """Multiply by rho(g)^-T, scaled as in dot-product attention, so that q . k = x^T rho(g_i^-1 g_j) key.

        ``more`` channels follow.
        """
        vector, weight, rest = self._blocks(x * self.dim**-0.5)
        vector = turned(vector, _turn(pose[..., 2]))
        return torch.cat((vector.flatten(-2), weight - (vector * _place(pose)).sum(-1), rest, more), -1)

    def _back(self, x: Tensor, pose: Tensor) -> Tensor:
        """Multiply by rho(g)^-1: what was seen, in the frame of the query."""
        vector, weight, rest = self._blocks(x)
        vector = turned(vector - weight[..., None] * _place(pose), _turn(-pose[..., 2]))
        return torch.cat((vector.flatten(-2), weight, rest), -1)

    def _gaze(self, x: Tensor, pose: Tensor) -> Tensor:
        """``[B, H, m, GAZE]``: w * (c_x, c_y, 1, 0) for a centre c in the scene's frame, in units of METRES."""
        offset, width = self.gaze(x).float().unflatten(-1, (self.heads, 3)).transpose(1, 2).split((2, 1), -1)
        precision = self.precision[:, None, None] * METRES**2 * width.exp()
        centre = pose[..., :2] / METRES + rotate(offset, pose[..., 2])
        return torch.cat((precision * centre, precision, torch.zeros_like(precision)), -1)


def _turn(angle: Tensor) -> Tensor:
    """Cosine and sine of angles ``[..., n]``, as ``[..., n, 1, 2]``."""
    return torch.stack((angle.cos(), angle.sin()), -1)[..., None, :]


def _place(pose: Tensor) -> Tensor:
    """Positions of poses ``[..., n, 3]`` in METRES, as ``[..., n, 1, 2]``."""
    return pose[..., None, :2] / METRES


def turned(vector: Tensor, turn: Tensor) -> Tensor:
    """Turn vectors ``[..., 2]`` by angles of which ``turn`` has cosine and sine.

    Examples:
        >>> turned(torch.tensor([[3.0, 4.0]]), torch.tensor([[0.0, 1.0]]))
        tensor([[-4.,  3.]])
    """
    if torch.compiler.is_compiling():  # inductor fuses what is written out, and knows no complex numbers
        (x, y), (cos, sin) = vector.unbind(-1), turn.unbind(-1)
        return torch.stack((x * cos - y * sin, x * sin + y * cos), -1)
    # One product of complex numbers is a fraction of that work.
    return torch.view_as_real(torch.view_as_complex(vector) * torch.view_as_complex(turn))


class NodeAttention(RelativeAttention):
    """Attention between the nodes of a scene: agents x decisions, decision by decision.

    The first heads look along the agent's own past only, as a recurrent network would; the rest look at all agents.
    Both share keys and values, so one cache serves them.

    Args:
        width: channels of a node.
        heads: H; a third of them, at least one, look along the own past.

    Examples:
        >>> attention = NodeAttention(32, heads=2)
        >>> x, pose = torch.randn(1, 6, 32), torch.randn(1, 6, 3)  # two agents, three decisions
        >>> own = torch.ones(3, 3, dtype=torch.bool).tril()
        >>> masks = NodeMasks(own, added(own.repeat_interleave(2, 0).repeat_interleave(2, 1)[None, None]))
        >>> attention(x, pose, attention.remember(x, pose), masks, agents=2).shape
        torch.Size([1, 6, 32])
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__(width, heads, gaze=(60.0, 8.0))  # the own past may lie far behind
        self.own = max(1, heads // 3)

    def forward(self, x: Tensor, pose: Tensor, memory: KeyValues, masks: NodeMasks, agents: int) -> Tensor:
        """Attend from nodes to remembered ones.

        Args:
            x: ``[B, m, width]``, m a multiple of A.
            pose: ``[B, m, 3]``.
            memory: of n nodes, n a multiple of A.
            masks: what a node sees.
            agents: A.

        Returns:
            ``[B, m, width]``.
        """
        seen = self._look(self._queries(x, pose), memory, masks, agents)
        return self._merge(seen, pose)

    @torch.compiler.disable  # torch 2.13 compiles attention over a part of the heads to wrong numbers on a CPU
    def _look(self, query: Tensor, memory: KeyValues, masks: NodeMasks, agents: int) -> Tensor:
        """``[B, H, m, D + GAZE]``: the own past in the first heads, everybody in the rest."""
        own = self._along(query, memory, masks.own, agents)
        return torch.cat((own, self._everybody(query, memory, masks.everybody, DECISIONS * agents)), 1)

    def _along(self, query: Tensor, memory: KeyValues, mask: Tensor, agents: int) -> Tensor:
        """``[B, own, m, D + GAZE]``: what the first heads see."""

        def by_agent(heads: Tensor) -> Tensor:
            """``[B, H, decisions * A, D]`` to ``[B * A, own, decisions, D]``."""
            return heads[:, : self.own].unflatten(2, (-1, agents)).permute(0, 3, 1, 2, 4).flatten(0, 1)

        past = KeyValues(by_agent(memory.keys), by_agent(memory.values))
        seen = self._attend(by_agent(query), past, mask)
        return seen.unflatten(0, (len(query), agents)).permute(0, 2, 3, 1, 4).flatten(2, 3)

    def _everybody(self, query: Tensor, memory: KeyValues, mask: Tensor, chunk: int) -> Tensor:
        """What the other heads see: some decisions at a time where all are there, up to the last of each lot."""
        keys, values = memory.keys[:, self.own :], memory.values[:, self.own :]
        nodes, remembered = query.shape[2], keys.shape[2]
        if nodes != remembered:
            return self._attend(query[:, self.own :], KeyValues(keys, values), mask)
        seen = []
        for first in range(0, nodes, chunk):
            last = min(first + chunk, nodes)
            earlier = KeyValues(keys[:, :, :last], values[:, :, :last])
            seen.append(self._attend(query[:, self.own :, first:last], earlier, mask[..., first:last, :last]))
        return torch.cat(seen, 2)


class FeedForward(nn.Sequential):
    """Two layers with a GELU between them; ``inner`` channels in the middle."""

    def __init__(self, width: int, inner: int) -> None:
        super().__init__(nn.Linear(width, inner), nn.GELU(), nn.Linear(inner, width))
