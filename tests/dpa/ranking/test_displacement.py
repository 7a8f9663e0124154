"""Displacement from the log on cases computed by hand."""

from __future__ import annotations

import pytest
import torch

from dpa.ranking.displacement import average_displacement, final_displacement


def test_only_valid_logged_steps_and_agents_that_have_one_count() -> None:
    log = torch.zeros(3, 2, 3)
    valid = torch.tensor([[True, True], [True, False], [False, False]])
    rollout = torch.zeros(1, 3, 2, 4)
    rollout[0, 0, :, 0] = torch.tensor([1.0, 3.0])
    rollout[0, 1, :, 1] = torch.tensor([4.0, 100.0])
    rollout[0, 2] = torch.nan
    got = average_displacement(rollout, log, valid)
    assert got.agent.tolist() == [[2.0, 4.0, 0.0]]
    assert got.scene.tolist() == [3.0]
    assert got.ranked.tolist() == [True, True, False]


def test_the_final_displacement_is_that_of_the_last_valid_step_of_each_agent() -> None:
    log = torch.zeros(4, 3, 2)
    valid = torch.tensor([[True, True, True], [True, False, False], [False, True, False], [False, False, False]])
    rollouts = torch.zeros(2, 4, 3, 4)
    rollouts[0, ..., 0] = torch.tensor([1.0, 2.0, 3.0])
    rollouts[1, ..., 1] = torch.tensor([4.0, 5.0, 6.0])
    rollouts[:, 3] = torch.nan
    got = final_displacement(rollouts, log, valid)
    assert got.agent.tolist() == [[3.0, 1.0, 2.0, 0.0], [6.0, 4.0, 5.0, 0.0]]
    assert got.scene.tolist() == [2.0, 5.0]
    assert got.ranked.tolist() == [True, True, True, False]


def test_height_and_heading_do_not_count() -> None:
    log, valid = torch.zeros(1, 2, 4), torch.ones(1, 2, dtype=torch.bool)
    rollout = torch.zeros(1, 1, 2, 4)
    rollout[..., 2:] = 7.0
    assert average_displacement(rollout, log, valid).scene.tolist() == [0.0]


@pytest.mark.parametrize("measure", [average_displacement, final_displacement])
def test_shapes_that_do_not_fit_are_refused(measure) -> None:
    with pytest.raises(ValueError, match="same agents and steps"):
        measure(torch.zeros(1, 2, 3, 2), torch.zeros(2, 4, 2), torch.ones(2, 4, dtype=torch.bool))
