"""One seed for all that draws from the global generators."""

from __future__ import annotations

import random

import numpy as np
import torch


def seed_everything(seed: int) -> None:
    """Seed the global generators of Python, NumPy and torch (all devices).

    Dropout and weight initialisation draw from the global generators. Whatever else draws gets its own generator from
    :func:`envs.seeding.make_generator`, so adding one draw in one place does not shift all the others.

    Args:
        seed: the run's seed, ``0 <= seed < 2**32`` (NumPy accepts no more).

    Raises:
        ValueError: the seed is out of range.

    Examples:
        >>> seed_everything(0)
        >>> first = torch.rand(2)
        >>> seed_everything(0)
        >>> bool((torch.rand(2) == first).all())
        True
    """
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed must lie in [0, 2**32), got {seed}. Choose a smaller seed.")
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
