"""Advantages of a group, by hand."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dpa.rewards import advantages
from dpa.rewards.advantages import SMALLEST_SPREAD


def test_the_baseline_of_a_rollout_is_the_mean_of_the_others() -> None:
    reward = torch.tensor([[1.0, 4.0, 7.0, 0.0]])
    others = [(4 + 7 + 0) / 3, (1 + 7 + 0) / 3, (1 + 4 + 0) / 3, (1 + 4 + 7) / 3]
    expected = [value - other for value, other in zip(reward[0].tolist(), others, strict=True)]
    assert advantages(reward, scale="none")[0].tolist() == pytest.approx(expected)


GROUPS = arrays("float32", (2, 5, 3), elements=st.floats(-100, 100, width=32))


@given(GROUPS)
def test_the_advantages_of_a_group_sum_to_nothing_and_keep_its_order(values: object) -> None:
    reward = torch.from_numpy(values).double()
    for baseline in ("leave_one_out", "mean"):
        for scale in ("group", "none"):
            found = advantages(reward, baseline=baseline, scale=scale)
            assert torch.allclose(found.sum(1), torch.zeros(2, 3, dtype=torch.float64), atol=1e-9)
            differ = reward.std(1, keepdim=True) > SMALLEST_SPREAD * reward.abs().amax(1, keepdim=True)
            order = (reward[:, :, None] - reward[:, None]).sign()
            close = (reward[:, :, None] - reward[:, None]).abs() < 1e-9
            kept = (found[:, :, None] - found[:, None]).sign() == order
            assert (kept | ~differ[:, :, None] | close).all()


@given(GROUPS, st.floats(0.5, 20), st.floats(-50, 50))
def test_scaled_advantages_do_not_depend_on_the_unit_of_a_reward(values: object, unit: float, shift: float) -> None:
    reward = torch.from_numpy(values).double()
    both = (reward, unit * reward + shift)
    plain, other = (advantages(each, baseline="mean", scale="group") for each in both)
    # A group whose rewards are as good as equal teaches nothing; a shift changes what is as good as equal.
    cut = [each.std(1, keepdim=True) <= 2 * SMALLEST_SPREAD * each.abs().amax(1, keepdim=True) for each in both]
    alike = cut[0] | cut[1] | (reward.std(1, keepdim=True) <= 100 * SMALLEST_SPREAD)
    assert torch.allclose(plain.where(~alike, 0), other.where(~alike, 0), atol=1e-6)


def test_rollouts_that_are_as_good_as_equal_teach_nothing() -> None:
    assert not advantages(torch.tensor([[2.0, 2.0 + 1e-5, 2.0]]), scale="group").any()


def test_decisions_after_which_little_differs_weigh_little() -> None:
    reward = torch.tensor([[4.0, 1e-5], [2.0, 0.0], [0.0, 2e-5]])[None, :, None]  # [1, K, A, T]
    found = advantages(reward, baseline="mean", scale="group")[0, :, 0]
    assert found[:, 0].tolist() == pytest.approx([1, 0, -1])
    assert found[:, 1].abs().max() < 1e-5


@pytest.mark.parametrize(
    ("reward", "options", "told"),
    [
        (torch.zeros(1, 1), {}, "roll out 2 or more"),
        (torch.zeros(1, 2), {"baseline": "none"}, "baseline must be leave_one_out or mean, got 'none'"),
        (torch.zeros(1, 2), {"scale": "scene"}, "scale must be group or none, got 'scene'"),
    ],
)
def test_what_has_no_advantage_is_refused(reward: torch.Tensor, options: dict, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        advantages(reward, **options)


if __name__ == "__main__":
    pytest.main([__file__])
