"""Early-fusion scene encoder: map pieces, lights and agent histories become one row of tokens (method.md section 2)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpa.models.attention import FeedForward, KeyValues, RelativeAttention
from dpa.models.pieces import NUM_LIGHT_STATES
from dpa.models.scene import PIECE_POINTS, POSITION_SCALE, SceneContext
from dpa.models.vicinity import Vicinity
from envs.episode import HISTORY, Episode
from envs.geometry.frames import rotate, wrap_angle
from envs.scene import NUM_MAP_KINDS, AgentKind

LENGTH_SCALE = 5.0
"""Metres of a box side that count as one in a feature."""
SPEED_SCALE = 5.0
"""Metres of a decision's displacement that count as one in a feature."""


def motion_features(recent: Tensor, extent: Tensor) -> Tensor:
    """How an agent moved in a decision, seen from where it is, and its size: ``[*, 8]``.

    Args:
        recent: ``[*, F + 1, 3]`` poses of the decision.
        extent: ``[*, 3]`` [m].

    Examples:
        >>> motion_features(torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]), torch.tensor([5.0, 2.0, 1.5]))
        tensor([1.0000, 0.0000, 0.0000, 0.0000, 0.0000, 1.0000, 0.4000, 0.3000])
    """
    first, half, current = recent[..., 0, :], recent[..., recent.shape[-2] // 2, :], recent[..., -1, :]
    moved = rotate(current[..., :2] - first[..., :2], -current[..., 2])
    late = rotate(current[..., :2] - half[..., :2], -current[..., 2])
    turned = wrap_angle(current[..., 2:] - first[..., 2:])
    return torch.cat((moved / SPEED_SCALE, late / SPEED_SCALE, turned, extent / LENGTH_SCALE), -1)


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

    def look(self, attention: RelativeAttention, index: int, x: Tensor, pose: Tensor) -> Tensor:
        """What B rollouts' nodes ``x`` ``[B, Q, width]`` at ``pose`` see of their scenes in layer ``index``."""
        return attention(self._folded(x), self._folded(pose), self.layers[index], self.mask).view_as(x)

    def look_around(self, vicinity: Vicinity, pose: Tensor) -> Tensor:
        """``[B, Q, width]``: what lies next to nodes at ``pose`` ``[B, Q, 3]``, map pieces and lights."""
        mask = self.mask[:, 0, :, : self.surroundings.shape[1]]
        seen = vicinity(self._folded(pose), self.surroundings, self.surroundings_pose, mask)
        return seen.view(*pose.shape[:2], seen.shape[-1])

    def _folded(self, value: Tensor) -> Tensor:
        # The scene is shared by its rollouts: fold them into the queries instead of repeating keys and values.
        return value.unflatten(0, (len(self.mask), -1)).flatten(1, 2)


class SceneTokens(NamedTuple):
    """An encoded scene.

    Attributes:
        x: ``[S, P + G + A, width]``, agents last.
        pose: ``[S, P + G + A, 3]``.
        valid: ``[S, P + G + A]`` bool.
        num_agents: A.
    """

    x: Tensor
    pose: Tensor
    valid: Tensor
    num_agents: int

    @property
    def agents(self) -> Tensor:
        """``[S, A, width]``: the scene embedding of each agent."""
        return self.x[:, self.x.shape[1] - self.num_agents :]

    def remembered(self, attentions: Iterable[RelativeAttention], extent: Tensor) -> SceneMemory:
        """The scene as decoder layers look at it.

        Args:
            attentions: to the scene, of each layer.
            extent: ``[S, A, 3]`` of the agents [m].
        """
        layers = tuple(attention.remember(self.x, self.pose) for attention in attentions)
        things = self.x.shape[1] - self.num_agents
        mask = self.valid[:, None, None, :]
        return SceneMemory(layers, mask, self.x[:, :things], self.pose[:, :things], self.agents, extent)


class EncoderLayer(nn.Module):
    """Pre-norm self-attention with relative poses, then a feed-forward layer."""

    def __init__(self, width: int, heads: int, feed: int, dropout: float) -> None:
        super().__init__()
        self.norm, self.attention = nn.LayerNorm(width), RelativeAttention(width, heads)
        self.norm_feed, self.feed = nn.LayerNorm(width), FeedForward(width, feed)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, pose: Tensor, mask: Tensor) -> Tensor:
        """Tokens ``x`` ``[S, n, width]`` after the layer; ``mask`` says which of them are looked at."""
        normed = self.norm(x)
        x = x + self.dropout(self.attention(normed, pose, self.attention.remember(normed, pose), mask))
        return x + self.dropout(self.feed(self.norm_feed(x)))


class SceneEncoder(nn.Module):
    """Encodes a :class:`~dpa.models.scene.SceneContext`.

    Args:
        width: channels of a token.
        heads: attention heads.
        feed: inner channels of a feed-forward layer.
        layers: self-attention layers over all modalities together.
        dropout: on both branches of a layer.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from dpa.models.scene import featurize
        >>> from envs.sources.synthetic import straight_road
        >>> context = make_context(straight_road(2), featurize)
        >>> SceneEncoder(32, 2, 64, 1)(collate_contexts([context])).agents.shape
        torch.Size([1, 2, 32])
    """

    def __init__(self, width: int, heads: int, feed: int, layers: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.map_features = _mlp(PIECE_POINTS * 2, width)
        self.map_kind = nn.Embedding(NUM_MAP_KINDS, width)
        self.map_light = nn.Embedding(NUM_LIGHT_STATES, width)
        self.light_state = nn.Embedding(NUM_LIGHT_STATES, width)
        self.light_time = nn.Parameter(torch.randn(HISTORY, 1) * 0.1)
        self.light_token = nn.Parameter(torch.zeros(width))
        self.agent_features = _mlp(HISTORY * 4 + 3, width)
        self.agent_kind = nn.Embedding(len(AgentKind), width)
        self.layers = nn.ModuleList(EncoderLayer(width, heads, feed, dropout) for _ in range(layers))
        self.norm = nn.LayerNorm(width)

    def forward(self, context: SceneContext) -> SceneTokens:
        """Encode scenes of batch size ``[S]``."""
        episode = context.episode
        x = torch.cat((self._map(context), self._lights(context), self._agents(episode)), 1)
        current = episode.recent[:, :, -1]
        pose = torch.cat((context.map_pose, context.light_pose, current), 1)
        valid = torch.cat((context.map_valid, context.light_valid, episode.valid), 1)
        for layer in self.layers:
            x = layer(x, pose, valid[:, None, None, :])
        return SceneTokens(self.norm(x), pose, valid, current.shape[1])

    def _map(self, context: SceneContext) -> Tensor:
        points = context.map_points.flatten(-2) / POSITION_SCALE
        return self.map_features(points) + self.map_kind(context.map_kind) + self.map_light(context.map_light)

    def _lights(self, context: SceneContext) -> Tensor:
        history = self.light_state(context.light_state)
        return history[..., -1, :] + (history * self.light_time).sum(-2) + self.light_token

    def _agents(self, episode: Episode) -> Tensor:
        past = torch.cat((episode.history[..., :2] / POSITION_SCALE, episode.history[..., 2:]), -1)
        seen = episode.history_valid[..., None].to(past.dtype)
        features = torch.cat((torch.cat((past, seen), -1).flatten(-2), episode.extent / LENGTH_SCALE), -1)
        return self.agent_features(features) + self.agent_kind(episode.kind)


def _mlp(inputs: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width))
