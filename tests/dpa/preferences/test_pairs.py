"""Pairs from ranked groups."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpa.preferences.pairs import (
    agent_preference,
    all_pairs,
    nearest,
    nearest_farthest,
    random_pairs,
    random_rollouts,
    separated,
    thin_out,
)


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


SEEDS = st.integers(0, 2**31 - 1)


def tied_distances(seed: int, scenes: int, rollouts: int) -> torch.Tensor:
    """``[S, K]`` with many ties."""
    return torch.randint(0, 5, (scenes, rollouts), generator=generator(seed)).float()


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, rollouts=st.integers(2, 9))
def test_all_pairs_are_every_two_rollouts_once_the_nearer_one_preferred(seed: int, rollouts: int) -> None:
    distance = tied_distances(seed, 3, rollouts)
    preferred, unpreferred = all_pairs(distance)
    near, far = distance.gather(1, preferred), distance.gather(1, unpreferred)
    assert bool((near <= far).all())
    assert bool((preferred < unpreferred)[near == far].all()), "ties go to the smaller index"
    for row in zip(preferred.tolist(), unpreferred.tolist(), strict=True):
        found = {frozenset(pair) for pair in zip(*row, strict=True)}
        assert len(found) == len(row[0]) == rollouts * (rollouts - 1) // 2


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, half=st.integers(1, 5), way=st.sampled_from([nearest_farthest, random_pairs]))
def test_disjoint_pairs_are_some_of_all_pairs(seed: int, half: int, way) -> None:
    distance = tied_distances(seed, 2, 2 * half + 1)
    every = [set(zip(*row, strict=True)) for row in zip(*(side.tolist() for side in all_pairs(distance)), strict=True)]
    options = (generator(seed),) if way is random_pairs else ()
    for row, (preferred, unpreferred) in enumerate(zip(*way(distance, half, *options), strict=True)):
        pairs = list(zip(preferred.tolist(), unpreferred.tolist(), strict=True))
        near, far = distance[row][preferred], distance[row][unpreferred]
        # Among ties, the farthest rollouts are those with the larger index, as in all pairs.
        assert set(pairs) <= every[row] and len(set(pairs)) == half and bool((near <= far).all())


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, margin=st.floats(0, 5), relative=st.booleans())
def test_separated_pairs_are_those_with_the_gap(seed: int, margin: float, relative: bool) -> None:
    distance = torch.rand(3, 6, generator=generator(seed), dtype=torch.float64) * 4
    preferred, unpreferred = all_pairs(distance)
    kept = separated(distance, preferred, unpreferred, margin, relative=relative)
    for scene in range(3):
        least = margin * float(distance[scene].mean()) if relative else margin
        for pair in range(15):
            gap = float(distance[scene, unpreferred[scene, pair]] - distance[scene, preferred[scene, pair]])
            assert bool(kept[scene, pair]) == (gap >= least)
    assert bool(separated(distance, preferred, unpreferred, 0.0).all())


def test_a_margin_leaves_no_ties_where_all_distances_are_zero() -> None:
    distance = torch.zeros(1, 4)
    assert not separated(distance, *all_pairs(distance), 0.1, relative=True).any()
    assert separated(distance, *all_pairs(distance), 0.0, relative=True).all()


@settings(max_examples=50, deadline=None)
@given(seed=SEEDS, scenes=st.integers(1, 30), more=st.floats(0, 2), rankings=st.floats(0.05, 6))
def test_rankings_are_the_mean_of_pairs_per_scene_and_grow_with_it(
    seed: int, scenes: int, more: float, rankings: float
) -> None:
    every = torch.ones(scenes, 9, dtype=torch.bool)
    kept = thin_out(every, rankings, generator(seed))
    counts = kept.sum(1)
    assert int(counts.sum()) == int(rankings) * scenes + round((rankings - int(rankings)) * scenes)
    assert int(counts.max() - counts.min()) <= 1
    assert torch.equal(kept, thin_out(every, rankings, generator(seed)))
    assert not (kept & ~thin_out(every, rankings + more, generator(seed))).any(), "fewer rankings are part of more"


def test_a_scene_with_fewer_pairs_gives_those_that_it_has() -> None:
    kept = torch.tensor([[True, False, True, False], [False] * 4, [True] * 4])
    assert thin_out(kept, 3.0, generator()).sum(1).tolist() == [2, 0, 3]
    assert not (thin_out(kept, 3.0, generator()) & ~kept).any()
    assert torch.equal(thin_out(kept, 100.0, generator()), kept)


def test_rankings_differ_with_the_seed() -> None:
    every = torch.ones(20, 9, dtype=torch.bool)
    assert not torch.equal(thin_out(every, 1.5, generator(0)), thin_out(every, 1.5, generator(1)))


@settings(max_examples=25, deadline=None)
@given(seed=SEEDS, margin=st.sampled_from([0.0, 1.0, 2.5]))
def test_each_agent_says_by_its_own_distance_whether_it_agrees(seed: int, margin: float) -> None:
    agent_distance = torch.randint(0, 5, (2, 6, 3), generator=generator(seed)).float()
    preferred, unpreferred = all_pairs(agent_distance.sum(-1))
    found = agent_preference(agent_distance, preferred, unpreferred, margin)
    assert found.shape == (2, 15, 3)
    for s in range(2):
        for m in range(15):
            for a in range(3):
                gap = float(agent_distance[s, unpreferred[s, m], a] - agent_distance[s, preferred[s, m], a])
                want = 0 if gap == 0 or abs(gap) < margin else (1 if gap > 0 else -1)
                assert int(found[s, m, a]) == want
    assert torch.equal(agent_preference(agent_distance, unpreferred, preferred, margin), -found)


@pytest.mark.parametrize("margin", [-1.0, float("nan")])
def test_a_margin_that_is_none_is_refused(margin: float) -> None:
    pairs = (torch.tensor([[0]]), torch.tensor([[1]]))
    with pytest.raises(ValueError, match="margin is 0 or more"):
        separated(torch.rand(1, 2), *pairs, margin)
    with pytest.raises(ValueError, match="margin is 0 or more"):
        agent_preference(torch.rand(1, 2, 3), *pairs, margin)


@pytest.mark.parametrize("rankings", [0.0, -1.0, float("nan"), float("inf")])
def test_rankings_that_are_none_are_refused(rankings: float) -> None:
    with pytest.raises(ValueError, match="must be more than 0"):
        thin_out(torch.ones(2, 2, dtype=torch.bool), rankings, generator())


def test_one_rollout_has_no_pair() -> None:
    with pytest.raises(ValueError, match="disjoint pairs need 2 rollouts"):
        all_pairs(torch.rand(3, 1))
