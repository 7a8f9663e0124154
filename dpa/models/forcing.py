"""Teacher forcing: what rollouts whose tokens are known show of themselves at each of their decisions."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from dpa.tokens.base import MotionTokenizer
from envs.episode import Episode


class Shown(NamedTuple):
    """An :class:`~dpa.models.base.Observation` of every decision of M rollouts of S scenes.

    Attributes:
        recent: ``[S, M, T, A, F + 1, 3]`` poses of the decision before.
        token: ``[S, M, T, A, ...]`` token of it; V where there is none.
        valid: ``[S, M, T, A]`` bool, others may look at the agent.
    """

    recent: Tensor
    token: Tensor
    valid: Tensor


def shown_by(episode: Episode, tokens: Tensor, token_valid: Tensor, tokenizer: MotionTokenizer) -> Shown:
    """What rollouts show before each decision: where their tokens led, or, of replayed agents, what was logged.

    Args:
        episode: of batch size ``[S]``.
        tokens: ``[S, M, A, T, ...]``.
        token_valid: ``[S, M or 1, A, T]`` bool.
        tokenizer: of the tokens.

    Examples:
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.episode import make_episode
        >>> from envs.sources.synthetic import straight_road
        >>> episode, tokens = make_episode(straight_road(2))[None], torch.full((1, 3, 2, 16), 84)
        >>> shown_by(episode, tokens, torch.ones(1, 1, 2, 16, dtype=torch.bool), VerletTokenizer()).recent.shape
        torch.Size([1, 3, 16, 2, 6, 3])
    """
    controlled, none = tokenizer.of_numbers(episode.controlled[:, None, :, None]), tokenizer.vocab_size
    before = torch.cat((torch.full_like(tokens[:, :, :, :1], none), tokens[:, :, :, :-1]), 3)
    token = torch.where(controlled, before, none)
    valid = _validity(episode, token_valid.expand(tokens.shape[:4]), tokenizer.steps)
    return Shown(_recent(episode, tokens, tokenizer), token.transpose(2, 3), valid.transpose(2, 3))


@torch.no_grad()
def _recent(episode: Episode, tokens: Tensor, tokenizer: MotionTokenizer) -> Tensor:
    """``[S, M, T, A, F + 1, 3]``."""

    def each(value: Tensor) -> Tensor:
        return value.repeat_interleave(tokens.shape[1], 0)

    start, flat, steps = each(episode.recent), tokens.flatten(0, 1)[:, :, :-1], tokenizer.steps
    moved = tokenizer.decode_tracks(flat, start, each(episode.kind)) if flat.shape[2] else start[..., :0, :]
    future = each(episode.logged)[..., : moved.shape[-2], :]
    track = torch.cat((start, torch.where(each(episode.controlled)[..., None, None], moved, future)), -2)
    return track.unfold(-2, steps + 1, steps).movedim(-1, -2).transpose(1, 2).unflatten(0, tokens.shape[:2])


def _validity(episode: Episode, token_valid: Tensor, steps: int) -> Tensor:
    """``[S, M, A, T]``: a controlled agent counts while the tokens before are valid, a replayed one while logged."""
    present = episode.valid[:, None, :, None].expand(*token_valid.shape[:-1], 1)
    ends = episode.logged_valid[..., steps - 1 :: steps][..., : token_valid.shape[-1]]
    ends = ends[:, None].expand_as(token_valid)
    later = torch.where(episode.controlled[:, None, :, None], token_valid & present, ends)[..., :-1]
    return torch.cat((present, later), -1)
