"""How far two ways to rank the same rollouts agree."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import rankdata


def rank_correlation(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """Spearman's rank correlation along the last dimension, ties at their mean rank.

    Args:
        first: ``[..., K]``.
        second: ``[..., K]``.

    Returns:
        ``[...]`` between -1 and 1; nan where one of the two is constant, so that it ranks nothing.

    Raises:
        ValueError: the shapes differ.

    Examples:
        >>> rank_correlation([[1.0, 2, 3], [5, 5, 5]], [[4.0, 6, 5], [1, 2, 3]])
        array([0.5, nan])
    """
    values = [np.asarray(value, dtype=np.float64) for value in (first, second)]
    if values[0].shape != values[1].shape:
        raise ValueError(f"two rankings of the same rollouts are compared, got shapes {[v.shape for v in values]}.")
    ranks = np.stack([rankdata(value, axis=-1) for value in values])
    ranks -= ranks.mean(-1, keepdims=True)
    norm = np.linalg.norm(ranks, axis=-1).prod(0)
    return np.divide(ranks.prod(0).sum(-1), norm, out=np.full(norm.shape, np.nan), where=norm > 0)


def same_order(first: ArrayLike, second: ArrayLike) -> NDArray[np.float64]:
    """For every pair of rollouts, whether both measures order it alike; a tie in either is half a yes.

    Args:
        first: ``[K]``.
        second: ``[K]``.

    Returns:
        ``[K * (K - 1) / 2]`` of 0, 0.5 and 1, pairs (i, j) with i < j in the order of :func:`numpy.triu_indices`.

    Examples:
        >>> same_order([1.0, 2.0, 3.0], [1.0, 3.0, 3.0])
        array([1. , 1. , 0.5])
    """
    i, j = np.triu_indices(len(np.asarray(first)), 1)
    signs = [np.sign(np.asarray(v, dtype=np.float64)[j] - np.asarray(v, dtype=np.float64)[i]) for v in (first, second)]
    return (1 + signs[0] * signs[1]) / 2
