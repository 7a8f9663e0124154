"""Displacement from the log: the rival ranking of the paper (ADEF), in two dimensions."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Displacement(NamedTuple):
    """Mean displacement of rollouts from the log."""

    agent: Tensor
    """``[R, A]`` [m]; 0 where the agent has no valid logged step."""
    scene: Tensor
    """``[R]`` [m]: mean over the agents that have one."""
    ranked: Tensor
    """``[A]`` bool: the agent has a valid logged step."""


def average_displacement(position: Tensor, log: Tensor, valid: Tensor) -> Displacement:
    """Average displacement error (ADE) over the logged future.

    The realism benchmark's minADE is another number: it is three-dimensional and counts the ten steps of history and
    the current one, where the error is 0 (SPEC section 5).

    Args:
        position: ``[R, A, T, 2]`` or more coordinates, of which the first two count [m].
        log: ``[A, T, 2]`` or more, the same steps of the log [m].
        valid: ``[A, T]`` bool, the log is valid.

    Raises:
        ValueError: the shapes do not fit.

    Examples:
        >>> log, valid = torch.zeros(1, 4, 2), torch.tensor([[True, True, False, True]])
        >>> rollout = log + torch.tensor([3.0, 4.0])
        >>> average_displacement(rollout[None], log, valid).agent
        tensor([[5.]])
    """
    if position.shape[1:3] != log.shape[:2] or valid.shape != log.shape[:2]:
        raise ValueError(
            f"rollouts, log and mask need the same agents and steps, got {tuple(position.shape[1:3])}, "
            f"{tuple(log.shape[:2])} and {tuple(valid.shape)}."
        )
    error = torch.linalg.vector_norm(position[..., :2] - log[..., :2], dim=-1)
    error = torch.where(valid, error, 0.0)
    agent = error.sum(-1) / valid.sum(-1).clamp_min(1)
    ranked = valid.any(-1)
    return Displacement(agent, agent.sum(-1) / ranked.sum().clamp_min(1), ranked)
