"""Agreement of rankings, against scipy and by counting."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from scipy.stats import kendalltau, spearmanr

from dpa.ranking.agreement import rank_correlation, same_order

GROUPS = arrays.arrays(np.float64, (2, 7), elements=st.integers(0, 5))


@given(GROUPS)
def test_rank_correlation_equals_that_of_scipy_with_ties(groups: np.ndarray) -> None:
    found = rank_correlation(*groups)
    if np.ptp(groups, axis=1).min() == 0:
        assert np.isnan(found)
    else:
        assert found == pytest.approx(spearmanr(*groups).statistic, abs=1e-12)


def test_rank_correlation_is_taken_group_by_group() -> None:
    first, second = np.random.default_rng(0).random((2, 3, 4, 9))
    found = rank_correlation(first, second)
    assert found.shape == (3, 4)
    assert found[1, 2] == pytest.approx(spearmanr(first[1, 2], second[1, 2]).statistic)


def test_rankings_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"of the same rollouts are compared, got shapes \[\(3,\), \(4,\)\]"):
        rank_correlation(np.zeros(3), np.zeros(4))


@given(st.permutations(range(6)))
def test_the_share_of_pairs_in_the_same_order_is_what_kendall_counts(order: list[int]) -> None:
    share = same_order(range(6), order).mean()
    assert 2 * share - 1 == pytest.approx(kendalltau(range(6), order).statistic)
