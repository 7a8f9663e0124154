"""Seeds: one number for a run, and a generator of its own for each thing that draws."""

from __future__ import annotations

import hashlib
import json
import random

import numpy as np
import torch


def seed_everything(seed: int) -> None:
    """Seed the global generators of Python, NumPy and torch (all devices).

    Dropout and weight initialisation draw from the global generators. Whatever else draws gets its own generator from
    :func:`make_generator`, so adding one draw in one place does not shift all the others.

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


def derive_seed(seed: int, *names: str | int) -> int:
    """A seed that depends on the run's seed and on names, and on nothing else.

    The digest does not depend on the process, the platform or ``PYTHONHASHSEED``.

    Args:
        seed: the run's seed.
        names: what the seed is for, for instance ``"rollouts", scene_index``; 1 and "1" are different names.

    Returns:
        An integer in ``[0, 2**63)``.

    Examples:
        >>> derive_seed(0, "rollouts", 3) == derive_seed(0, "rollouts", 3)
        True
        >>> derive_seed(0, "rollouts", 3) == derive_seed(0, "rollouts", 4)
        False
    """
    digest = hashlib.blake2b(json.dumps([seed, *names]).encode(), digest_size=8).digest()
    # torch takes signed 64-bit seeds: the top bit goes.
    return int.from_bytes(digest, "little") >> 1


def make_generator(seed: int, *names: str | int, device: torch.device | str = "cpu") -> torch.Generator:
    """A torch generator seeded with :func:`derive_seed`.

    Args:
        seed: the run's seed.
        names: what the generator is for.
        device: where it draws.

    Examples:
        >>> shuffle = make_generator(0, "batches")
        >>> torch.randperm(4, generator=shuffle).sort().values.tolist()
        [0, 1, 2, 3]
    """
    return torch.Generator(device=device).manual_seed(derive_seed(seed, *names))
