"""Work that a CPU does on few rows and a GPU on all of them, so that nobody waits to hear which rows they are."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def on_host(value: Tensor) -> bool:
    """Whether values and sizes can be asked for at no cost: on a device the host would wait for the answer."""
    return value.device.type == "cpu"


def require(holds: Tensor, message: Callable[[], str]) -> None:
    """Refuse values for which something does not hold.

    Args:
        holds: ``[]`` bool.
        message: makes the words of the error. A device, which is not waited for, stops later and says less.

    Raises:
        ValueError: on the host.
    """
    if not on_host(holds):
        torch._assert_async(holds, "a value on the device is refused; run the same on the CPU, which says which.")
    elif not holds:
        raise ValueError(message())


def of_rows(there: Tensor, compute: Callable[..., Tensor], *values: Tensor) -> Tensor:
    """A function of those rows that are there, and 0 of the others.

    Args:
        there: ``[*]`` bool; on a device all rows are computed, so those that are not there must be harmless.
        compute: rows of all values to what is found of each, ``[n, ...]`` or ``[*, ...]``.
        values: ``[*, ...]`` each.

    Returns:
        ``[*, ...]``.

    Examples:
        >>> of_rows(torch.tensor([True, False]), torch.Tensor.sqrt, torch.tensor([4.0, 9.0]))
        tensor([2., 0.])
    """
    if not on_host(there):
        found = compute(*values)
        return torch.where(there.view(*there.shape, *(1,) * (found.dim() - there.dim())), found, 0)
    found = compute(*(value[there] for value in values))
    every = found.new_zeros(*there.shape, *found.shape[1:])
    every[there] = found
    return every
