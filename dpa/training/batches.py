"""Training items and batches: pure functions of (seed, step), so that a resumed run sees what it would have seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, TypeVar

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn import functional as F

from dpa.models import collate_contexts
from dpa.models.context import Context
from envs import keys
from envs.seeding import make_generator


class Item(NamedTuple):
    """Tokens of some rollouts (or of the log) of one scene.

    Attributes:
        context: uncollated.
        tokens: ``[M, A, T, ...]``.
        token_valid: ``[A, T]`` bool.
        labels: ``[M, A, T, ...]``, what to predict where it is not the tokens themselves (noisy tokenization).
    """

    context: Context
    tokens: Tensor
    token_valid: Tensor
    labels: Tensor | None = None


def collate_items(items: Sequence[Item]) -> TensorDict:
    """A batch for a loss: ``context``, ``tokens``, ``labels`` ``[S, M, A, T, ...]``, ``token_valid`` ``[S, 1, A, T]``.

    Args:
        items: S items of equal M and T.
    """
    agents = max(item.tokens.shape[1] for item in items)

    def pad(value: Tensor, dim: int = 1) -> Tensor:
        return F.pad(value, (0, 0) * (value.dim() - 1 - dim) + (0, agents - value.shape[dim]))

    return TensorDict(
        {
            "context": collate_contexts([item.context for item in items]),
            keys.TOKENS: torch.stack([pad(item.tokens) for item in items]),
            keys.LABELS: torch.stack([pad(item.tokens if item.labels is None else item.labels) for item in items]),
            keys.TOKEN_VALID: torch.stack([pad(item.token_valid, 0) for item in items])[:, None],
        },
        batch_size=[len(items)],
    )


class WithTokens(Protocol):
    """What tokens are learnt from: an :class:`Item`, or rollouts of a scene."""

    token_valid: Tensor


Learnt = TypeVar("Learnt", bound=WithTokens)


def with_tokens(items: list[Learnt]) -> list[Learnt]:
    """Those that have something to learn; if there are none, one that does not count: no rank is without a pass."""
    return [item for item in items if item.token_valid.any()] or items[:1]


def micro_batches(sizes: Sequence[int], max_rows: int) -> list[list[int]]:
    """Split a batch into parts of similar size, so that little is padded; accumulate gradients over them.

    Weigh the loss of each part by its share of the items, and the sum is the mean over items.

    Args:
        sizes: rows of each item (rollouts x agents).
        max_rows: bound on the padded rows of a part; a single item may exceed it.

    Returns:
        Positions in ``sizes``, part by part, small items first.

    Examples:
        >>> micro_batches([10, 2, 9, 2], max_rows=20)
        [[1, 3], [2, 0]]
    """
    parts: list[list[int]] = []
    for position in sorted(range(len(sizes)), key=lambda i: (sizes[i], i)):
        # A part holds items of up to twice the size of its smallest one: half of it is padding at worst.
        smallest = sizes[parts[-1][0]] if parts else 0
        if parts and (len(parts[-1]) + 1) * sizes[position] <= max_rows and sizes[position] <= 2 * smallest:
            parts[-1].append(position)
        else:
            parts.append([position])
    return parts


class ShuffledOrder:
    """Which items a step takes: a new permutation every epoch, decided by the seed alone.

    Args:
        num_items: items of the data set.
        batch_size: items of a step; it may exceed ``num_items``.
        seed: of the permutations.

    Raises:
        ValueError: nothing to draw from.

    Examples:
        >>> order = ShuffledOrder(4, batch_size=2, seed=0)
        >>> sorted(order(0) + order(1))
        [0, 1, 2, 3]
    """

    def __init__(self, num_items: int, batch_size: int, seed: int) -> None:
        if num_items < 1 or batch_size < 1:
            raise ValueError(f"num_items and batch_size must be positive, got {num_items} and {batch_size}.")
        self.num_items, self.batch_size, self.seed = num_items, batch_size, seed
        self._epoch, self._order = -1, []

    def __call__(self, step: int) -> list[int]:
        """Indices of the items of one step."""
        first = step * self.batch_size
        return [self._item(position) for position in range(first, first + self.batch_size)]

    def _item(self, position: int) -> int:
        epoch, offset = divmod(position, self.num_items)
        if epoch != self._epoch:
            generator = make_generator(self.seed, "epoch", epoch)
            self._epoch, self._order = epoch, torch.randperm(self.num_items, generator=generator).tolist()
        return self._order[offset]
