"""Pairs from ranked groups."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpa.preferences.pairs import nearest, nearest_farthest, random_pairs, random_rollouts


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31 - 1), half=st.integers(1, 8), extra=st.integers(0, 3))
def test_nearest_farthest_are_disjoint_and_separated(seed: int, half: int, extra: int) -> None:
    distance = torch.randint(0, 6, (3, 2 * half + extra), generator=generator(seed)).float()
    preferred, unpreferred = nearest_farthest(distance, half)
    assert preferred.shape == unpreferred.shape == (3, half)
    for row in torch.cat((preferred, unpreferred), -1):
        assert len(set(row.tolist())) == 2 * half
    near, far = distance.gather(-1, preferred), distance.gather(-1, unpreferred)
    assert bool((near.max(-1).values <= far.min(-1).values).all())
    assert bool(((far - near).diff(dim=-1) <= 0).all()), "the widest pair comes first"


def test_ties_go_to_the_smaller_index() -> None:
    preferred, unpreferred = nearest_farthest(torch.zeros(1, 6), 2)
    assert preferred.tolist() == [[0, 1]] and unpreferred.tolist() == [[5, 4]]
    assert nearest(torch.zeros(1, 6), 3).tolist() == [[0, 1, 2]]


def test_random_pairs_are_disjoint_oriented_and_repeat_with_the_seed() -> None:
    distance = torch.rand(4, 10, generator=generator(1))
    preferred, unpreferred = random_pairs(distance, 5, generator(2))
    assert bool((distance.gather(-1, preferred) < distance.gather(-1, unpreferred)).all())
    assert torch.equal(torch.cat((preferred, unpreferred), -1).sort(-1).values, torch.arange(10).expand(4, 10))
    assert all(map(torch.equal, (preferred, unpreferred), random_pairs(distance, 5, generator(2))))
    assert not torch.equal(preferred, random_pairs(distance, 5, generator(3))[0])


def test_random_rollouts_do_not_repeat_within_a_scene() -> None:
    drawn = random_rollouts(50, 8, 6, generator())
    assert all(len(set(row)) == 6 for row in drawn.tolist())
    assert set(drawn.unique().tolist()) == set(range(8))


@pytest.mark.parametrize("call", [nearest_farthest, lambda d, m: random_pairs(d, m, generator())])
@pytest.mark.parametrize("num", [0, 4])
def test_too_many_pairs_are_refused_with_the_fix(call, num: int) -> None:
    with pytest.raises(ValueError, match="1 to 3 pairs"):
        call(torch.rand(2, 7), num)


def test_too_many_rollouts_and_distances_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match="1 to 7"):
        nearest(torch.rand(2, 7), 8)
    with pytest.raises(ValueError, match="1 to 7"):
        random_rollouts(2, 7, 8, generator())
    with pytest.raises(ValueError, match="not finite"):
        nearest(torch.tensor([[0.0, torch.nan]]), 1)
