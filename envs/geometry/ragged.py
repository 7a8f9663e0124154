"""Lists of different lengths in one flat row, read back as dense tables of similar lengths."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_ENTRIES_PER_TABLE = 1 << 16
"""Entries of one table: small enough for the work on it to stay in a core's cache."""
_GROWTH = 1.25
"""Lists whose lengths differ by less than this factor share a table."""


@dataclass(frozen=True)
class Ragged:
    """Lists of int64; list ``i`` is ``values[start[i] : start[i] + count[i]]``.

    Attributes:
        values: ``[X]`` int64, all lists one after the other.
        start: ``[I]`` int64.
        count: ``[I]`` int64, at least 1.

    Examples:
        >>> lists = Ragged.from_parts(2, [(torch.tensor([1, 0]), torch.tensor([1, 2]), torch.tensor([7, 8, 9]))])
        >>> [(row.tolist(), table.tolist()) for row, table, _ in lists.tables(torch.tensor([0, 1, 0]))]
        [([1], [[7]]), ([0, 2], [[8, 8], [9, 9]])]
    """

    values: Tensor
    start: Tensor
    count: Tensor

    @classmethod
    def from_parts(cls, num_lists: int, parts: Sequence[tuple[Tensor, Tensor, Tensor]]) -> Ragged:
        """Join parts that hold each list once, in any order.

        Args:
            num_lists: I.
            parts: which lists ``[i]``, their lengths ``[i]`` and their values, one after the other.
        """
        index, count, values = (torch.cat(column) for column in zip(*parts, strict=True))
        start = torch.empty(num_lists, dtype=torch.int64, device=index.device)
        length = torch.empty_like(start)
        start[index] = count.cumsum(0) - count
        length[index] = count
        return cls(values, start, length)

    def tables(self, chosen: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Read lists as dense tables, short lists first.

        Args:
            chosen: ``[n]`` int64, a list for each row; a list may be chosen many times.

        Yields:
            Row indices ``[k]`` into ``chosen``; a table ``[c, k]`` with their lists as columns, the last value repeated
            to the common length; and a mask ``[c, k]`` of what is not repeated. Each row comes in exactly one table.
            Lists are columns since there are more of them than entries in one: work along them is what is fast.
        """
        widths = _widths(int(self.count.max()), self.count.device)
        width_class = torch.searchsorted(widths, self.count).short()[chosen]  # short numbers sort faster
        rows_by_class = torch.argsort(width_class, stable=True).split(
            torch.bincount(width_class, minlength=len(widths)).tolist()
        )
        for width, rows in zip(widths.tolist(), rows_by_class, strict=True):
            entry = torch.arange(width, device=self.count.device)[:, None]
            for row in rows.split(max(1, _ENTRIES_PER_TABLE // width)) if len(rows) else ():
                lists = chosen[row]
                last = self.count[lists] - 1
                place = torch.minimum(entry, last).add_(self.start[lists])
                yield row, self.values.index_select(0, place.flatten()).view(place.shape), entry <= last


def _widths(longest: int, device: torch.device) -> Tensor:
    widths = [1]
    while widths[-1] < longest:
        widths.append(min(longest, max(widths[-1] + 1, int(widths[-1] * _GROWTH))))
    return torch.tensor(widths, device=device)
