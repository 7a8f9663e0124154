"""Early-fusion scene encoder: map pieces, lights and agent histories become one row of tokens (method.md section 2)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpa.models.motionlm.attention import FeedForward, RelativeAttention
from dpa.models.motionlm.context import NUM_LIGHT_STATES, PIECE_POINTS, POSITION_SCALE, SceneContext
from envs.episode import HISTORY, Episode
from envs.scene import NUM_MAP_KINDS, AgentKind

LENGTH_SCALE = 5.0
"""Metres of a box side that count as one in a feature."""


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
    """Encodes a :class:`~dpa.models.motionlm.context.SceneContext`.

    Args:
        width: channels of a token.
        heads: attention heads.
        feed: inner channels of a feed-forward layer.
        layers: self-attention layers over all modalities together.
        dropout: on both branches of a layer.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from dpa.models.motionlm.context import featurize
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
