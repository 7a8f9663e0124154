"""From a ranked group of rollouts to the pairs that a loss reads: pure functions on indices.

Every function takes distances ``[S, K]`` (any ranking: preference distance or ADE; smaller is better) or sizes, and
gives indices of rollouts ``[S, M]``. Ties go to the rollout with the smaller index.
"""

from __future__ import annotations

import torch
from torch import Tensor


def nearest(distance: Tensor, num: int) -> Tensor:
    """The rollouts nearest to the log, nearest first (new labels of SFT-best*, paper section 6).

    Args:
        distance: ``[S, K]``.
        num: M, at most K.

    Returns:
        ``[S, M]`` int64.

    Raises:
        ValueError: more rollouts are asked for than there are, or a distance is not finite.

    Examples:
        >>> nearest(torch.tensor([[0.5, 0.1, 0.3]]), 2)
        tensor([[1, 2]])
    """
    order = _order(distance)
    if not 0 < num <= order.shape[-1]:
        raise ValueError(f"asked for {num} nearest of {order.shape[-1]} rollouts; ask for 1 to {order.shape[-1]}.")
    return order[:, :num]


def nearest_farthest(distance: Tensor, num: int) -> tuple[Tensor, Tensor]:
    """The nearest rollouts against the farthest ones, the widest pair first (paper: 16 + 16 of 64).

    Args:
        distance: ``[S, K]``.
        num: M pairs, at most K / 2.

    Returns:
        preferred ``[S, M]`` int64 (nearest first) and unpreferred ``[S, M]`` int64 (farthest first).

    Raises:
        ValueError: the group is too small for disjoint sides, or a distance is not finite.

    Examples:
        >>> nearest_farthest(torch.tensor([[0.5, 0.1, 0.3, 0.9]]), 2)
        (tensor([[1, 2]]), tensor([[3, 0]]))
    """
    order = _order(distance)
    _check_pairs(num, order.shape[-1])
    return order[:, :num], order[:, -num:].flip(-1)


def random_pairs(distance: Tensor, num: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Disjoint pairs drawn at random, each turned so that the nearer rollout is preferred.

    Args:
        distance: ``[S, K]``.
        num: M pairs, at most K / 2.
        generator: on the CPU; the only source of randomness.

    Returns:
        preferred ``[S, M]`` int64 and unpreferred ``[S, M]`` int64.

    Raises:
        ValueError: the group is too small for disjoint pairs, or a distance is not finite.

    Examples:
        >>> preferred, unpreferred = random_pairs(torch.arange(8.0)[None], 4, torch.Generator().manual_seed(0))
        >>> bool((preferred < unpreferred).all())
        True
    """
    rank = _order(distance).argsort(-1)
    _check_pairs(num, rank.shape[-1])
    drawn = random_rollouts(*rank.shape, 2 * num, generator).to(rank.device)
    first, second = drawn.chunk(2, -1)
    nearer = rank.gather(-1, first) < rank.gather(-1, second)
    return torch.where(nearer, first, second), torch.where(nearer, second, first)


def random_rollouts(num_scenes: int, num_rollouts: int, num: int, generator: torch.Generator) -> Tensor:
    """Rollouts drawn without repetition: the unpreferred side of adversarial AFD, whose preferred side is the log.

    Args:
        num_scenes: S.
        num_rollouts: K.
        num: M, at most K.
        generator: on the CPU; the only source of randomness.

    Returns:
        ``[S, M]`` int64.

    Raises:
        ValueError: more rollouts are asked for than there are.

    Examples:
        >>> random_rollouts(2, 5, 5, torch.Generator().manual_seed(0)).sort(-1).values
        tensor([[0, 1, 2, 3, 4],
                [0, 1, 2, 3, 4]])
    """
    if not 0 < num <= num_rollouts:
        raise ValueError(f"asked for {num} of {num_rollouts} rollouts; ask for 1 to {num_rollouts}.")
    return torch.rand(num_scenes, num_rollouts, generator=generator).argsort(-1)[:, :num]


def _order(distance: Tensor) -> Tensor:
    """``[S, K]`` indices, nearest first, ties by index."""
    if distance.dim() != 2:
        raise ValueError(f"distances must be [S, K], got shape {tuple(distance.shape)}.")
    if not torch.isfinite(distance).all():
        raise ValueError("a distance is not finite; rank the rollouts again (valid distances are finite).")
    return distance.argsort(dim=-1, stable=True)


def _check_pairs(num: int, num_rollouts: int) -> None:
    if num < 1 or 2 * num > num_rollouts:
        raise ValueError(
            f"{num} disjoint pairs need {2 * num} rollouts per scene, and there are {num_rollouts}; "
            f"ask for 1 to {num_rollouts // 2} pairs or roll out more."
        )
