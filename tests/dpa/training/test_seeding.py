"""Seeds do not depend on the process, and names give independent streams."""

from __future__ import annotations

import random

import numpy as np
import pytest
import torch

from dpa.training.seeding import seed_everything
from envs.seeding import derive_seed, make_generator


def test_all_global_generators_repeat_after_seeding() -> None:
    draws = []
    for _ in range(2):
        seed_everything(3)
        draws.append((random.random(), np.random.rand(), torch.rand(1).item()))
    assert draws[0] == draws[1]


def test_a_seed_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match=r"got -1"):
        seed_everything(-1)


def test_a_derived_seed_is_the_same_in_every_process_and_release() -> None:
    # Python salts its own string hash in each process, so a fixed number can only come from the digest. A release that
    # changed it would change every published run.
    assert derive_seed(5, "a", 1) == 6150573104205204256


def test_names_seeds_and_their_types_give_different_streams() -> None:
    seeds = [derive_seed(*args) for args in [(0,), (1,), (0, "a"), (0, "a", "b"), (0, "ab"), (0, 1), (0, "1")]]
    assert len(set(seeds)) == len(seeds)


def test_a_generator_repeats_and_leaves_the_global_one_alone() -> None:
    torch.manual_seed(0)
    expected = torch.rand(1)
    torch.manual_seed(0)
    first = torch.rand(4, generator=make_generator(0, "x"))
    assert torch.equal(first, torch.rand(4, generator=make_generator(0, "x")))
    assert torch.equal(torch.rand(1), expected)


if __name__ == "__main__":
    pytest.main([__file__])
