"""A generator of its own for each thing that draws, made from one seed and from what the draws are for."""

from __future__ import annotations

import hashlib
import json

import torch


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


def make_generator(seed: int, *names: str | int) -> torch.Generator:
    """A torch generator seeded with :func:`derive_seed`.

    Args:
        seed: the run's seed.
        names: what the generator is for.

    Examples:
        >>> shuffle = make_generator(0, "batches")
        >>> torch.randperm(4, generator=shuffle).sort().values.tolist()
        [0, 1, 2, 3]
    """
    return torch.Generator().manual_seed(derive_seed(seed, *names))
