"""The realism metric against the official code, and what must not change it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpa.realism import (
    CLASS_RATES,
    RealismConfig,
    RealismResult,
    class_rates,
    mean_result,
    realism,
    realism_of,
    realism_of_groups,
)
from envs.scene import CURRENT_STEP, AgentKind, Agents, Scene, collate, select_agents
from envs.sources.synthetic import straight_road, two_cars_head_on
from tests.dpa.realism.golden import CODES, SHIPPED, Golden, golden_config

NAMES = {
    "metametric": "realism",
    "kinematic_metrics": "kinematic",
    "interactive_metrics": "interactive",
    "map_based_metrics": "map_based",
    "average_displacement_error": "ade",
    "min_average_displacement_error": "min_ade",
    "simulated_collision_rate": "collision_rate",
    "simulated_offroad_rate": "offroad_rate",
    "simulated_traffic_light_violation_rate": "traffic_light_violation_rate",
}
"""Names of the official outputs that are not ours."""

TIES = {
    ("synth_a", "log_noise_iid", "distance_to_road_edge"): 2e-6,
    ("synth_a", "log_noise_smooth", "distance_to_road_edge"): 1e-5,
    ("synth_a", "cv_noise", "distance_to_road_edge", "2023"): 1e-5,
    ("synth_a", "log_noise_smooth", "linear_acceleration", "2023"): 3e-5,
}
"""Tolerance of a likelihood where float32 rounding decides, by scene, kind of rollouts, feature and, if it is only one
year's, the year of the code.

Distance to the road edge: corners are as near to one polyline as to another but for the last bit of their coordinates;
cosines differ in that bit, so 1 in 1,000 simulated distances changes sign (and in 2023, 1 in 18,480 is 0 or not).
Linear acceleration of 2023: the ranges have a bin edge at 0, where constant speeds lie but for the last bit.
"""
BUCKET_OF = {"distance_to_road_edge": "map_based_metrics", "linear_acceleration": "kinematic_metrics"}

SYNTHETIC_KINDS = ("constvel", "cv_noise", "log_noise_iid", "log_noise_smooth", "logged")


def check_against_official(golden: Golden, code: str, year: str, *, moved: bool) -> None:
    scene = golden.load_scene(moved=moved)
    result = realism(scene, golden.load_rollouts(scene), golden_config(code, year)).as_dict()
    official = golden.load_output(code, year)
    for name, expected in official["metrics"].items() | official["buckets"].items():
        if name not in ("realism_meta_metric", "min_ade"):  # listed twice under two names
            tolerance = tolerances(golden, code).get(name, 1e-6)
            assert result[NAMES.get(name, name)] == pytest.approx(expected, rel=1e-6, abs=tolerance), name


def tolerances(golden: Golden, code: str) -> dict[str, float]:
    """Tolerance of each figure that a tie decides: a likelihood, its bucket and its part of the sum."""
    found = {}
    for (scene, kind, feature, *year), tolerance in TIES.items():
        if (scene, kind) == (golden.scene, golden.kind) and year in ([], [CODES[code]]):
            found |= {f"{feature}_likelihood": tolerance, BUCKET_OF[feature]: tolerance, "metametric": 0.1 * tolerance}
    return {name: max(1e-6, tolerance) for name, tolerance in found.items()}


def official_runs(*kinds: str) -> list[tuple[str, str, str]]:
    """Kind of rollouts, code and weights of what the official code was run on; older code on some kinds only."""
    runs = [(kind, "code2025", year) for kind in kinds for year in ("2023", "2024", "2025")]
    older = [("code2023", "2023"), ("code2023dec", "2023"), ("code2024", "2024")]
    return runs + [(kind, *each) for kind in kinds if kind in ("cv_noise", "log_noise_smooth") for each in older]


@pytest.mark.parametrize(("kind", "code", "year"), official_runs(*SYNTHETIC_KINDS))
@pytest.mark.parametrize("scene", ["synth_a", "synth_b"])
def test_figures_equal_the_official_ones(scene: str, kind: str, code: str, year: str) -> None:
    check_against_official(Golden(SHIPPED, scene, kind), code, year, moved=False)


@pytest.mark.parametrize(("kind", "code", "year"), official_runs("logged", "log_noise_smooth"))
def test_figures_equal_the_official_ones_on_a_real_scene(shared: Path, kind: str, code: str, year: str) -> None:
    golden = Golden(shared / "realism" / "golden", "637f20cafde22ff8", kind)
    check_against_official(golden, code, year, moved=True)


@pytest.fixture(scope="module")
def golden_scene() -> tuple[Scene, torch.Tensor]:
    golden = Golden(SHIPPED, "synth_a", "cv_noise")
    scene = golden.load_scene()
    return scene, golden.load_rollouts(scene)[:8]


def test_the_origin_of_a_scene_changes_nothing_but_rounding(golden_scene) -> None:
    scene, rollouts = golden_scene
    golden = Golden(SHIPPED, "synth_a", "cv_noise")
    moved = golden.load_scene(moved=True)
    assert moved.origin.abs().max() > 10
    got = realism(moved, golden.load_rollouts(moved)[:8], "2025").as_dict()
    # rounding breaks some of the ties between road edges otherwise, and a car stands on the very stop line
    assert got == pytest.approx(realism(scene, rollouts, "2025").as_dict(), abs=2e-3)


def test_the_order_of_agents_changes_nothing(golden_scene) -> None:
    scene, rollouts = golden_scene
    order = torch.randperm(len(scene.agents.valid), generator=torch.Generator().manual_seed(0))
    rank = scene.agents.present.cumsum(0) - 1
    simulated_order = rank[order[scene.agents.present[order]]]
    got = realism(select_agents(scene, order), rollouts[:, simulated_order], "2025")
    assert got == realism(scene, rollouts, "2025")


def test_padding_changes_nothing(golden_scene) -> None:
    scene, rollouts = golden_scene
    # a larger companion pads agents, polylines and lights
    larger = straight_road(num_vehicles=len(scene.agents.valid) + 3)
    padded = collate([scene, larger])
    alone = Scene(
        agents=padded.agents[0],
        road=padded.road[0],
        lights=padded.lights[0],
        origin=padded.origin[0],
        lacks=padded.lacks[0],
        scene_id=scene.scene_id,
        batch_size=[],
    )
    assert len(alone.agents.valid) == len(scene.agents.valid) + 3
    assert realism(alone, rollouts, "2025") == realism(scene, rollouts, "2025")


def test_an_agent_that_is_not_there_at_the_current_step_changes_nothing(golden_scene) -> None:
    scene, rollouts = golden_scene
    agents = scene.agents.clone()
    grown = {name: torch.cat((value, value[:1])) for name, value in agents.to_dict().items()}
    grown["valid"][-1, : CURRENT_STEP + 1] = False
    grown["position"][-1, : CURRENT_STEP + 1] = 0
    grown["track_id"][-1], grown["sdc"][-1], grown["predict"][-1] = 10_000, False, True
    larger = scene.clone()
    larger.agents = Agents(**grown, batch_size=[])
    assert realism(larger, rollouts, "2025") == realism(scene, rollouts, "2025")


@settings(max_examples=10, deadline=None)
@given(shift=st.tuples(*[st.integers(-20_000, 20_000)] * 2), year=st.sampled_from(["2024", "2025"]))
def test_moving_the_world_changes_nothing_but_rounding(shift: tuple[int, int], year: str) -> None:
    scene = straight_road(num_vehicles=3, seed=1)
    rollouts = log_as_rollout(scene) + torch.randn(8, 1, 1, 1, generator=torch.Generator().manual_seed(0))
    here = realism(scene, rollouts, year)
    scene.origin = torch.tensor([*map(float, shift), 0.0], dtype=torch.float64)
    # float32 at 20 km resolves 2 mm, which moves single speeds and accelerations to the next bin
    assert realism(scene, rollouts, year).realism == pytest.approx(here.realism, abs=2e-2)


def log_as_rollout(scene: Scene) -> torch.Tensor:
    agents = scene.agents
    return agents.trajectory[None, agents.present, 11:]


@pytest.mark.parametrize("memory", [1.0, 1e-6])
@pytest.mark.parametrize("year", ["2023", "2025"])
def test_scenes_of_any_size_score_together_as_they_do_alone(golden_scene, year: str, memory: float) -> None:
    scene, rollouts = golden_scene
    small = straight_road(num_vehicles=2, seed=3)
    log = log_as_rollout(small)
    scenes, simulated = [small, scene, small], [log, rollouts, log.expand(5, -1, -1, -1)]
    alone = [realism(one, poses, year) for one, poses in zip(scenes, simulated, strict=True)]
    assert realism_of(scenes, simulated, year, memory=memory) == alone


@pytest.mark.parametrize("year", ["2023", "2024", "2025"])
def test_groups_of_rollouts_score_as_they_do_alone(golden_scene, year: str) -> None:
    scene, rollouts = golden_scene
    groups = [torch.arange(len(rollouts)), torch.tensor([3]), torch.tensor([5, 0, 2])]
    alone = [realism(scene, rollouts[group], year) for group in groups]
    for found, wanted in zip(realism_of_groups(scene, rollouts, groups, year), alone, strict=True):
        assert found.as_dict() == pytest.approx(wanted.as_dict(), rel=1e-6, abs=1e-7)
    with pytest.raises(ValueError, match="a group without rollouts has no realism"):
        realism_of_groups(scene, rollouts, [torch.arange(0)])


def test_as_many_rollouts_as_scenes_are_needed(golden_scene) -> None:
    scene, rollouts = golden_scene
    with pytest.raises(ValueError, match="shorter"):
        realism_of([scene, scene], [rollouts])
    assert realism_of([], []) == []


def test_one_agent_and_one_rollout_are_enough() -> None:
    scene = straight_road(num_vehicles=1)
    result = realism(scene, log_as_rollout(scene))
    assert result.min_ade == 0
    assert 0 < result.realism <= 1


def test_cars_that_meet_head_on_collide_in_every_rollout() -> None:
    scene = two_cars_head_on()
    result = realism(scene, log_as_rollout(scene).expand(4, -1, -1, -1))
    assert result.collision_rate == 1
    assert result.likelihood["collision_indication"] > 0.99


def test_rates_of_classes_are_of_their_evaluated_agents_alone() -> None:
    """Five on a road in a row; rollouts hold them where they are, and put the third, a pedestrian, onto the fourth."""
    scene, config = straight_road(num_vehicles=5), RealismConfig.load("2024")
    scene.agents.kind[2] = AgentKind.PEDESTRIAN
    scene.agents.predict[:] = torch.tensor([True, True, True, True, False])
    agents = scene.agents
    held = agents.trajectory[:, CURRENT_STEP, None].expand(-1, 80, -1)
    rollouts = held.expand(4, -1, -1, -1).clone()
    rollouts[0, 2] = rollouts[0, 3]
    result = realism(scene, rollouts, config, features=True)
    found = class_rates(result.features, config)
    assert tuple(found) == CLASS_RATES
    assert found["pedestrian_collision"] == pytest.approx(1 / 4)
    assert found["vehicle_collision"] == pytest.approx(1 / 12), "the fifth vehicle is not evaluated"
    assert math.isnan(found["cyclist_collision"])
    assert result.collision_rate == pytest.approx((1 / 4 + 3 * 1 / 12) / 4)


def test_without_a_scored_vehicle_the_metric_is_not_a_number() -> None:
    scene = straight_road(num_vehicles=1)
    scene.agents.kind = torch.full_like(scene.agents.kind, int(AgentKind.PEDESTRIAN))
    rollout = log_as_rollout(scene)
    assert realism(scene, rollout, "2025").realism != realism(scene, rollout, "2025").realism
    assert realism(scene, rollout, "2024").realism > 0


def test_features_come_only_on_request() -> None:
    scene = straight_road(num_vehicles=2)
    assert realism(scene, log_as_rollout(scene)).features is None
    assert realism(scene, log_as_rollout(scene), features=True).features.displacement.shape == (1, 2)


@pytest.mark.parametrize("shape", [(4, 3, 80, 4), (4, 2, 79, 4), (0, 2, 80, 4), (2, 80, 4), (4, 2, 80, 3)])
def test_rollouts_of_the_wrong_shape_are_refused(shape: tuple[int, ...]) -> None:
    scene = straight_road(num_vehicles=2)
    with pytest.raises(ValueError, match=rf"straight_road_2_None.*\[R, 2, 80, 4\].*got \[{shape[0]}, "):
        realism(scene, torch.zeros(shape))


def test_a_rollout_that_is_not_finite_is_refused_with_its_place() -> None:
    scene = straight_road(num_vehicles=2)
    rollout = log_as_rollout(scene).repeat(3, 1, 1, 1)
    rollout[2, 1, 7, 3] = torch.nan
    with pytest.raises(ValueError, match=r"straight_road_2_None: rollout 2 has heading = nan for track 2 .* step 7"):
        realism(scene, rollout)


def test_mean_weighs_every_scene_the_same(golden_scene) -> None:
    scene, rollouts = golden_scene
    results = [realism(scene, rollouts[i : i + 2], "2025") for i in (0, 2, 4)]
    mean = mean_result([results[0], mean_result(results[1:])])
    assert mean.scenes == 3
    for name, value in mean.as_dict().items():
        assert value == pytest.approx(sum(result.as_dict()[name] for result in results) / 3), name


def test_mean_of_nothing_or_of_different_configurations_is_refused() -> None:
    scene = straight_road(num_vehicles=1)
    with pytest.raises(ValueError, match="at least one"):
        mean_result([])
    with pytest.raises(ValueError, match="different configurations"):
        mean_result([realism(scene, log_as_rollout(scene), year) for year in ("2024", "2025")])


def test_result_prints_without_its_features() -> None:
    scene = straight_road(num_vehicles=1)
    result = realism(scene, log_as_rollout(scene), features=True)
    assert isinstance(result, RealismResult)
    assert "tensor" not in repr(result)
