"""The metric of the Scenario Generation challenge: whole scenes, sizes of their own, one distribution for all."""

from __future__ import annotations

import pytest
import torch

from dpa.realism import Generated, RealismConfig, realism
from envs.scene import AgentKind, Scene
from envs.sources.synthetic import straight_road

YEAR = "2025_scenario_generation"


@pytest.fixture
def scene() -> Scene:
    return straight_road(num_vehicles=3, seed=0)


def whole_log(scene: Scene, rollouts: int = 4) -> torch.Tensor:
    agents = scene.agents
    poses = agents.trajectory[agents.present]
    return poses.expand(rollouts, -1, -1, -1)


def generated(scene: Scene, scale: float = 1.0, kind: AgentKind = AgentKind.VEHICLE) -> Generated:
    agents = int(scene.agents.present.sum())
    extent = scene.agents.extent[scene.agents.present].expand(4, -1, -1) * scale
    return Generated(extent, torch.full((4, agents), int(kind)))


def test_everything_but_red_lights_is_pooled_and_weighs_as_in_2025() -> None:
    config, year = RealismConfig.load(YEAR), RealismConfig.load("2025")
    assert config.weights == year.weights
    pooled = {name for name, part in {**config.continuous, **config.indicators}.items() if part.pooled}
    assert pooled == year.weights.keys() - {"traffic_light_violation"}


def test_all_agents_are_scored_at_all_steps_and_nothing_is_displaced(scene: Scene) -> None:
    scene.agents.predict[:] = False
    result = realism(scene, whole_log(scene), YEAR, features=True)
    assert result.features.values["linear_speed"].shape == (5, 3, 91)
    assert result.features.valid.all()
    assert result.min_ade == result.ade == 0.0
    assert 0 < result.realism <= 1


def test_agents_share_one_distribution(scene: Scene) -> None:
    log = whole_log(scene)
    exchanged = log.clone()
    exchanged[:, [0, 1]] = log[:, [1, 0]]  # who drives where makes no difference, as sizes are equal
    for name in ("linear_speed", "distance_to_road_edge", "collision_indication"):
        one, other = (realism(scene, rollouts, YEAR).likelihood[name] for rollouts in (log, exchanged))
        assert one == pytest.approx(other), name


def test_sizes_and_classes_are_those_of_the_generated_scene(scene: Scene) -> None:
    log = whole_log(scene)
    assert realism(scene, log, YEAR, generated=generated(scene)) == realism(scene, log, YEAR)
    assert realism(scene, log, YEAR).collision_rate == 0
    assert realism(scene, log, YEAR, generated=generated(scene, scale=20.0)).collision_rate == 1


def test_rollouts_without_history_and_sizes_in_the_wrong_place_are_refused(scene: Scene) -> None:
    log = whole_log(scene)
    with pytest.raises(ValueError, match=r"shape \[R, 3, 91, 4\].*got \[4, 3, 80, 4\]"):
        realism(scene, log[:, :, 11:], YEAR)
    with pytest.raises(ValueError, match=r"\[4, 3, 3\], \[4, 3\].*got \[\[4, 2, 3\], \[4, 3\]\]"):
        realism(scene, log, YEAR, generated=Generated(torch.ones(4, 2, 3), torch.ones(4, 3)))
    with pytest.raises(ValueError, match="only configurations of the Scenario Generation challenge.*not '2025'"):
        realism(scene, log[:, :, 11:], "2025", generated=generated(scene))
