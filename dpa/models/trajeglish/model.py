"""Trajeglish: the joint distribution of motion tokens, agent after agent (Philion et al., ICLR 2024, 2312.04535)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from dpa.models.attention import GAZE
from dpa.models.base import Memory, MotionModel, named_size, of_agents
from dpa.models.context import Featurize
from dpa.models.encoder import SceneEncoder, SceneMemory
from dpa.models.forcing import Shown, shown_by
from dpa.models.scene import ContextOptions
from dpa.models.trajeglish.context import TrajeglishContext, featurize, order_of, turns_of
from dpa.models.trajeglish.decoder import Cast, TurnDecoder
from dpa.models.trajeglish.memory import TurnMemory
from dpa.models.vicinity import NEAREST_PIECES
from dpa.tokens.base import MotionTokenizer, check_vocabulary


@dataclass(frozen=True)
class TrajeglishConfig:
    """Size of the model.

    Attributes:
        width: channels of a token.
        heads: attention heads.
        feed: inner channels of a feed-forward layer.
        encoder_layers: self-attention layers over the scene.
        decoder_layers: layers of attention to turns, agents and scene.
        past: decisions that a turn looks back.
        joint: agents know what those before them in the same decision have chosen. Without, they know it from the
            next decision on, as in eq. 1: what taking turns is worth.
        horizon: T, decisions in an episode.
        dropout: on every branch.
    """

    width: int
    heads: int
    feed: int
    encoder_layers: int
    decoder_layers: int
    past: int = 10
    joint: bool = True
    horizon: int = 16
    dropout: float = 0.0


SIZES: dict[str, TrajeglishConfig] = {
    "nano": TrajeglishConfig(width=48, heads=3, feed=192, encoder_layers=1, decoder_layers=2),
    "nano_apart": TrajeglishConfig(width=48, heads=3, feed=192, encoder_layers=1, decoder_layers=2, joint=False),
    "35m": TrajeglishConfig(width=512, heads=8, feed=2048, encoder_layers=2, decoder_layers=6, past=20),
}
"""Named sizes; ``35m`` has the parameters published, within 10 %, with a vocabulary of 384."""


class Trajeglish(MotionModel):
    """Scene encoder and causal decoder; ``log pi(a_t | a_<t, c) = sum_i log pi(a_t^i | a_t^<i, a_<t, c)``.

    The agents of a decision decide one after another, the one nearest to the SDC first, and know what those before
    them have chosen.

    Args:
        config: size, or the name of one in :data:`SIZES`.
        tokenizer: what a token means; it turns tokens into the poses where others see an agent that has decided.
        context: how scenes are cut up.

    Raises:
        ValueError: a name that is no size, or a tokenizer without a vocabulary.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = Trajeglish("nano", VerletTokenizer())
        >>> context = collate_contexts([make_context(straight_road(2), model.featurize)])
        >>> tokens = torch.full((1, 3, 2, 16), 84)  # three rollouts of one scene
        >>> model(context, tokens, torch.ones(1, 1, 2, 16, dtype=torch.bool)).shape
        torch.Size([1, 3, 2, 16, 169])
    """

    def __init__(
        self, config: TrajeglishConfig | str, tokenizer: MotionTokenizer, context: ContextOptions | None = None
    ) -> None:
        super().__init__()
        config, tokenizer = named_size(config, SIZES), check_vocabulary(tokenizer, "Trajeglish")
        self.config, self.tokenizer, self.context = config, tokenizer, context or ContextOptions()
        size = (config.width, config.heads, config.feed)
        self.encoder = SceneEncoder(*size, config.encoder_layers, config.dropout)
        self.decoder = TurnDecoder(
            tokenizer,
            *size,
            config.decoder_layers,
            config.horizon,
            config.past,
            config.joint,
            config.dropout,
        )

    @property
    def featurize(self) -> Featurize:
        """See :meth:`~dpa.models.base.MotionModel.featurize`."""
        return partial(featurize, options=self.context)

    def encode(self, context: TrajeglishContext) -> SceneMemory:
        """Encode scenes of batch size ``[S]``, once for all their rollouts."""
        return self.decoder.read_scene(self.encoder(context), context.episode.extent)

    def cast(self, context: TrajeglishContext, memory: SceneMemory, rollouts: int) -> Cast:
        """Who takes part in some rollouts of each encoded scene, in the order of turns."""
        order, episode = order_of(context), context.episode
        who = self.decoder.kind(episode.kind) + self.decoder.identity(memory.agents)
        takes = of_agents(episode.controlled, order)[:, : turns_of(context)]
        every = (of_agents(value, order) for value in (episode.kind, memory.extent, who))
        return Cast(*(value.repeat_interleave(rollouts, 0) for value in (order, *every, takes)))

    def remember(self, *, compile: bool = False) -> Memory:
        """See :meth:`~dpa.models.base.MotionModel.remember`."""
        return TurnMemory(self)

    def bytes_per_row(self) -> int:
        """See :meth:`~dpa.models.base.MotionModel.bytes_per_row`.

        Examples:
            >>> from dpa.tokens import VerletTokenizer
            >>> round(Trajeglish("nano", VerletTokenizer()).bytes_per_row() / 1024)
            43
        """
        config, itemsize = self.config, self.decoder.head.weight.element_size()
        node = 2 * config.heads * (config.width // config.heads + GAZE)
        held = config.decoder_layers * (2 * config.past + 3) + config.past  # of a past, and of a decision beside it
        vicinity = 3 * NEAREST_PIECES * config.width + 3 * self.context.max_pieces
        return itemsize * (held * node + vicinity + 8 * config.width + self.tokenizer.vocab_size)

    def forward(self, context: TrajeglishContext, tokens: Tensor, token_valid: Tensor) -> Tensor:
        """See :meth:`~dpa.models.base.MotionModel.forward`."""
        scenes, rollouts, agents, horizon = tokens.shape
        memory = self.encode(context)
        cast = self.cast(context, memory, rollouts)
        shown, chosen = self._in_turn(context, tokens, token_valid, cast)
        said = self.decoder(shown, chosen, cast, memory).transpose(1, 2)  # [B, C, T, V]
        order = cast.order[:, : said.shape[1], None, None].expand_as(said)
        logits = said.new_zeros(scenes * rollouts, agents, horizon, said.shape[-1]).scatter(1, order, said)
        return logits.unflatten(0, (scenes, rollouts))

    @torch.no_grad()
    def _in_turn(
        self, context: TrajeglishContext, tokens: Tensor, token_valid: Tensor, cast: Cast
    ) -> tuple[Shown, Shown]:
        """Where each decision finds agents, and where their tokens lead: in the order of turns, ``[B, T, n, ...]``."""
        horizon, turns = tokens.shape[-1], cast.takes.shape[1]
        order = cast.order.repeat_interleave(horizon, 0)

        def in_order(value: Tensor, order: Tensor) -> Tensor:
            """``[S, M, T, A, ...]`` to ``[B, T, n, ...]``."""
            return of_agents(value.flatten(0, 2), order).unflatten(0, (-1, horizon))

        shown = shown_by(context.episode, tokens, token_valid, self.tokenizer)
        shown = Shown(*(in_order(value, order) for value in shown))
        chosen, valid = (
            in_order(value.transpose(2, 3), order[:, :turns]) for value in (tokens, token_valid.expand_as(tokens))
        )
        kind = cast.kind[:, None, :turns].expand_as(chosen)
        recent = self.tokenizer.advance(chosen, shown.recent[:, :, :turns], kind)
        valid = valid & cast.takes[:, None] & shown.valid[:, :, :turns] & self.config.joint
        return shown, Shown(recent, chosen, valid)
