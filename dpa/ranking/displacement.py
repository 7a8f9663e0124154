"""Displacement from the log: the rival ranking of the paper (ADEF), in two dimensions."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Displacement(NamedTuple):
    """Displacement of rollouts from the log."""

    agent: Tensor
    """``[R, A]`` [m]; 0 where the agent has no valid logged step."""
    scene: Tensor
    """``[R]`` [m]: mean over the agents that have one."""
    ranked: Tensor
    """``[A]`` bool: the agent has a valid logged step."""


def average_displacement(position: Tensor, log: Tensor, valid: Tensor) -> Displacement:
    """Average displacement error (ADE) over the logged future.

    The realism benchmark's minADE is another number: it is three-dimensional and counts the ten steps of history and
    the current one, where the error is 0 (realism.md section 5).

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
    error = _error(position, log, valid)
    return _over_agents(error.sum(-1) / valid.sum(-1).clamp_min(1), valid)


def final_displacement(position: Tensor, log: Tensor, valid: Tensor) -> Displacement:
    """Final displacement error (FDE): that of each agent's last valid logged step.

    Arguments and errors are those of :func:`average_displacement`.

    Examples:
        >>> log, valid = torch.zeros(1, 3, 2), torch.tensor([[True, True, False]])
        >>> rollout = torch.tensor([[[[1.0, 0], [2, 0], [9, 0]]]])
        >>> final_displacement(rollout, log, valid).agent
        tensor([[2.]])
    """
    error = _error(position, log, valid)
    last = (valid * torch.arange(valid.shape[-1], device=valid.device)).argmax(-1)
    return _over_agents(error.gather(-1, last.expand(len(error), -1)[..., None])[..., 0], valid)


def agent_spread(trajectories: Tensor) -> Tensor:
    """How far apart rollouts end: the root mean square distance of an agent's last position from its mean [m].

    Args:
        trajectories: ``[R, A, T, 2]`` or more.

    Returns:
        ``[A]``.

    Examples:
        >>> agent_spread(torch.tensor([[[[3.0, 0.0]]], [[[-3.0, 0.0]]]]))
        tensor([3.])
    """
    last = trajectories[:, :, -1, :2]
    return (last - last.mean(0)).square().sum(-1).mean(0).sqrt()


def _error(position: Tensor, log: Tensor, valid: Tensor) -> Tensor:
    """Distance from the log in the plane, ``[R, A, T]`` [m]; 0 where the log is not valid."""
    if position.shape[1:3] != log.shape[:2] or valid.shape != log.shape[:2]:
        raise ValueError(
            f"rollouts, log and mask need the same agents and steps, got {tuple(position.shape[1:3])}, "
            f"{tuple(log.shape[:2])} and {tuple(valid.shape)}."
        )
    return torch.where(valid, torch.linalg.vector_norm(position[..., :2] - log[..., :2], dim=-1), 0.0)


def _over_agents(agent: Tensor, valid: Tensor) -> Displacement:
    ranked = valid.any(-1)
    return Displacement(agent, agent.sum(-1) / ranked.sum().clamp_min(1), ranked)
