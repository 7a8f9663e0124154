"""MotionLM: the joint distribution of motion tokens of all agents of a scene."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor, nn

from dpa.policy.attention import NodeMasks, added
from dpa.policy.context import SceneContext
from dpa.policy.decoder import MotionDecoder, NodeInputs, SceneMemory
from dpa.policy.encoder import SceneEncoder
from dpa.tokens.base import MotionTokenizer


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

    def as_dict(self) -> dict[str, int | float]:
        """For a checkpoint."""
        return asdict(self)


SIZES: dict[str, MotionLMConfig] = {
    "nano": MotionLMConfig(width=48, heads=3, feed=192, encoder_layers=1, decoder_layers=2),
    "small": MotionLMConfig(width=64, heads=4, feed=256, encoder_layers=2, decoder_layers=2),
    "paper": MotionLMConfig(width=128, heads=4, feed=384, encoder_layers=2, decoder_layers=2),
}
"""Named sizes; ``paper`` has 1M trainable parameters within 5 %."""


class MotionLM(nn.Module):
    """Scene encoder and causal decoder; ``log pi(a_t | a_<t, c) = sum_i log pi(a_t^i | a_<t, c)`` (eq. 1).

    Args:
        config: size, or the name of one in :data:`SIZES`.
        tokenizer: what a token means; it turns tokens into the poses from which the next decision is seen.

    Raises:
        ValueError: a name that is no size.

    Examples:
        >>> from dpa.policy.context import collate_contexts, make_context
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> context = collate_contexts([make_context(straight_road(2))])
        >>> tokens = torch.full((1, 3, 2, 16), 84)  # three rollouts of one scene
        >>> model(context, tokens, torch.ones(1, 1, 2, 16, dtype=torch.bool)).shape
        torch.Size([1, 3, 2, 16, 169])
    """

    def __init__(self, config: MotionLMConfig | str, tokenizer: MotionTokenizer) -> None:
        super().__init__()
        if isinstance(config, str):
            if config not in SIZES:
                raise ValueError(f"size must be one of {sorted(SIZES)}, got {config!r}.")
            config = SIZES[config]
        self.config = config
        self.tokenizer = tokenizer
        size = (config.width, config.heads, config.feed)
        self.encoder = SceneEncoder(*size, config.encoder_layers, config.dropout)
        self.decoder = MotionDecoder(tokenizer.vocab_size, *size, config.decoder_layers, config.horizon, config.dropout)

    @property
    def no_token(self) -> int:
        """Stands for the last token of a node that has none: V."""
        return self.tokenizer.vocab_size

    def encode(self, context: SceneContext) -> SceneMemory:
        """Encode scenes of batch size ``[S]``, once for all their rollouts."""
        return self.decoder.read_scene(self.encoder(context), context.extent)

    def forward(self, context: SceneContext, tokens: Tensor, token_valid: Tensor) -> Tensor:
        """Teacher-forced logits of every token of M rollouts of each scene.

        Args:
            context: of batch size ``[S]``.
            tokens: ``[S, M, A, T]`` int64.
            token_valid: ``[S, M or 1, A, T]`` bool; a controlled agent is seen by others while its tokens are valid.

        Returns:
            ``[S, M, A, T, V]`` logits; those of agents that are not controlled mean nothing.
        """
        scenes, rollouts, agents, horizon = tokens.shape
        each = _Each(rollouts)
        flat, kind = tokens.flatten(0, 1), each(context.kind)
        controlled = each(context.controlled)
        valid = node_validity(context, token_valid.expand_as(tokens), self.tokenizer.steps).flatten(0, 1)
        recent = self._recent(context, flat, each)
        last = torch.nn.functional.pad(flat[..., :-1], (1, 0), value=self.no_token)
        last = torch.where(controlled[..., None], last, self.no_token)
        nodes = NodeInputs(
            recent=recent.flatten(1, 2),
            token=last.transpose(1, 2).flatten(1),
            step=torch.arange(horizon, device=tokens.device).repeat_interleave(agents).expand(len(flat), -1),
            kind=kind.repeat(1, horizon),
            valid=valid.transpose(1, 2).flatten(1),
        )
        order = nodes.step[0]
        staircase = order[:, None] >= order
        own = torch.ones(horizon, horizon, dtype=torch.bool, device=tokens.device).tril()
        masks = NodeMasks(own, added(staircase & nodes.valid[:, None, :])[:, None])
        logits = self.decoder(nodes, self.encode(context), masks)
        return logits.view(scenes, rollouts, horizon, agents, -1).transpose(2, 3)

    @torch.no_grad()
    def _recent(self, context: SceneContext, tokens: Tensor, each: _Each) -> Tensor:
        """``[B, T, A, F + 1, 3]``: poses before each decision, of the tokens or, for replayed agents, of the log."""
        start, kind = each(context.recent), each(context.kind)
        horizon, steps = tokens.shape[-1], self.tokenizer.steps
        moved = self.tokenizer.decode_tracks(tokens[..., :-1], start, kind) if horizon > 1 else start[..., :0, :]
        future = each(context.logged)[..., : moved.shape[-2], :]
        track = torch.where(each(context.controlled)[..., None, None], moved, future)
        track = torch.cat((start, track), -2)
        return track.unfold(-2, steps + 1, steps).movedim(-1, -2).transpose(1, 2)


class _Each:
    """``[S, ...]`` to ``[S * M, ...]``."""

    def __init__(self, rollouts: int) -> None:
        self.rollouts = rollouts

    def __call__(self, value: Tensor) -> Tensor:
        return value.repeat_interleave(self.rollouts, 0)


def node_validity(context: SceneContext, token_valid: Tensor, steps: int) -> Tensor:
    """Which nodes others may look at.

    Args:
        context: of batch size ``[S]``.
        token_valid: ``[S, M, A, T]`` bool, of the first T decisions.
        steps: F, of a decision.

    Returns:
        ``[S, M, A, T]`` bool: a controlled agent counts while the tokens before are valid, a replayed one, which may
        arrive later, while it is logged.
    """
    present = context.valid[:, None, :, None].expand(*token_valid.shape[:-1], 1)
    ends = context.logged_valid[..., steps - 1 :: steps][..., : token_valid.shape[-1]]
    ends = ends[:, None].expand_as(token_valid)
    later = torch.where(context.controlled[:, None, :, None], token_valid & present, ends)[..., :-1]
    return torch.cat((present, later), -1)
