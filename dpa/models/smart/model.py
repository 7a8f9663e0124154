"""SMART: next-token prediction with factorised attention on neighbourhoods (Wu et al., NeurIPS 2024, 2405.15677)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from dpa.models.base import Auxiliary, named_size
from dpa.models.factorised import METRES, FactorisedConfig, FactorisedModel, NeighbourhoodOptions, mlp, quiet
from dpa.models.smart.road import NextPiece
from dpa.models.words import TokenEmbedding, TokenHead
from dpa.tokens.base import MotionTokenizer, check_vocabulary
from envs.geometry.frames import to_local
from envs.scene import AgentKind

SIZES: dict[str, FactorisedConfig] = {
    "nano": FactorisedConfig(width=36, heads=4, map_layers=1, agent_layers=2, frequencies=8, feed=2,
                             map_pieces=16),
    "1m": FactorisedConfig(width=64, heads=4, map_layers=2, agent_layers=4, frequencies=64, feed=3, past=4,
                           agent_map_radius=20.0, map_pieces=16, agent_pieces=32),
    "7m": FactorisedConfig(width=128, heads=8, map_layers=3, agent_layers=6, frequencies=64, map_pieces=32,
                           agent_pieces=64, agents=32),
    "102m": FactorisedConfig(width=456, heads=8, map_layers=4, agent_layers=8, frequencies=64, map_pieces=32,
                             agent_pieces=64, agents=32),
}  # fmt: skip
"""Named sizes; parameters are those published, within 10 %, with motions of 1,024 for each of three classes."""


class SMART(FactorisedModel):
    """Nodes are made of tokens, and tokens of nodes.

    Args:
        config: size, or the name of one in :data:`SIZES`.
        tokenizer: what a token means.
        context: how scenes are cut up.

    Raises:
        ValueError: a name that is no size, or a tokenizer without a vocabulary.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = SMART("nano", VerletTokenizer())
        >>> context = collate_contexts([make_context(straight_road(2), model.featurize)])
        >>> tokens = torch.full((1, 3, 2, 16), 84)  # three rollouts of one scene
        >>> model(context, tokens, torch.ones(1, 1, 2, 16, dtype=torch.bool)).shape
        torch.Size([1, 3, 2, 16, 169])
    """

    def __init__(
        self, config: FactorisedConfig | str, tokenizer: MotionTokenizer, context: NeighbourhoodOptions | None = None
    ) -> None:
        super().__init__(named_size(config, SIZES), check_vocabulary(tokenizer, "SMART"), context)
        width = self.config.width
        self.kind = quiet(nn.Embedding(len(AgentKind), width))
        # A token that is a motion is where it led; one that changes a velocity says more.
        self.token = None if tokenizer.by_class else quiet(TokenEmbedding(tokenizer, width))
        self.motion = mlp(7, width)
        self.said = nn.Sequential(nn.Linear(width, width), nn.ReLU())
        self.head = TokenHead(width, tokenizer)

    def embed(self, recent: Tensor, token: Tensor, kind: Tensor, extent: Tensor) -> Tensor:
        """See :meth:`~dpa.models.factorised.FactorisedModel.embed`: the token, and where it led."""
        moved = to_local(recent[:, :, 0], recent[:, :, -1])  # where it was, from where it is
        length, turned = moved[..., :2].norm(dim=-1, keepdim=True), moved[..., 2:]
        motion = self.motion(torch.cat((moved[..., :2] / METRES, length / METRES, turned, extent / METRES), -1))
        known = motion + self.kind(kind)
        return known if self.token is None else known + self.token(token, kind)

    def decide(self, x: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """See :meth:`~dpa.models.factorised.FactorisedModel.decide`: logits of all tokens."""
        return self.head(self.said(x), kind)

    def auxiliary(self) -> Auxiliary:
        """See :meth:`~dpa.models.base.MotionModel.auxiliary`: which way a lane goes on."""
        return NextPiece(self.config.width)
