"""Causal decoder over agents x decisions, with a cache (method.md section 2).

A *node* is an agent at the start of a decision. It knows the motion that it just made (its last token), when it is and
who it is. It attends to the nodes of all agents up to its own decision, which hold the tokens of earlier decisions only
(the block staircase), and to the encoded scene, both seen from where the agent is NOW.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from dpa.models.attention import GAZE, KeyValues, NodeAttention, NodeMasks, added
from dpa.models.decoder import NodeDecoder
from dpa.models.encoder import SceneMemory, motion_features


class NodeInputs(NamedTuple):
    """Nodes of one or several decisions of B rollouts (``Q`` nodes each).

    Attributes:
        recent: ``[B, Q, F + 1, 3]`` poses of the last decision.
        token: ``[B, Q]`` last token; V where there is none.
        step: ``[B, Q]`` index of the decision.
        kind: ``[B, Q]``.
        valid: ``[B, Q]`` bool, others may look at the node.
    """

    recent: Tensor
    token: Tensor
    step: Tensor
    kind: Tensor
    valid: Tensor


class MotionDecoder(NodeDecoder):
    """Logits of the next token of every node; see :class:`~dpa.models.decoder.NodeDecoder` for the arguments."""

    attention = NodeAttention

    def forward(
        self,
        nodes: NodeInputs,
        memory: SceneMemory,
        masks: NodeMasks,
        cache: NodeCache | None = None,
    ) -> Tensor:
        """Logits of B rollouts' nodes, B a multiple of the memory's S.

        Args:
            nodes: Q nodes, a multiple of A, decision by decision.
            memory: of the S scenes.
            masks: which nodes a node sees: of the nodes given, or of those in the cache.
            cache: nodes of earlier decisions; the given ones (Q = A) are added to it.

        Returns:
            ``[B, Q, V]``.
        """
        pose, agents = nodes.recent[:, :, -1], memory.agents.shape[1]
        x = self._look_around(self._embed(nodes, memory), nodes, memory)
        for index, layer in enumerate(self.layers):
            own = layer.remember(x, pose)
            seen = own if cache is None else cache.add(index, own)
            look = partial(layer.nodes, pose=pose, memory=seen, masks=masks, agents=agents)
            x = layer(x, pose, look, memory, index)
        return self.head(self.norm(x), nodes.kind)

    def _look_around(self, x: Tensor, nodes: NodeInputs, memory: SceneMemory) -> Tensor:
        """Add what lies next to each node: map pieces and lights, and the other agents at the same decision."""
        pose, agents = nodes.recent[:, :, -1], memory.agents.shape[1]
        x = x + memory.look_around(self.map_vicinity, pose)
        # Nodes of one decision side by side: [B * decisions, A].
        together, at = (value.unflatten(1, (-1, agents)).flatten(0, 1) for value in (x, pose))
        others = ~torch.eye(agents, dtype=torch.bool, device=x.device)
        mask = nodes.valid.unflatten(1, (-1, agents)).flatten(0, 1)[:, None, :] & others
        return x + self.agent_vicinity(at, together, at, mask).view_as(x)

    def _embed(self, nodes: NodeInputs, memory: SceneMemory) -> Tensor:
        scenes, agents = memory.agents.shape[:2]
        rollouts, decisions = len(nodes.token) // scenes, nodes.token.shape[1] // agents

        def each_node(per_agent: Tensor) -> Tensor:
            return per_agent.repeat_interleave(rollouts, 0).repeat(1, decisions, 1)

        motion = self.motion(motion_features(nodes.recent, each_node(memory.extent)))
        who = each_node(self.identity(memory.agents))
        return motion + self.token(nodes.token, nodes.kind) + self.time(nodes.step) + self.kind(nodes.kind) + who


class NodeCache:
    """Keys and values of the nodes of B running rollouts, in preallocated buffers.

    Rows may be at different decisions: :meth:`start` says where each row stands.

    Args:
        layers: decoder layers.
        shape: ``(B, H, T, A)``.
        dim: D, channels of a head.
        like: gives dtype and device.
    """

    def __init__(self, layers: int, shape: tuple[int, int, int, int], dim: int, like: Tensor) -> None:
        self.shape = shape
        self.keys = [like.new_zeros(*shape, dim + GAZE) for _ in range(layers)]
        self.values = [like.new_zeros(*shape, dim + GAZE) for _ in range(layers)]
        batch, _, horizon, agents = shape
        self.valid = torch.zeros(batch, horizon, agents, dtype=torch.bool, device=like.device)

    def clear(self) -> None:
        """Forget all nodes: what is in the buffers is not looked at any more."""
        self.valid.zero_()

    def start(self, step: Tensor, latest: int, valid: Tensor) -> NodeMasks:
        """Begin a decision and get its masks: each row sees the nodes up to its own decision.

        Args:
            step: ``[B]`` int64 decision of each row.
            latest: the largest of these.
            valid: ``[B, A]`` bool nodes.
        """
        self._rows, self._step = torch.arange(len(step), device=step.device), step
        self._last = latest + 1
        self.valid[self._rows, step] = valid
        earlier = torch.arange(self._last, device=step.device) <= step[:, None]
        everybody = (self.valid[:, : self._last] & earlier[..., None]).flatten(1)[:, None, None, :]
        return NodeMasks(earlier.repeat_interleave(valid.shape[1], 0)[:, None, None, :], added(everybody))

    @torch.compiler.disable  # it grows by a decision at a time
    def add(self, layer: int, nodes: KeyValues) -> KeyValues:
        """Write this decision's nodes and give all up to the last decision."""
        keys, values = self.keys[layer], self.values[layer]
        keys[self._rows, :, self._step] = nodes.keys
        values[self._rows, :, self._step] = nodes.values
        return KeyValues(keys[:, :, : self._last].flatten(2, 3), values[:, :, : self._last].flatten(2, 3))
