"""MotionLM: the joint distribution of motion tokens of all agents of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from dpa.models.attention import GAZE, NodeMasks, added
from dpa.models.base import MotionModel, named_size
from dpa.models.context import Featurize
from dpa.models.encoder import SceneEncoder, SceneMemory
from dpa.models.forcing import shown_by
from dpa.models.motionlm.decoder import MotionDecoder, NodeInputs
from dpa.models.motionlm.memory import RolloutMemory
from dpa.models.scene import ContextOptions, SceneContext, featurize
from dpa.models.vicinity import NEAREST_PIECES
from dpa.tokens.base import MotionTokenizer, check_vocabulary


@dataclass(frozen=True)
class MotionLMConfig:
    """Size of the model.

    Attributes:
        width: channels of a token.
        heads: attention heads.
        feed: inner channels of a feed-forward layer.
        encoder_layers: self-attention layers over the scene.
        decoder_layers: layers of attention to nodes and scene.
        horizon: T, decisions in an episode.
        dropout: on every branch.
    """

    width: int
    heads: int
    feed: int
    encoder_layers: int
    decoder_layers: int
    horizon: int = 16
    dropout: float = 0.0


SIZES: dict[str, MotionLMConfig] = {
    "nano": MotionLMConfig(width=48, heads=3, feed=192, encoder_layers=1, decoder_layers=2),
    "small": MotionLMConfig(width=64, heads=4, feed=256, encoder_layers=2, decoder_layers=2),
    "paper": MotionLMConfig(width=128, heads=4, feed=384, encoder_layers=2, decoder_layers=2),
}
"""Named sizes; ``paper`` has 1M trainable parameters within 5 %."""


class MotionLM(MotionModel):
    """Scene encoder and causal decoder; ``log pi(a_t | a_<t, c) = sum_i log pi(a_t^i | a_<t, c)`` (eq. 1).

    Args:
        config: size, or the name of one in :data:`SIZES`.
        tokenizer: what a token means; it turns tokens into the poses from which the next decision is seen.
        context: how scenes are cut up.

    Raises:
        ValueError: a name that is no size, or a tokenizer without a vocabulary.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> context = collate_contexts([make_context(straight_road(2), model.featurize)])
        >>> tokens = torch.full((1, 3, 2, 16), 84)  # three rollouts of one scene
        >>> model(context, tokens, torch.ones(1, 1, 2, 16, dtype=torch.bool)).shape
        torch.Size([1, 3, 2, 16, 169])
    """

    compiles = True

    def __init__(
        self, config: MotionLMConfig | str, tokenizer: MotionTokenizer, context: ContextOptions | None = None
    ) -> None:
        super().__init__()
        config, tokenizer = named_size(config, SIZES), check_vocabulary(tokenizer, "MotionLM")
        self.config, self.tokenizer, self.context = config, tokenizer, context or ContextOptions()
        size = (config.width, config.heads, config.feed)
        self.encoder = SceneEncoder(*size, config.encoder_layers, config.dropout)
        self.decoder = MotionDecoder(tokenizer, *size, config.decoder_layers, config.horizon, config.dropout)

    @property
    def featurize(self) -> Featurize:
        """See :meth:`~dpa.models.base.MotionModel.featurize`."""
        return partial(featurize, options=self.context)

    def encode(self, context: SceneContext) -> SceneMemory:
        """Encode scenes of batch size ``[S]``, once for all their rollouts."""
        return self.decoder.read_scene(self.encoder(context), context.episode.extent)

    def remember(self, *, compile: bool = False) -> RolloutMemory:
        """See :meth:`~dpa.models.base.MotionModel.remember`."""
        return RolloutMemory(self, compile=compile)

    def bytes_per_row(self) -> int:
        """See :meth:`~dpa.models.base.MotionModel.bytes_per_row`.

        Examples:
            >>> from dpa.tokens import VerletTokenizer
            >>> round(MotionLM("paper", VerletTokenizer()).bytes_per_row() / 1024)
            72
        """
        config, itemsize = self.config, self.decoder.head.weight.element_size()
        channels = config.width // config.heads + GAZE
        cache = 2 * config.decoder_layers * config.heads * config.horizon * channels * itemsize
        vicinity = 3 * NEAREST_PIECES * config.width * itemsize + 3 * self.context.max_pieces * itemsize
        layers = 4 * max(config.feed, 3 * config.width) * itemsize
        return cache + vicinity + layers

    def forward(self, context: SceneContext, tokens: Tensor, token_valid: Tensor) -> Tensor:
        """See :meth:`~dpa.models.base.MotionModel.forward`."""
        scenes, rollouts, agents, horizon = tokens.shape
        shown = shown_by(context.episode, tokens, token_valid, self.tokenizer)
        recent, token, valid = (value.flatten(0, 1).flatten(1, 2) for value in shown)
        nodes = NodeInputs(
            recent=recent,
            token=token,
            step=torch.arange(horizon, device=tokens.device).repeat_interleave(agents).expand(len(token), -1),
            kind=context.episode.kind.repeat_interleave(rollouts, 0).repeat(1, horizon),
            valid=valid,
        )
        order = nodes.step[0]
        staircase = order[:, None] >= order
        own = torch.ones(horizon, horizon, dtype=torch.bool, device=tokens.device).tril()
        masks = NodeMasks(own, added(staircase & nodes.valid[:, None, :])[:, None])
        logits = self.decoder(nodes, self.encode(context), masks)
        return logits.view(scenes, rollouts, horizon, agents, -1).transpose(2, 3)
