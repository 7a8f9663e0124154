"""What the map teaches by itself: which way a lane goes on where its next piece is hidden (SMART, section 3.2)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dpa.models.base import Auxiliary
from dpa.models.factorised import NeighbourhoodContext
from envs.geometry.frames import to_world, wrap_angle

if TYPE_CHECKING:
    from dpa.models.smart.model import SMART

TURNS, TURN = 31, 0.04
"""Classes, and what each of them covers [rad]; the outermost have all that turns farther."""
GAP = 0.1
"""From the end of a piece to the start of the one that goes on from it [m]."""


def next_turn(context: NeighbourhoodContext) -> tuple[Tensor, Tensor]:
    """How the next piece of a line is turned.

    Pieces lie in the order of the map, so the next one of a line stands next to it.

    Args:
        context: of batch size ``[S]``.

    Returns:
        ``[S, P - 1]`` class of the change of heading to the next piece, and whether that one goes on from here.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from dpa.models.factorised import featurize
        >>> from envs.sources.synthetic import straight_road
        >>> turn, known = next_turn(collate_contexts([make_context(straight_road(1), featurize)]))
        >>> turn[known].unique()  # straight on
        tensor([15])
    """
    pose, kind, valid = context.map_pose, context.map_kind, context.map_valid
    first, last = (
        to_world(torch.cat((context.map_points[:, :, end], torch.zeros_like(pose[..., :1])), -1), pose)[..., :2]
        for end in (0, -1)
    )
    goes_on = (last[:, :-1] - first[:, 1:]).norm(dim=-1) < GAP
    known = goes_on & (kind[:, :-1] == kind[:, 1:]) & valid[:, :-1] & valid[:, 1:]
    turn = wrap_angle(pose[:, 1:, 2] - pose[:, :-1, 2]) / TURN
    return (turn.round() + TURNS // 2).clamp(0, TURNS - 1).long(), known


class NextPiece(Auxiliary):
    """Cross-entropy of the turn to the next piece [nats]: half of the pieces are hidden, drawn anew in every step.

    SMART predicts the token of that piece; pieces here have no tokens, and all are as long: what differs is the turn.

    Args:
        width: channels of a piece.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from dpa.models.smart import SMART
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = SMART("nano", VerletTokenizer())
        >>> context = collate_contexts([make_context(straight_road(2), model.featurize)])
        >>> NextPiece(36)(model, context).shape
        torch.Size([])
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.head = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, TURNS))

    def forward(self, model: SMART, context: NeighbourhoodContext) -> Tensor:
        """See :class:`~dpa.models.base.Auxiliary`."""
        turn, known = next_turn(context)
        hidden = torch.rand(context.map_valid.shape, device=turn.device) < 0.5
        said = self.head(model.read_map(context, hidden).unflatten(0, hidden.shape)[:, :-1])
        asked = known & ~hidden[:, :-1] & hidden[:, 1:]
        surprise = F.cross_entropy(said.movedim(-1, 1), turn, reduction="none")
        return surprise.where(asked, 0.0).sum() / asked.sum().clamp(min=1)
