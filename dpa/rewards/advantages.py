"""How much better a rollout was than the others of its group."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

Baseline = Literal["leave_one_out", "mean"]
Scale = Literal["group", "none"]
SMALLEST_SPREAD = 1e-5
"""Spread of a group's rewards, as a share of the largest of them, below which they differ by rounding alone."""


def advantages(reward: Tensor, *, baseline: Baseline = "leave_one_out", scale: Scale = "none") -> Tensor:
    """How much better each rollout was than the others of its group.

    Args:
        reward: ``[S, K]`` of scenes, ``[S, K, A]`` of agents or ``[S, K, A, T]`` of decisions, K of 2 or more.

    Keyword Args:
        baseline: the mean of the other K - 1 rollouts (RLOO; Ahmadian et al., 2024), in which the rollout has no part,
            or that of all K (GRPO; Shao et al., 2024), whose advantages are (K - 1) / K of the former.
        scale: none (RLOO, whose gradient is unbiased), or divide by the standard deviation of the group (GRPO), each
            agent's own where agents have rewards of their own, so that all groups and agents weigh alike, and of all
            its decisions the largest, so that those after which little differs weigh little. Where that
            is below :data:`SMALLEST_SPREAD` there is nothing to prefer, and the advantage is 0.

    Returns:
        Like ``reward``.

    Raises:
        ValueError: an unknown choice, or a group of one.

    Examples:
        >>> import torch
        >>> advantages(torch.tensor([[1.0, 2.0, 6.0]]))
        tensor([[-3.0000, -1.5000,  4.5000]])
        >>> advantages(torch.tensor([[1.0, 2.0, 6.0]]), baseline="mean")
        tensor([[-2., -1.,  3.]])
        >>> advantages(torch.tensor([[-1.0, 1.0], [5.0, 5.0]]), baseline="mean", scale="group")
        tensor([[-0.7071,  0.7071],
                [ 0.0000,  0.0000]])
    """
    for name, value, known in (("baseline", baseline, Baseline), ("scale", scale, Scale)):
        if value not in get_args(known):
            raise ValueError(f"{name} must be {' or '.join(get_args(known))}, got {value!r}.")
    rollouts = reward.shape[1]
    if rollouts < 2:
        raise ValueError("a rollout is compared with the others of its group, and there are none; roll out 2 or more.")
    above = reward - reward.mean(1, keepdim=True)
    if baseline == "leave_one_out":
        above = above * rollouts / (rollouts - 1)
    if scale == "none":
        return above
    spread, largest = reward.std(1, keepdim=True), reward.abs().amax(1, keepdim=True)
    if reward.dim() == 4:
        spread, largest = (value.amax(-1, keepdim=True) for value in (spread, largest))
    return torch.where(spread > SMALLEST_SPREAD * largest, above / spread, 0)
