"""Causal decoder over agents x decisions, with a cache (method.md section 2).

A *node* is an agent at the start of a decision. It knows the motion that it just made (its last token), when it is and
who it is. It attends to the nodes of all agents up to its own decision, which hold the tokens of earlier decisions only
(the block staircase), and to the encoded scene, both seen from where the agent is NOW.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpa.models.motionlm.attention import (
    GAZE,
    FeedForward,
    KeyValues,
    NodeAttention,
    NodeMasks,
    RelativeAttention,
    added,
)
from dpa.models.motionlm.encoder import LENGTH_SCALE, SceneTokens
from dpa.models.motionlm.vicinity import Vicinity
from envs.geometry.frames import rotate, wrap_angle
from envs.scene import AgentKind

NEAREST_PIECES, NEAREST_AGENTS = 16, 8
"""Map pieces (with lights) and agents that a node reads one by one."""
SPEED_SCALE = 5.0
"""Metres of a decision's displacement that count as one in a feature."""


class SceneMemory(NamedTuple):
    """What decoding needs of an encoded scene; made once for all its rollouts.

    Attributes:
        layers: keys and values of the scene for each decoder layer.
        mask: ``[S, 1, 1, n]`` bool.
        surroundings: the tokens themselves, without agents: ``[S, n - A, width]``.
        surroundings_pose: ``[S, n - A, 3]``.
        agents: ``[S, A, width]`` scene embedding of each agent.
        extent: ``[S, A, 3]`` [m].
    """

    layers: tuple[KeyValues, ...]
    mask: Tensor
    surroundings: Tensor
    surroundings_pose: Tensor
    agents: Tensor
    extent: Tensor


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


class DecoderLayer(nn.Module):
    """Attention to nodes, attention to the scene, feed-forward; all pre-norm."""

    def __init__(self, width: int, heads: int, feed: int, dropout: float) -> None:
        super().__init__()
        self.norm_nodes, self.nodes = nn.LayerNorm(width), NodeAttention(width, heads)
        self.norm_scene, self.scene = nn.LayerNorm(width), RelativeAttention(width, heads)
        self.norm_feed, self.feed = nn.LayerNorm(width), FeedForward(width, feed)
        self.dropout = nn.Dropout(dropout)

    def remember(self, x: Tensor, pose: Tensor) -> KeyValues:
        """Keys and values of nodes ``x`` for this layer."""
        return self.nodes.remember(self.norm_nodes(x), pose)

    def forward(
        self, x: Tensor, pose: Tensor, nodes: KeyValues, masks: NodeMasks, memory: SceneMemory, index: int
    ) -> Tensor:
        """Nodes ``x`` ``[B, Q, width]`` after layer ``index``; ``nodes`` are all that they may look at."""
        agents, scene = memory.agents.shape[1], memory.layers[index]
        x = x + self.dropout(self.nodes(self.norm_nodes(x), pose, nodes, masks, agents))
        # The scene is shared by its rollouts: fold them into the queries instead of repeating keys and values.
        scenes = scene.keys.shape[0]
        folded = (t.unflatten(0, (scenes, -1)).flatten(1, 2) for t in (self.norm_scene(x), pose))
        seen = self.scene(*folded, scene, memory.mask)
        x = x + self.dropout(seen.view_as(x))
        return x + self.dropout(self.feed(self.norm_feed(x)))


class MotionDecoder(nn.Module):
    """Logits of the next token of every node.

    Args:
        vocab_size: V.
        width: channels.
        heads: attention heads.
        feed: inner channels of a feed-forward layer.
        layers: decoder layers.
        horizon: T.
        dropout: on every branch.
    """

    def __init__(
        self, vocab_size: int, width: int, heads: int, feed: int, layers: int, horizon: int, dropout: float = 0.0
    ) -> None:
        super().__init__()
        self.motion = nn.Sequential(nn.Linear(8, width), nn.GELU(), nn.Linear(width, width))
        self.token = nn.Embedding(vocab_size + 1, width)
        self.time = nn.Embedding(horizon, width)
        self.kind = nn.Embedding(len(AgentKind), width)
        self.identity = nn.Linear(width, width)
        self.map_vicinity = Vicinity(width, NEAREST_PIECES)
        self.agent_vicinity = Vicinity(width, NEAREST_AGENTS)
        self.layers = nn.ModuleList(DecoderLayer(width, heads, feed, dropout) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, vocab_size)

    def read_scene(self, tokens: SceneTokens, extent: Tensor) -> SceneMemory:
        """Keys and values of an encoded scene, for :meth:`forward`."""
        layers = tuple(layer.scene.remember(tokens.x, tokens.pose) for layer in self.layers)
        things = tokens.x.shape[1] - tokens.num_agents
        return SceneMemory(
            layers,
            tokens.valid[:, None, None, :],
            tokens.x[:, :things],
            tokens.pose[:, :things],
            tokens.agents,
            extent,
        )

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
        pose = nodes.recent[:, :, -1]
        x = self._look_around(self._embed(nodes, memory), nodes, memory)
        for index, layer in enumerate(self.layers):
            own = layer.remember(x, pose)
            seen = own if cache is None else cache.add(index, own)
            x = layer(x, pose, seen, masks, memory, index)
        return self.head(self.norm(x))

    def _look_around(self, x: Tensor, nodes: NodeInputs, memory: SceneMemory) -> Tensor:
        """Add what lies next to each node: map pieces and lights, and the other agents at the same decision."""
        pose, agents = nodes.recent[:, :, -1], memory.agents.shape[1]
        folded = pose.unflatten(0, (len(memory.agents), -1)).flatten(1, 2)
        mask = memory.mask[:, 0, :, : memory.surroundings.shape[1]]
        x = x + self.map_vicinity(folded, memory.surroundings, memory.surroundings_pose, mask).view_as(x)
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

        first, current = nodes.recent[:, :, 0], nodes.recent[:, :, -1]
        moved = rotate(current[..., :2] - first[..., :2], -current[..., 2])
        turned = wrap_angle(current[..., 2:] - first[..., 2:])
        half = nodes.recent[:, :, nodes.recent.shape[2] // 2]
        late = rotate(current[..., :2] - half[..., :2], -current[..., 2])
        extent = each_node(memory.extent) / LENGTH_SCALE
        motion = self.motion(torch.cat((moved / SPEED_SCALE, late / SPEED_SCALE, turned, extent), -1))
        who = each_node(self.identity(memory.agents))
        return motion + self.token(nodes.token) + self.time(nodes.step) + self.kind(nodes.kind) + who


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
