"""From a ranked group of rollouts to the pairs that a loss reads: pure functions on indices.

Functions take distances ``[S, K]`` (any ranking: preference distance or ADE; smaller is better) or sizes, and give
indices of rollouts ``[S, M]``. Ties go to the rollout with the smaller index. Scenes may keep different numbers of
pairs: which ones is a mask ``[S, M]`` beside the indices.
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


def all_pairs(distance: Tensor) -> tuple[Tensor, Tensor]:
    """Every two rollouts of a scene, each pair turned so that the nearer one is preferred.

    Args:
        distance: ``[S, K]``.

    Returns:
        preferred ``[S, M]`` int64 and unpreferred ``[S, M]`` int64, M = K (K - 1) / 2: the nearest against all others
        from the next one on, then the second nearest, and so on.

    Raises:
        ValueError: there is one rollout only, or a distance is not finite.

    Examples:
        >>> all_pairs(torch.tensor([[0.5, 0.1, 0.3]]))
        (tensor([[1, 1, 2]]), tensor([[2, 0, 0]]))
    """
    order = _order(distance)
    _check_pairs(1, order.shape[-1])
    nearer, farther = torch.triu_indices(order.shape[-1], order.shape[-1], offset=1, device=order.device)
    return order[:, nearer], order[:, farther]


def separated(
    distance: Tensor, preferred: Tensor, unpreferred: Tensor, margin: float, *, relative: bool = False
) -> Tensor:
    """Which pairs are clear: the unpreferred rollout is farther by at least a margin.

    Args:
        distance: ``[S, K]``.
        preferred: ``[S, M]`` indices of rollouts.
        unpreferred: ``[S, M]``, pair by pair.
        margin: 0 or more, in units of the distance.
        relative: the margin is a share of the mean distance of the scene instead.

    Returns:
        ``[S, M]`` bool. A margin of 0 keeps ties too; any other does not, even where the mean distance is 0.

    Raises:
        ValueError: the margin is negative, or a distance is not finite.

    Examples:
        >>> distance = torch.tensor([[0.0, 1.0, 5.0]])
        >>> separated(distance, *all_pairs(distance), margin=4.0)
        tensor([[False,  True,  True]])
        >>> separated(distance, *all_pairs(distance), margin=1.0, relative=True)
        tensor([[False,  True,  True]])
    """
    _check_finite(distance)
    if not margin >= 0:
        raise ValueError(f"a margin is 0 or more, got {margin}.")
    least = margin * distance.mean(-1, keepdim=True) if relative else margin
    gap = distance.gather(-1, unpreferred) - distance.gather(-1, preferred)
    return (gap >= least) & ((gap > 0) | (margin == 0))


def thin_out(kept: Tensor, rankings: float, generator: torch.Generator) -> Tensor:
    """Choose r rankings per training example (method.md section 4; figure 7, left).

    A ranking is a pair and a training example is a scene: every scene gives floor(r) pairs, and a share r - floor(r)
    of the scenes one more, so that r is the mean. Below 1 only a share r of the scenes is learnt from. A scene with
    fewer pairs gives those that it has; the others do not make up for it. With the same seed the choice for a smaller
    r is part of that for a larger one, so that a study over r varies nothing else.

    Args:
        kept: ``[S, M]`` bool, pairs to choose from.
        rankings: r, more than 0.
        generator: on the CPU; the only source of randomness.

    Returns:
        ``[S, M]`` bool, some of ``kept``.

    Raises:
        ValueError: r is not more than 0.

    Examples:
        >>> kept = torch.ones(4, 6, dtype=torch.bool)
        >>> sorted(thin_out(kept, 1.5, torch.Generator().manual_seed(0)).sum(-1).tolist())
        [1, 1, 2, 2]
        >>> sorted(thin_out(kept, 0.5, torch.Generator().manual_seed(0)).sum(-1).tolist())
        [0, 0, 1, 1]
    """
    if not rankings > 0 or rankings == float("inf"):
        raise ValueError(f"rankings per example must be more than 0, got {rankings}.")
    scenes = torch.randperm(len(kept), generator=generator).to(kept.device)
    place = torch.rand(kept.shape, generator=generator).to(kept.device).masked_fill(~kept, 2.0).argsort(-1).argsort(-1)
    whole = int(rankings)
    wanted = torch.full((len(kept), 1), whole, device=kept.device)
    wanted[scenes[: round((rankings - whole) * len(kept))]] += 1
    return kept & (place < wanted)


def agent_preference(agent_distance: Tensor, preferred: Tensor, unpreferred: Tensor, margin: float = 0.0) -> Tensor:
    """Whether each agent, by its own distance, agrees with the pairs: what its own tokens may be credited with.

    Args:
        agent_distance: ``[S, K, A]``; 0 for agents that took no part.
        preferred: ``[S, M]`` indices of rollouts.
        unpreferred: ``[S, M]``, pair by pair.
        margin: 0 or more; an agent whose two distances differ by less, or not at all, has no say.

    Returns:
        ``[S, M, A]`` int64: 1 where the agent is nearer to its log in the preferred rollout, -1 in the unpreferred
        one, and 0 where it has no say.

    Raises:
        ValueError: the margin is negative, or a distance is not finite.

    Examples:
        >>> agent_distance = torch.tensor([[[0.0, 2.0, 1.0], [3.0, 1.0, 1.0]]])
        >>> agent_preference(agent_distance, torch.tensor([[0]]), torch.tensor([[1]]))
        tensor([[[ 1, -1,  0]]])
    """
    _check_finite(agent_distance)
    if not margin >= 0:
        raise ValueError(f"a margin is 0 or more, got {margin}.")
    sides = (side[..., None].expand(-1, -1, agent_distance.shape[-1]) for side in (preferred, unpreferred))
    near, far = (agent_distance.gather(1, side) for side in sides)
    gap = far - near
    return gap.sign().long() * (gap.abs() >= margin)


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
    _check_finite(distance)
    return distance.argsort(dim=-1, stable=True)


def _check_finite(distance: Tensor) -> None:
    if not torch.isfinite(distance).all():
        raise ValueError("a distance is not finite; rank the rollouts again (valid distances are finite).")


def _check_pairs(num: int, num_rollouts: int) -> None:
    if num < 1 or 2 * num > num_rollouts:
        raise ValueError(
            f"{num} disjoint pairs need {2 * num} rollouts per scene, and there are {num_rollouts}; "
            f"ask for 1 to {num_rollouts // 2} pairs or roll out more."
        )
