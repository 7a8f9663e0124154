"""What decoders over agents x decisions are made of: embedded agents, layers that look at nodes and the scene."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

from dpa.models.attention import FeedForward, KeyValues, RelativeAttention
from dpa.models.encoder import SceneMemory, SceneTokens
from dpa.models.vicinity import NEAREST_AGENTS, NEAREST_PIECES, Vicinity
from dpa.models.words import TokenEmbedding, TokenHead
from dpa.tokens.base import MotionTokenizer
from envs.scene import AgentKind


class DecoderLayer(nn.Module):
    """Attention to nodes, attention to the scene, feed-forward; all pre-norm.

    Args:
        nodes: attention to nodes.
        width: channels.
        heads: of the attention to the scene.
        feed: inner channels of the feed-forward layer.
        dropout: on every branch.
    """

    def __init__(self, nodes: RelativeAttention, width: int, heads: int, feed: int, dropout: float) -> None:
        super().__init__()
        self.norm_nodes, self.nodes = nn.LayerNorm(width), nodes
        self.norm_scene, self.scene = nn.LayerNorm(width), RelativeAttention(width, heads)
        self.norm_feed, self.feed = nn.LayerNorm(width), FeedForward(width, feed)
        self.dropout = nn.Dropout(dropout)

    def remember(self, x: Tensor, pose: Tensor) -> KeyValues:
        """Keys and values of nodes ``x`` for this layer."""
        return self.nodes.remember(self.norm_nodes(x), pose)

    def forward(
        self, x: Tensor, pose: Tensor, look: Callable[[Tensor], Tensor], memory: SceneMemory, index: int
    ) -> Tensor:
        """Nodes ``x`` ``[B, Q, width]`` after layer ``index``; ``look`` is what normed ones see of other nodes."""
        x = x + self.dropout(look(self.norm_nodes(x)))
        x = x + self.dropout(memory.look(self.scene, index, self.norm_scene(x), pose))
        return x + self.dropout(self.feed(self.norm_feed(x)))


class NodeDecoder(nn.Module):
    """The parts of a decoder whose nodes are agents at decisions.

    Args:
        tokenizer: what a token means.
        width: channels.
        heads: attention heads.
        feed: inner channels of a feed-forward layer.
        layers: decoder layers.
        horizon: T.
        dropout: on every branch.

    Attributes:
        attention: to nodes, made of so many channels and heads.
    """

    attention: type[RelativeAttention]

    def __init__(
        self,
        tokenizer: MotionTokenizer,
        width: int,
        heads: int,
        feed: int,
        layers: int,
        horizon: int,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.motion = nn.Sequential(nn.Linear(8, width), nn.GELU(), nn.Linear(width, width))
        self.token = TokenEmbedding(tokenizer, width)
        self.time = nn.Embedding(horizon, width)
        self.kind = nn.Embedding(len(AgentKind), width)
        self.identity = nn.Linear(width, width)
        self.map_vicinity = Vicinity(width, NEAREST_PIECES)
        self.agent_vicinity = Vicinity(width, NEAREST_AGENTS)
        self.layers = nn.ModuleList(
            DecoderLayer(self.attention(width, heads), width, heads, feed, dropout) for _ in range(layers)
        )
        self.norm = nn.LayerNorm(width)
        self.head = TokenHead(width, tokenizer)

    def read_scene(self, tokens: SceneTokens, extent: Tensor) -> SceneMemory:
        """An encoded scene as the layers look at it."""
        return tokens.remembered([layer.scene for layer in self.layers], extent)
