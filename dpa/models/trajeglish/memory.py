"""What Trajeglish keeps of running rollouts: the encoded scenes, and keys and values of the turns of late."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from dpa.models.attention import GAZE, KeyValues, added
from dpa.models.base import Choose, Decision, Observation, of_agents
from dpa.models.forcing import Shown
from dpa.models.trajeglish.context import TrajeglishContext
from dpa.models.trajeglish.decoder import View

if TYPE_CHECKING:
    from dpa.models.trajeglish.model import Trajeglish


class Past(NamedTuple):
    """The turns of the last decisions, the newest decision first.

    Attributes:
        layers: of each layer ``[B, H, past, C, D + GAZE]``.
        there: ``[B, past, C]`` bool, others may look at the node.
    """

    layers: tuple[KeyValues, ...]
    there: Tensor


class Agents(NamedTuple):
    """Agents where the decision at hand finds them, then those who have decided where their tokens lead.

    Attributes:
        x: ``[B, A + C, width]``.
        pose: ``[B, A + C, 3]``.
    """

    x: Tensor
    pose: Tensor


class TurnMemory:
    """A :class:`~dpa.models.base.Memory`: in a decision, one pass for each turn, of one agent of every rollout.

    What a node may look at lies side by side, and is written as turns are taken: A agents where the decision finds
    them, the C of them that decide where their tokens lead, and C nodes of each decision, the one at hand first.

    Args:
        model: that decides.
    """

    def __init__(self, model: Trajeglish) -> None:
        self.model = model
        self._past: Past | None = None

    def begin(self, context: TrajeglishContext, rollouts: int, anew: bool) -> None:
        """See :meth:`dpa.models.base.Memory.begin`."""
        self._scenes = self.model.encode(context)
        self._cast = self.model.cast(context, self._scenes, rollouts)
        turns = self._cast.takes.shape[1]
        if anew or self._past is None:
            self._past = self._nothing()
        elif (missing := turns - self._past.there.shape[-1]) != 0:  # another scene has more or fewer agents
            layers = (KeyValues(*(F.pad(value, (0, 0, 0, missing)) for value in each)) for each in self._past.layers)
            self._past = Past(tuple(layers), F.pad(self._past.there, (0, missing)))

    @property
    def _counts(self) -> tuple[int, int]:
        """C and A."""
        return self._cast.takes.shape[1], self._cast.order.shape[1]

    def _nothing(self) -> Past:
        config, (rows, turns) = self.model.config, self._cast.takes.shape
        like, channels = self.model.decoder.head.weight, config.width // config.heads + GAZE
        empty = like.new_zeros(rows, config.heads, config.past, turns, channels)
        there = torch.zeros(rows, config.past, turns, dtype=torch.bool, device=like.device)
        return Past((KeyValues(empty, empty),) * config.decoder_layers, there)

    def step(self, seen: Observation, choose: Choose) -> Decision:
        """See :meth:`dpa.models.base.Memory.step`: agents that take no turn have token 0 and even logits."""
        self._open(seen)
        order, chosen, logits = self._cast.order, [], []
        for turn in range(self._cast.takes.shape[1]):
            logits.append(self._decide(turn))
            chosen.append(choose(logits[-1], order[:, turn : turn + 1]))
            self._take(turn, chosen[-1])
        self._close()
        said, taken = torch.cat(logits, 1), torch.cat(chosen, 1)
        order = order[:, : taken.shape[1]]
        token = torch.zeros_like(seen.token).scatter(1, order, taken)
        every = said.new_zeros(*seen.token.shape, said.shape[-1])
        return Decision(token, every.scatter(1, order[..., None].expand_as(said), said))

    # --- a decision -------------------------------------------------------------------------------------------------
    def _open(self, seen: Observation) -> None:
        """A decision begins: what is known before the first turn."""
        decoder, cast = self.model.decoder, self._cast
        self._shown = Shown(*(of_agents(value, cast.order) for value in (seen.recent, seen.token, seen.valid)))
        found, self._nodes = decoder.begin(self._shown, seen.step, cast, self._scenes)
        pose, turns = self._shown.recent[:, :, -1], cast.takes.shape[1]
        self._agents = Agents(F.pad(found, (0, 0, 0, turns)), F.pad(pose, (0, 0, 0, turns)))
        self._deciding = cast.takes & self._shown.valid[:, :turns]  # [B, C], the agent is there and takes its turn
        there = self._past.there & (seen.step > 0)[:, None, None]
        nobody = torch.zeros_like(cast.takes)
        self._see = torch.cat((self._shown.valid, nobody, nobody, there.flatten(1)), 1)
        self._past = self._past._replace(there=there)
        self._layers = []
        for layer, past in zip(decoder.layers, self._past.layers, strict=True):
            parts = zip(layer.remember(found, pose), past, strict=True)
            padded = ((F.pad(now, (0, 0, 0, 2 * turns)), before.flatten(2, 3)) for now, before in parts)
            self._layers.append(KeyValues(*(torch.cat(both, 2) for both in padded)))

    def _decide(self, turn: int) -> Tensor:
        """``[B, 1, V]`` logits of a turn, whose node is there for those to come."""
        decoder, (turns, agents) = self.model.decoder, self._counts
        node, own = agents + turns + turn, slice(turn, turn + 1)
        see = self._see.clone()
        see[:, node], see[:, turn] = True, False  # an agent is its node, and none of the others
        mask, own_past = added(see)[:, None, None], see[:, None, None, node::turns]
        pose = self._agents.pose[:, own]
        x = self._nodes[:, own] + decoder.agent_vicinity(pose, *self._agents, see[:, None, : agents + turns])
        for index, (layer, held) in enumerate(zip(decoder.layers, self._layers, strict=True)):
            _write(held, node, layer.remember(x, pose))
            along, views = KeyValues(*(each[:, :, node::turns] for each in held)), [View(slice(None), held, mask)]
            look = partial(layer.nodes, pose=pose, own=along, own_mask=own_past, turns=1, views=views)
            x = layer(x, pose, look, self._scenes, index)
        return decoder.head(decoder.norm(x), self._cast.kind[:, own]).float()

    def _take(self, turn: int, token: Tensor) -> None:
        """An agent has decided: from now on it stands where its token ``[B, 1]`` leads."""
        decoder, cast, own = self.model.decoder, self._cast, slice(turn, turn + 1)
        turns, agents = self._counts
        recent = self.model.tokenizer.advance(token, self._shown.recent[:, own], cast.kind[:, own])
        pose = recent[:, :, -1]
        x = decoder.embed(recent, token, cast.kind[:, own], cast.extent[:, own], cast.who[:, own]) + decoder.chosen
        self._agents.x[:, agents + turn], self._agents.pose[:, agents + turn] = x[:, 0], pose[:, 0]
        for layer, held in zip(decoder.layers, self._layers, strict=True):
            _write(held, agents + turn, layer.remember(x, pose))
        there = self._deciding[:, turn] & self.model.config.joint
        self._see[:, agents + turn] = self._see[:, agents + turns + turn] = there
        self._see[:, turn] &= ~there

    def _close(self) -> None:
        """The turns of a decision become the newest of the past."""
        (turns, agents), layers = self._counts, []
        now = slice(agents + turns, agents + 2 * turns)
        for held, past in zip(self._layers, self._past.layers, strict=True):
            parts = zip(held, past, strict=True)
            later = (torch.cat((new[:, :, None, now], before[:, :, :-1]), 2) for new, before in parts)
            layers.append(KeyValues(*later))
        there = torch.cat((self._deciding[:, None], self._past.there[:, :-1]), 1)
        self._past = Past(tuple(layers), there)


def _write(held: KeyValues, place: int, new: KeyValues) -> None:
    """Put keys and values of one thing ``[B, H, 1, D + GAZE]`` in its place."""
    held.keys[:, :, place], held.values[:, :, place] = new.keys[:, :, 0], new.values[:, :, 0]
