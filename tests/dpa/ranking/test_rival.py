"""Ranking by displacement, by hand and beside the preference distance."""

from __future__ import annotations

import pytest
import torch

from dpa.ranking import DisplacementDistance, PreferenceDistance, log_trajectory
from envs.scene import Scene
from envs.sources.synthetic import straight_road


@pytest.fixture
def scene() -> Scene:
    scene = straight_road(3)
    scene.agents.valid[1, 51:] = False  # logged for the first four seconds only
    scene.agents.valid[2, 11:] = False
    return scene


@pytest.fixture
def drifting(scene: Scene) -> torch.Tensor:
    """Two rollouts: one drifts aside by up to 8 m, the other is the log."""
    log = log_trajectory(scene, 80)
    aside = torch.zeros_like(log)
    aside[..., 1] = torch.arange(1, 81) / 10
    return torch.stack((log + aside, log))


def test_the_average_and_the_last_logged_displacement_are_those_of_each_agents_logged_steps(
    scene: Scene, drifting: torch.Tensor
) -> None:
    average, final = (DisplacementDistance(measure)(scene, drifting) for measure in ("average", "final"))
    torch.testing.assert_close(average.agent_distance[0], torch.tensor([4.05, 2.05, 0.0]))
    torch.testing.assert_close(final.agent_distance[0], torch.tensor([8.0, 4.0, 0.0]))
    assert average.agent_ranked.tolist() == [True, True, False]
    assert average.distance.tolist() == pytest.approx([3.05, 0]) and final.distance.tolist() == pytest.approx([6.0, 0])


def test_the_mean_over_agents_is_the_ade_of_the_preference_distance(scene: Scene, drifting: torch.Tensor) -> None:
    for agents in ("controlled", "evaluated"):
        found = DisplacementDistance(agents=agents)(scene, drifting)
        torch.testing.assert_close(found.distance, PreferenceDistance(agents=agents)(scene, drifting).ade)
        assert torch.equal(found.distance, found.ade)


def test_only_controlled_agents_are_ranked(scene: Scene, drifting: torch.Tensor) -> None:
    found = DisplacementDistance()(scene, drifting, torch.tensor([False, True, False]))
    assert found.agent_ranked.tolist() == [False, True, False]
    assert found.distance.tolist() == pytest.approx([2.05, 0])


def test_without_a_ranked_agent_every_rollout_is_at_distance_0(scene: Scene, drifting: torch.Tensor) -> None:
    found = DisplacementDistance(aggregate="max")(scene, drifting, torch.zeros(3, dtype=torch.bool))
    assert found.distance.tolist() == [0, 0] and not found.agent_ranked.any()


@pytest.mark.parametrize("option", [{"measure": "minimal"}, {"aggregate": "product"}, {"agents": "all"}])
def test_an_unknown_option_is_refused_with_those_that_there_are(option: dict[str, str]) -> None:
    ((name, value),) = option.items()
    with pytest.raises(ValueError, match=f"unknown {name} '{value}'; choose one of"):
        DisplacementDistance(**option)
