"""Which members of a sequence are meant: by positions, one position or a mask."""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Number

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


def positions(index: int | Iterable[int] | Tensor, count: int) -> NDArray[np.int64]:
    """Positions of some of ``count`` members, in the order given.

    Args:
        index: positions, one of them alone, or a mask of all members.
        count: members.

    Returns:
        ``[S]`` int64; whether they are there is left to whoever takes them.

    Raises:
        IndexError: a mask of another length, or what is no whole number.

    Examples:
        >>> positions([2, 0], 3), positions(1, 3), positions(np.array([2, 5, 7]) > 4, 3)
        (array([2, 0]), array([1]), array([1, 2]))
    """
    if isinstance(index, Tensor):
        index = index.detach().cpu().numpy()
    given = np.asarray(index if isinstance(index, Number | np.generic | np.ndarray) else list(index))
    if given.dtype == bool:
        if given.shape != (count,):
            raise IndexError(f"a mask has one value for each of {count}, got shape {given.shape}.")
        return np.flatnonzero(given)
    if given.ndim > 1 or (given.size and not np.issubdtype(given.dtype, np.integer)):
        raise IndexError(f"positions are whole numbers or a mask, got shape {given.shape} of {given.dtype}.")
    return np.atleast_1d(given).astype(np.int64)
