"""Time until an agent reaches the one that it follows (realism.md section 3.2)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from envs.geometry.frames import rotate, wrap_angle

LONGEST_TIME = 5.0
"""Time to collision is cut at this value [s]."""
_FOLLOW_ANGLE = math.radians(75)
"""A leader's heading differs by at most this angle [rad]."""
_FOLLOW_ANGLE_SMALL_OVERLAP = math.radians(10)
"""The same where the two overlap sideways by less than :data:`_SMALL_OVERLAP` [rad]."""
_SMALL_OVERLAP = 0.5
"""Overlap sideways below which a leader must be nearly parallel [m]."""


def time_to_collision(
    position: Tensor,
    heading: Tensor,
    speed: Tensor,
    extent: Tensor,
    valid: Tensor,
    ego: Tensor,
    *,
    unwrapped_turn: bool = False,
) -> Tensor:
    """Time until agents reach their leaders at present speeds.

    Args:
        position: ``[C, A, T, 2]`` [m].
        heading: ``[C, A, T]`` [rad].
        speed: ``[C, A, T]`` [m/s].
        extent: ``[C, A, 3]`` or ``[C, A, 2]``, length and width first [m].
        valid: ``[C, A, T]`` bool, the agent may lead.
        ego: ``[E]`` int64, agents to measure.

    Keyword Args:
        unwrapped_turn: differences of headings are not wrapped, as in the code of the challenge.

    Returns:
        ``[C, E, T]`` [s], at most :data:`LONGEST_TIME`.

    Examples:
        >>> position = torch.tensor([[[[0.0, 0.0]], [[14.0, 0.0]]]])
        >>> heading, speed = torch.zeros(1, 2, 1), torch.tensor([[[8.0], [3.0]]])
        >>> extent, valid = torch.tensor([[[4.0, 2.0], [4.0, 2.0]]]), torch.ones(1, 2, 1, dtype=torch.bool)
        >>> time_to_collision(position, heading, speed, extent, valid, torch.arange(2))[0, :, 0]
        tensor([2., 5.])
    """
    length, width = extent[..., 0, None], extent[..., 1, None]
    result = []
    for one in ego.split(1):  # a row of length 1 stays, so that no index is read back
        turn = heading - heading[:, one]
        if not unwrapped_turn:
            turn = wrap_angle(turn)
        turn = turn.abs()
        cos, sin = turn.cos().abs(), turn.sin().abs()
        ahead, aside = rotate(position - position[:, one], -heading[:, one]).unbind(-1)
        gap = ahead - length[:, one] / 2 - (length * cos + width * sin) / 2
        overlap = aside.abs() - width[:, one] / 2 - (length * sin + width * cos) / 2
        aligned = (turn <= _FOLLOW_ANGLE) & ((overlap < -_SMALL_OVERLAP) | (turn <= _FOLLOW_ANGLE_SMALL_OVERLAP))
        followed = (gap > 0) & (overlap < 0) & aligned & valid
        nearest, leader = torch.where(followed, gap, torch.inf).min(1, keepdim=True)
        closing = speed[:, one] - speed.gather(1, leader)
        result.append(torch.where(closing > 0, (nearest / closing).clamp(max=LONGEST_TIME), LONGEST_TIME))
    return torch.cat(result, 1)
