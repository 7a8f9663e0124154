"""Causal decoder in which the agents of a decision take turns (method.md section 2).

A *node* is an agent at its turn. It knows the motion that it just made (its last token), when it is and who it is. It
attends to the nodes of all turns before its own, as far as a window of decisions reaches; to the agents as they stand
at its turn, those who have decided where their tokens lead, the others where the decision finds them; and to the
encoded scene. All of this is seen from where the agent is now.

Agents are in the order of their turns here: the first C of A take them, and the others follow their logs.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dpa.models.attention import DECISIONS, KeyValues, NodeAttention, added
from dpa.models.decoder import NodeDecoder
from dpa.models.encoder import SceneMemory, motion_features
from dpa.models.forcing import Shown
from dpa.tokens.base import MotionTokenizer


class Cast(NamedTuple):
    """Who takes part in B rollouts, in the order of turns.

    Attributes:
        order: ``[B, A]`` which agents these are.
        kind: ``[B, A]``.
        extent: ``[B, A, 3]`` [m].
        who: ``[B, A, width]`` what is known of an agent whatever it does.
        takes: ``[B, C]`` bool, the agent takes its turn; false where others have more of them.
    """

    order: Tensor
    kind: Tensor
    extent: Tensor
    who: Tensor
    takes: Tensor


class Lot(NamedTuple):
    """Some decisions that attend together, so that cost is linear in decisions.

    Attributes:
        nodes: those that look.
        before: those that they may look at.
        agents: of their decisions.
        mask: ``[B, 1, nodes, agents + before]``, :func:`~dpa.models.attention.added` to the scores.
    """

    nodes: slice
    before: slice
    agents: slice
    mask: Tensor


class View(NamedTuple):
    """What some nodes may look at.

    Attributes:
        nodes: those that look.
        things: n of them.
        mask: broadcastable to ``[B, 1, nodes, n]``, :func:`~dpa.models.attention.added` to the scores.
    """

    nodes: slice
    things: KeyValues
    mask: Tensor


class TurnAttention(NodeAttention):
    """Attention of turns: the first heads look along the agent's own past only, the rest at all turns and agents.

    Args:
        width: channels of a node.
        heads: H; a third of them, at least one, look along the own past.

    Examples:
        >>> attention = TurnAttention(32, heads=2)
        >>> x, pose = torch.randn(1, 6, 32), torch.randn(1, 6, 3)  # two turns in each of three decisions
        >>> nodes, own = attention.remember(x, pose), torch.ones(3, 3, dtype=torch.bool).tril()
        >>> views = [View(slice(None), nodes, added(torch.ones(6, 6, dtype=torch.bool).tril()[None, None]))]
        >>> attention(x, pose, nodes, own, turns=2, views=views).shape
        torch.Size([1, 6, 32])
    """

    def forward(
        self, x: Tensor, pose: Tensor, own: KeyValues, own_mask: Tensor, turns: int, views: Iterable[View]
    ) -> Tensor:
        """Attend from nodes.

        Args:
            x: ``[B, m, width]``, m a multiple of C.
            pose: ``[B, m, 3]``.
            own: nodes of the same agents, C in each decision.
            own_mask: as :class:`~dpa.models.attention.NodeMasks` has it.
            turns: C.
            views: of all nodes, in their order.

        Returns:
            ``[B, m, width]``.
        """
        query, rest = self._queries(x, pose), slice(self.own, None)
        seen = [
            self._attend(query[:, rest, view.nodes], KeyValues(*(each[:, rest] for each in view.things)), view.mask)
            for view in views
        ]
        along = self._along(query, own, own_mask, turns)
        return self._merge(torch.cat((along, torch.cat(seen, 2)), 1), pose)


def standing(shown: Tensor, chosen: Tensor) -> Tensor:
    """Which agents stand where at each turn: who has decided stands where its token leads.

    Args:
        shown: ``[*, A]`` bool, an agent is seen where the decision finds it.
        chosen: ``[*, C]`` bool, it is seen where its token leads, once it has decided.

    Returns:
        ``[*, C, A + C]`` bool, what is seen by the agent at its turn; never itself.

    Examples:
        >>> standing(torch.ones(3, dtype=torch.bool), torch.ones(2, dtype=torch.bool)).int()
        tensor([[0, 1, 1, 0, 0],
                [0, 0, 1, 1, 0]], dtype=torch.int32)
    """
    agents, turns = shown.shape[-1], chosen.shape[-1]
    turn = torch.arange(turns, device=shown.device)[:, None]
    decided = (turn > turn.T) & chosen[..., None, :]
    still = shown[..., None, :] & (turn != torch.arange(agents, device=shown.device))
    still = torch.cat((still[..., :turns] & ~decided, still[..., turns:]), -1)
    return torch.cat((still, decided), -1)


class TurnDecoder(NodeDecoder):
    """Logits of the token of every turn.

    Args:
        tokenizer: what a token means.
        width: channels.
        heads: attention heads.
        feed: inner channels of a feed-forward layer.
        layers: decoder layers.
        horizon: T.
        past: decisions that a node looks back.
        joint: a node sees those of the turns before its own in the same decision.
        dropout: on every branch.
    """

    attention = TurnAttention

    def __init__(
        self,
        tokenizer: MotionTokenizer,
        width: int,
        heads: int,
        feed: int,
        layers: int,
        horizon: int,
        past: int,
        joint: bool = True,
        dropout: float = 0.0,
    ) -> None:
        super().__init__(tokenizer, width, heads, feed, layers, horizon, dropout)
        self.past, self.joint = past, joint
        self.chosen = nn.Parameter(torch.zeros(width))

    def embed(self, recent: Tensor, token: Tensor, kind: Tensor, extent: Tensor, who: Tensor) -> Tensor:
        """``[*, width]``: agents with the motion ``[*, F + 1, 3]`` and the token ``[*]`` that they made last."""
        return self.motion(motion_features(recent, extent)) + self.token(token, kind) + who

    # --- all decisions at once --------------------------------------------------------------------------------------
    def forward(self, shown: Shown, chosen: Shown, cast: Cast, memory: SceneMemory) -> Tensor:
        """Logits of all turns of B rollouts, B a multiple of the memory's S.

        Args:
            shown: where each decision finds the agents, ``[B, T, A, ...]``.
            chosen: where their tokens lead, ``[B, T, C, ...]``, valid where others may look at the token.
            cast: who they are.
            memory: of the S scenes.

        Returns:
            ``[B, T, C, V]``.
        """
        horizon, turns = chosen.token.shape[1:]
        kind, extent, who = (
            value[:, None].expand(-1, horizon, *value.shape[1:]) for value in (cast.kind, cast.extent, cast.who)
        )
        deciding = (value[:, :, :turns] for value in (kind, extent, who))
        x = self.embed(shown.recent, shown.token, kind, extent, who)
        after = self.embed(chosen.recent, chosen.token, *deciding) + self.chosen
        agents = torch.cat((x, after), 2)  # [B, T, A + C, width]
        places = torch.cat((shown.recent[..., -1, :], chosen.recent[..., -1, :]), 2)
        seen = standing(shown.valid, chosen.valid)
        when = self.time(torch.arange(horizon, device=x.device))[:, None]
        x, pose = x[:, :, :turns] + when, places[:, :, :turns]
        around = self.agent_vicinity(*(value.flatten(0, 1) for value in (pose, agents, places, seen)))
        x, pose = (x + around.view_as(x)).flatten(1, 2), pose.flatten(1, 2)
        x = x + memory.look_around(self.map_vicinity, pose)
        lots = self._lots(shown.valid[:, :, :turns] & cast.takes[:, None], seen)
        own_past = torch.ones(horizon, horizon, dtype=torch.bool, device=x.device).tril().triu(-self.past)
        for index, layer in enumerate(self.layers):
            nodes, others = layer.remember(x, pose), layer.remember(agents.flatten(1, 2), places.flatten(1, 2))
            views = _views(lots, nodes, others)
            look = partial(layer.nodes, pose=pose, own=nodes, own_mask=own_past, turns=turns, views=views)
            x = layer(x, pose, look, memory, index)
        return self.head(self.norm(x).unflatten(1, (horizon, turns)), kind[:, :, :turns])

    def _lots(self, there: Tensor, seen: Tensor) -> list[Lot]:
        """What nodes see, some decisions at a time.

        Args:
            there: ``[B, T, C]`` bool, others may look at the node.
            seen: ``[B, T, C, A + C]`` bool, the agents that stand there at its turn.
        """
        (horizon, turns), agents, lots = there.shape[1:], seen.shape[-1], []
        node = torch.arange(horizon * turns, device=there.device)
        for first in range(0, horizon, DECISIONS):
            last, start = min(first + DECISIONS, horizon), max(first - self.past, 0)
            queries, before = slice(first * turns, last * turns), slice(start * turns, last * turns)
            mine, theirs = node[queries, None], node[before]
            ago = mine // turns - theirs // turns
            near = (theirs <= mine) & (ago <= self.past) & ((ago > 0) | (theirs == mine) | self.joint)
            nodes = near & (there[:, None, start:last].flatten(2) | (theirs == mine))
            same = torch.eye(last - first, dtype=torch.bool, device=there.device)
            others = seen[:, first:last, :, None] & same[:, None, :, None]  # [B, decisions, C, decisions, A + C]
            mask = added(torch.cat((others.flatten(3).flatten(1, 2), nodes), -1))
            lots.append(Lot(queries, before, slice(first * agents, last * agents), mask[:, None]))
        return lots

    # --- turn by turn -----------------------------------------------------------------------------------------------
    def begin(self, shown: Shown, step: Tensor, cast: Cast, memory: SceneMemory) -> tuple[Tensor, Tensor]:
        """A decision begins: the agents that it finds ``[B, A, width]``, and the nodes of its turns ``[B, C, width]``.

        What lies next to a node among agents is not in it yet, since that depends on what they choose.

        Args:
            shown: where the decision finds the agents, ``[B, A, ...]``.
            step: ``[B]`` index of the decision.
            cast: who they are.
            memory: of the S scenes.
        """
        turns = cast.takes.shape[1]
        agents = self.embed(shown.recent, shown.token, cast.kind, cast.extent, cast.who)
        around = memory.look_around(self.map_vicinity, shown.recent[:, :turns, -1])
        return agents, agents[:, :turns] + self.time(step)[:, None] + around


def _views(lots: Sequence[Lot], nodes: KeyValues, agents: KeyValues) -> Iterator[View]:
    """What nodes may look at, lot by lot."""
    for lot in lots:
        both = zip(agents, nodes, strict=True)
        things = (torch.cat((these[:, :, lot.agents], those[:, :, lot.before]), 2) for these, those in both)
        yield View(lot.nodes, KeyValues(*things), lot.mask)
