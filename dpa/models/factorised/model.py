"""Factorised attention on neighbourhoods: what SMART and BehaviorGPT have in common.

A node is an agent at the start of a decision. In each layer it looks at its own past, at the map and at the other
agents of the same decision, in this order, over edges that know the relative pose.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpa.models.base import Choose, Decision, Memory, MotionModel, Observation
from dpa.models.context import Featurize
from dpa.models.factorised.context import PIECE_POINTS, NeighbourhoodContext, NeighbourhoodOptions, featurize
from dpa.models.factorised.edges import METRES, SECONDS, EdgeAttention, Edges, FourierEmbedding, relative
from dpa.models.forcing import shown_by
from dpa.models.neighbours import gather, nearest, rows_of
from dpa.models.pieces import NUM_LIGHT_STATES
from dpa.tokens.base import MotionTokenizer
from envs.episode import HISTORY
from envs.geometry.frames import to_world
from envs.scene import LANE_KINDS, NUM_MAP_KINDS, STEP_SECONDS, AgentKind

QUIET = 0.1
"""Standard deviation of embeddings at first."""
LOOKS = (0.0, 2 / 3, 4 / 3, 2.0)
"""An agent sees the map around it, and where it will be so much later at its speed [s]: the way, its bends and lights.

Of pieces of 5 m those nearest to a fast car reach few metres beyond it, and those around where it will be in 2 s begin
few metres before: between the two half of the lanes that it takes were unseen."""


@dataclass(frozen=True)
class FactorisedConfig:
    """Size of the model.

    Attributes:
        width: channels of a node.
        heads: attention heads.
        map_layers: layers among map pieces.
        agent_layers: layers of attention to the own past, the map and the other agents.
        frequencies: of each number of an edge.
        feed: inner channels of a feed-forward layer, times the width.
        horizon: T, decisions in an episode.
        dropout: on every branch.
        past: decisions that a node looks back.
        map_radius: pieces look at pieces so near [m], ``map_pieces`` of them at most.
        map_pieces: see above.
        agent_map_radius: agents look at pieces so near [m], ``agent_pieces`` of them at most.
        agent_pieces: see above.
        agent_radius: agents look at agents so near [m], ``agents`` of them at most.
        agents: see above.
    """

    width: int
    heads: int
    map_layers: int
    agent_layers: int
    frequencies: int
    feed: int = 4
    horizon: int = 16
    dropout: float = 0.0
    past: int = 6
    map_radius: float = 10.0
    map_pieces: int = 8
    agent_map_radius: float = 30.0
    agent_pieces: int = 24
    agent_radius: float = 60.0
    agents: int = 12


class AgentLayer(nn.Module):
    """Attention to the own past, to the map and to the other agents of the same decision, in this order."""

    def __init__(self, config: FactorisedConfig) -> None:
        super().__init__()
        sizes = (config.width, config.heads, config.feed * config.width, config.dropout)
        self.past, self.map, self.agents = (EdgeAttention(*sizes, own=own) for own in (True, False, True))


class FactorisedModel(MotionModel):
    """Attention over the edges of neighbourhoods; a subclass says what a node is made of, and what is made of it.

    What a node sees of another one is its embedding and its pose relative to the receiver, never a place, so nothing
    depends on where a scene lies.

    Args:
        config: size.
        tokenizer: what a token means.
        context: how scenes are cut up.
    """

    def __init__(
        self, config: FactorisedConfig, tokenizer: MotionTokenizer, context: NeighbourhoodOptions | None = None
    ) -> None:
        super().__init__()
        self.config, self.tokenizer, self.context = config, tokenizer, context or NeighbourhoodOptions()
        width = config.width
        self.piece = mlp(PIECE_POINTS * 2, width)
        self.piece_kind = quiet(nn.Embedding(NUM_MAP_KINDS, width))
        self.piece_light = quiet(nn.Embedding(NUM_LIGHT_STATES, width))
        embed = partial(FourierEmbedding, width=width, frequencies=config.frequencies)
        self.map_edge, self.past_edge, self.agent_map_edge, self.agent_edge = embed(4), embed(5), embed(4), embed(4)
        sizes = (width, config.heads, config.feed * width, config.dropout)
        self.map_layers = nn.ModuleList(EdgeAttention(*sizes, own=True) for _ in range(config.map_layers))
        self.layers = nn.ModuleList(AgentLayer(config) for _ in range(config.agent_layers))
        self.norm = nn.LayerNorm(width)

    @abstractmethod
    def embed(self, recent: Tensor, token: Tensor, kind: Tensor, extent: Tensor) -> Tensor:
        """``[R, A, width]``: what agents are, and how they came to be where they are.

        Args:
            recent: ``[R, A, F + 1, 3]``.
            token: ``[R, A, ...]`` of the last decision.
            kind: ``[R, A]``.
            extent: ``[R, A, 3]`` [m].
        """

    @abstractmethod
    def decide(self, x: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """Logits ``[*, P]`` of nodes.

        Args:
            x: ``[*, width]``.
            recent: ``[*, F + 1, 3]``.
            kind: ``[*]``.
        """

    @property
    def featurize(self) -> Featurize:
        """See :meth:`~dpa.models.base.MotionModel.featurize`."""
        return partial(featurize, options=self.context)

    # --- map --------------------------------------------------------------------------------------------------------
    def read_map(self, context: NeighbourhoodContext, hidden: Tensor | None = None) -> Tensor:
        """``[S * P, width]``: what the pieces are, and what lies around them.

        Args:
            context: of batch size ``[S]``.
            hidden: ``[S, P]`` bool, pieces that no other one sees; none by default.
        """
        points = context.map_points.flatten(-2) / METRES
        x = self.piece(points) + self.piece_kind(context.map_kind) + self.piece_light(context.map_light)
        pose, valid, config = context.map_pose, context.map_valid, self.config
        valid = valid if hidden is None else valid & ~hidden
        near = nearest(pose, pose, valid[:, None], config.map_pieces, ordered=True)
        edges = self._edges(self.map_edge, pose, pose, [near], config.map_radius)
        x = x.flatten(0, 1)
        for layer in self.map_layers:
            x = layer(x, layer.remember(x), edges)
        return x

    # --- agents -----------------------------------------------------------------------------------------------------
    def forward(self, context: NeighbourhoodContext, tokens: Tensor, token_valid: Tensor) -> Tensor:
        """See :meth:`~dpa.models.base.MotionModel.forward`."""
        shown, (early, there) = shown_by(context.episode, tokens, token_valid, self.tokenizer), self.history(context)
        scenes, rollouts, horizon, agents = shown.valid.shape

        def behind(first: Tensor, later: Tensor) -> Tensor:
            """``[S * M * decisions, A, ...]``, what was logged before and what rollouts show."""
            return torch.cat((first[:, None].expand(-1, rollouts, *first.shape[1:]), later), 2).flatten(0, 2)

        decisions = early.shape[1] + horizon
        recent, valid = behind(early, shown.recent), behind(there, shown.valid)
        token = behind(self.no_tokens(there.shape, there.device), shown.token)
        kind = context.episode.kind.repeat_interleave(rollouts * decisions, 0)
        x = self.embed(recent, token, kind, context.episode.extent.repeat_interleave(rollouts * decisions, 0))
        pose, pieces, x = recent[:, :, -1], self.read_map(context), x.flatten(0, 1)
        map_edges = self.map_edges(context, recent, kind)
        agent_edges, past = self.agent_edges(pose, valid), self._past_edges(pose, valid, decisions)
        for layer in self.layers:
            x = layer.past(x, layer.past.remember(x), past)
            x = layer.map(x, layer.map.remember(pieces), map_edges)
            x = layer.agents(x, layer.agents.remember(x), agent_edges)
        x = x.view(scenes, rollouts, decisions, agents, -1)[:, :, -horizon:]
        kind = kind.view(scenes, rollouts, decisions, agents)[:, :, -horizon:]
        return self.decide(self.norm(x), shown.recent, kind).transpose(2, 3)

    def history(self, context: NeighbourhoodContext) -> tuple[Tensor, Tensor]:
        """Decisions that the log took before the episode, but for the last one, which ``recent`` shows.

        Returns:
            ``[S, H, A, F + 1, 3]`` poses and ``[S, H, A]`` bool, all of the decision is logged.
        """
        episode, steps = context.episode, self.tokenizer.steps
        count = (HISTORY - 1) // steps - 1
        first = HISTORY - 1 - (count + 1) * steps
        poses = to_world(episode.history, episode.recent[:, :, -1:])[:, :, first:]
        seen = episode.history_valid[:, :, first:]
        decisions = poses.unfold(2, steps + 1, steps)[:, :, :count].movedim(-1, -2)  # [S, A, H, F + 1, 3]
        whole = seen.unfold(2, steps + 1, steps)[:, :, :count].all(-1)
        return decisions.transpose(1, 2), (whole & episode.valid[..., None]).transpose(1, 2)

    def _edges(
        self,
        embed: FourierEmbedding,
        pose: Tensor,
        others: Tensor,
        found: Sequence[tuple[Tensor, Tensor]],
        radius: float,
    ) -> Edges:
        """Edges from ``[B, Q]`` nodes to what :func:`nearest` found of ``[B, n]`` things, within a radius."""
        square, index = (torch.cat(each, -1) for each in zip(*found, strict=True))
        feature = embed(relative(pose[:, :, None], gather(others, index)))
        there = (rows_of(others, index), square <= radius**2, feature)
        return Edges(*(value.flatten(0, 1) for value in there))

    def map_edges(self, context: NeighbourhoodContext, recent: Tensor, kind: Tensor) -> Edges:
        """From agents that moved so, ``[R, A, F + 1, 3]``, as many rows for each scene, to the pieces of their scene.

        As many pieces at each of :data:`LOOKS`, none of them twice: around the agent of any kind, ahead of it lanes
        alone, but for those on foot.

        Args:
            context: of batch size ``[S]``.
            recent: see above.
            kind: ``[R, A]`` of the agents.
        """
        places, looks = context.map_pose, len(LOOKS)
        recent, kind = (value.unflatten(0, (len(places), -1)).flatten(1, 2) for value in (recent, kind))
        pose = recent[:, :, -1]
        speed = (pose - recent[:, :, 0]) / (self.tokenizer.steps * STEP_SECONDS)
        lanes = torch.stack([context.map_kind == lane for lane in LANE_KINDS]).any(0)
        ways = lanes[:, None] | (kind == AgentKind.PEDESTRIAN)[..., None]
        unseen, found = context.map_valid[:, None].expand_as(ways), []
        for look, seconds in enumerate(LOOKS):
            most = (self.config.agent_pieces + looks - 1 - look) // looks
            near = nearest(pose + seconds * speed, places, unseen & ways if look else unseen, most, ordered=True)
            unseen = unseen.scatter(-1, near[1], False)
            found.append(near)
        return self._edges(self.agent_map_edge, pose, places, found, self.config.agent_map_radius)

    def agent_edges(self, pose: Tensor, valid: Tensor) -> Edges:
        """Among the agents ``[R, A, 3]`` of one decision."""
        others = ~torch.eye(pose.shape[1], dtype=torch.bool, device=pose.device)
        near = nearest(pose, pose, valid[:, None] & others, self.config.agents)
        return self._edges(self.agent_edge, pose, pose, [near], self.config.agent_radius)

    def _past_edges(self, pose: Tensor, valid: Tensor, decisions: int) -> Edges:
        """From each node ``[B * T, A]`` to the same agent at the decisions before."""
        track = pose.unflatten(0, (-1, decisions)).transpose(1, 2).flatten(0, 1)  # [B * A, T, 3]
        there = valid.unflatten(0, (-1, decisions)).transpose(1, 2).flatten(0, 1)
        steps = torch.arange(decisions, device=pose.device)
        before = steps[:, None] - torch.arange(1, self.config.past + 1, device=pose.device)
        index = before.clamp(min=0).expand(len(track), -1, -1)
        known = (before >= 0) & there.gather(1, index.flatten(1)).view(index.shape)
        earlier = track.gather(1, index.flatten(1)[..., None].expand(-1, -1, 3)).view(*index.shape, 3)
        feature = self._past_feature(track, earlier)
        # Rows of nodes in their own order, decision by decision.
        agents = pose.shape[1]
        rollout, agent = (torch.arange(len(track), device=pose.device) // agents,
                          torch.arange(len(track), device=pose.device) % agents)  # fmt: skip
        rows = (rollout[:, None, None] * decisions + index) * agents + agent[:, None, None]

        def by_decision(value: Tensor) -> Tensor:
            return value.unflatten(0, (-1, agents)).transpose(1, 2).flatten(0, 2)

        return Edges(by_decision(rows), by_decision(known), by_decision(feature))

    def _past_feature(self, track: Tensor, there: Tensor) -> Tensor:
        """Of edges from ``[B, Q, 3]`` to the same agent at the ``past`` decisions before, ``[B, Q, past, 3]``."""
        gap = -torch.arange(1, self.config.past + 1, device=track.device) * self.tokenizer.steps * STEP_SECONDS
        gap = (gap / SECONDS).expand(there.shape[:-1])[..., None]
        return self.past_edge(torch.cat((relative(track[:, :, None], there), gap), -1))

    # --- rollouts ---------------------------------------------------------------------------------------------------
    def remember(self, *, compile: bool = False) -> Memory:
        """See :meth:`~dpa.models.base.MotionModel.remember`."""
        return FactorisedMemory(self)

    def bytes_per_row(self) -> int:
        """See :meth:`~dpa.models.base.MotionModel.bytes_per_row`."""
        config, itemsize = self.config, 4
        edges = config.agent_pieces + config.agents + config.past
        past = config.agent_layers * config.past * 2 * config.width
        return itemsize * (past + edges * (6 * config.width + 2 * config.frequencies * 4) + 2 * self.context.max_pieces)


class Past(NamedTuple):
    """What rollouts keep of their last decisions, the newest first.

    Attributes:
        keys: of each layer ``[B, past, A, 2 * width]`` keys and values.
        pose: ``[B, past, A, 3]``.
        there: ``[B, past, A]`` bool.
    """

    keys: tuple[Tensor, ...]
    pose: Tensor
    there: Tensor

    def map(self, change: Callable[..., Tensor], *others: Past) -> Past:
        """Every tensor changed, together with those of others."""
        keys, pose, there = zip(self, *others, strict=True)
        return Past(tuple(map(change, *keys)), change(*pose), change(*there))


class FactorisedMemory:
    """What a policy keeps of running rollouts: the map, and keys and values of each agent's last decisions.

    Args:
        model: that decides.
    """

    def __init__(self, model: FactorisedModel) -> None:
        self.model = model
        self._past: Past | None = None

    def begin(self, context: NeighbourhoodContext, rollouts: int, anew: bool) -> None:
        """See :meth:`dpa.models.base.Memory.begin`."""
        pieces = self.model.read_map(context)
        self._context, self._pieces = context, [layer.map.remember(pieces) for layer in self.model.layers]
        self._extent = context.episode.extent.repeat_interleave(rollouts, 0)
        self._logged = self._of_log(context, pieces).map(lambda value: value.repeat_interleave(rollouts, 0))
        if anew or self._past is None:
            self._past = self._logged

    def _of_log(self, context: NeighbourhoodContext, like: Tensor) -> Past:
        """The past of a rollout that begins: what was logged, one row for each scene."""
        episode, config = context.episode, self.model.config
        shape = (len(episode.kind), config.past, episode.kind.shape[1])
        keys = tuple(like.new_zeros(*shape, 2 * config.width) for _ in self.model.layers)
        past = Past(keys, like.new_zeros(*shape, 3), torch.zeros(shape, dtype=torch.bool, device=like.device))
        early, there = self.model.history(context)
        for recent, valid in zip(early.unbind(1), there.unbind(1), strict=True):
            token, first = self.model.no_tokens(episode.kind.shape, valid.device), torch.zeros_like(episode.kind[:, 0])
            seen = Observation(recent, token, first, 0, episode.kind, valid)
            _, past = self._advance(past, seen, episode.extent)
        return past

    def step(self, seen: Observation, choose: Choose) -> Decision:
        """See :meth:`dpa.models.base.Memory.step`."""
        before = self._logged.map(partial(starting, seen.step == 0), self._past)
        x, self._past = self._advance(before, seen, self._extent)
        logits = self.model.decide(self.model.norm(x), seen.recent, seen.kind).float()
        return Decision(choose(logits), logits)

    def _advance(self, past: Past, seen: Observation, extent: Tensor) -> tuple[Tensor, Past]:
        """``[B, A, width]`` after all layers, and the past with this decision."""
        model, pose = self.model, seen.recent[:, :, -1]
        map_edges = model.map_edges(self._context, seen.recent, seen.kind)
        agent_edges = model.agent_edges(pose, seen.valid)
        edges, keys = self._edges(past, pose), []
        x = model.embed(seen.recent, seen.token, seen.kind, extent).flatten(0, 1)
        for layer, pieces, before in zip(model.layers, self._pieces, past.keys, strict=True):
            keys.append(layer.past.remember(x).view(len(pose), 1, pose.shape[1], -1))
            x = layer.past(x, before.flatten(0, 2), edges)
            x = layer.map(x, pieces, map_edges)
            x = layer.agents(x, layer.agents.remember(x), agent_edges)
        newest = Past(tuple(keys), pose[:, None], seen.valid[:, None])
        later = newest.map(lambda new, old: torch.cat((new, old[:, :-1]), 1), past)
        return x.unflatten(0, pose.shape[:2]), later

    def _edges(self, past: Past, pose: Tensor) -> Edges:
        """From each agent to itself at the decisions before."""
        rows, count, agents = past.there.shape
        index = torch.arange(rows * count * agents, device=pose.device).view(rows, count, agents)
        index, valid = (value.transpose(1, 2).flatten(0, 1) for value in (index, past.there))
        there = past.pose.transpose(1, 2).flatten(0, 1)  # [B * A, past, 3]
        feature = self.model._past_feature(pose.flatten(0, 1)[:, None], there[:, None])[:, 0]
        return Edges(index, valid, feature)


def starting(begins: Tensor, first: Tensor, later: Tensor) -> Tensor:
    """Rows that begin have the first, the others the later."""
    return torch.where(begins.view(-1, *(1,) * (first.dim() - 1)), first, later)


def quiet(embedding: nn.Embedding) -> nn.Embedding:
    """An embedding that at first says little beside the features that it is added to."""
    nn.init.normal_(embedding.weight, std=QUIET)
    return embedding


def mlp(inputs: int, width: int) -> nn.Sequential:
    """Two layers with a norm between them."""
    return nn.Sequential(nn.Linear(inputs, width), nn.LayerNorm(width), nn.ReLU(), nn.Linear(width, width))
