"""Features of the occupancy measure, on scenes whose values follow by hand."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dpa.ranking.features import (
    FEATURES,
    feature_clips,
    feature_names,
    feature_weights,
    log_trajectory,
    occupancy_features,
    register,
)
from envs.geometry.boxes import signed_box_distance
from envs.scene import CURRENT_STEP, LightState, MapKind, Scene
from envs.sources.synthetic import CAR, build_scene, red_light, straight_road, two_cars_head_on

TIME = (torch.arange(91) - CURRENT_STEP) * 0.1


def of_log(scene: Scene, *names: str, **options) -> tuple[dict[str, Tensor], Tensor]:
    """Features of the log by name ``[A, T]``, and valid ``[A, T]``."""
    names = names or feature_names("full")
    phi, valid = occupancy_features(scene, log_trajectory(scene, 80)[None], names, **options)
    return dict(zip(names, phi[0].unbind(-1), strict=True)), valid


def circling(speed: float = 8.0, radius: float = 20.0) -> Scene:
    """One car on a circle: speed and effort v^2 / r are constant."""
    angle = speed / radius * TIME
    poses = torch.stack((radius * angle.sin(), radius * (1 - angle.cos()), angle), -1)[None]
    edge = torch.tensor([[-100.0, -50.0], [100.0, -50.0]])
    return build_scene(poses, [(MapKind.EDGE_BOUNDARY, edge)])


def test_speed_and_effort_of_a_circle_follow_from_its_radius() -> None:
    phi, valid = of_log(circling())
    assert valid.all()
    torch.testing.assert_close(phi["speed"], torch.full((1, 80), 8.0), atol=0.02, rtol=0)
    torch.testing.assert_close(phi["effort"], torch.full((1, 80), 8.0**2 / 20), atol=0.02, rtol=0)


def test_clearance_and_collision_are_those_of_the_rounded_boxes() -> None:
    scene = two_cars_head_on()
    phi, _ = of_log(scene)
    extent = torch.tensor(CAR[:2])
    boxes = [torch.cat((pose[:, [0, 1, 3]], extent.expand(80, 2)), -1) for pose in log_trajectory(scene, 80)]
    want = signed_box_distance(*boxes).clamp(-5, 40)
    torch.testing.assert_close(phi["clearance"], want.expand(2, 80))
    assert torch.equal(phi["collision"], (want < 0).float().expand(2, 80))
    assert 0 < phi["collision"].sum() < 160


def test_road_edge_is_that_of_the_corner_farthest_out() -> None:
    scene = straight_road(2)
    assert of_log(scene)[0]["road_edge"][0, 0] == pytest.approx(-(2.5 - CAR[1] / 2))
    scene.agents.position[..., 1] = -7.0
    assert of_log(scene)[0]["road_edge"][0, 0] == pytest.approx(2.0 + CAR[1] / 2)


def test_an_agent_alone_has_the_largest_clearance() -> None:
    phi, _ = of_log(straight_road(1))
    assert phi["clearance"].unique().tolist() == [FEATURES["clearance"].clip[1]]
    assert not phi["collision"].any()


def test_a_hole_in_the_log_costs_the_steps_that_need_it_and_effort_does_not_explode() -> None:
    scene = circling()
    hole = slice(CURRENT_STEP + 31, CURRENT_STEP + 34)
    scene.agents.valid[0, hole] = False
    scene.agents.position[0, hole] = 0
    phi, valid = of_log(scene)
    assert (~valid[0]).nonzero()[:, 0].tolist() == [30, 31, 32, 33, 34]
    torch.testing.assert_close(phi["effort"][0, valid[0]], torch.full((75,), 3.2), atol=0.02, rtol=0)
    assert all(not value[0, ~valid[0]].any() for value in phi.values())


@pytest.mark.parametrize(("name", "lost"), [("clearance", 0), ("speed", 1), ("effort", 2)])
def test_missing_history_costs_the_first_steps_of_features_that_look_back(name: str, lost: int) -> None:
    scene = straight_road(1)
    scene.agents.valid[0, CURRENT_STEP - 1] = False
    _, valid = of_log(scene, name)
    assert (~valid).sum() == max(lost - 1, 0)
    scene.agents.valid[0, CURRENT_STEP + 1] = False
    assert (~of_log(scene, name)[1]).sum() == 1 + lost


def test_a_neighbour_missing_in_the_log_is_missing_for_rollouts_too() -> None:
    scene = two_cars_head_on()
    scene.agents.valid[1, CURRENT_STEP + 1 :] = False
    log = log_trajectory(scene, 80)
    rollout = two_cars_head_on().agents
    rollout = rollout.trajectory[:, CURRENT_STEP + 1 :]
    phi, valid = occupancy_features(scene, torch.stack((rollout, log)), ["collision", "clearance"])
    assert torch.equal(phi[0], phi[1])
    assert valid.tolist() == [[True] * 80, [False] * 80]


def test_agents_absent_at_the_current_step_are_no_obstacles() -> None:
    scene = two_cars_head_on()
    scene.agents.valid[1, CURRENT_STEP] = False
    phi, valid = of_log(scene)
    assert valid.shape == (1, 80)
    assert not phi["collision"].any()


def test_ego_and_stride_select_from_the_full_features() -> None:
    scene = straight_road(4, seed=0)
    full, full_valid = occupancy_features(scene, log_trajectory(scene, 80)[None])
    ego = torch.tensor([3, 1])
    some, valid = occupancy_features(scene, log_trajectory(scene, 80)[None], ego=ego, stride=5)
    assert torch.equal(some, full[:, ego][:, :, 4::5])
    assert torch.equal(valid, full_valid[ego][:, 4::5])


def test_values_are_clipped_to_the_range_in_force() -> None:
    scene = straight_road(2, speed=30.0)
    assert of_log(scene)[0]["speed"].unique().tolist() == [25.0]
    assert of_log(scene, clips={"speed": (0.0, 10.0)})[0]["speed"].unique().tolist() == [10.0]


def test_a_registered_feature_joins_the_measure() -> None:
    @register("lane_offset", unit="m", clip=(0.0, 5.0), weight=2.0, spread=0.5)
    def lane_offset(motion):
        return motion.ego_poses()[..., 1].abs()

    try:
        phi, _ = of_log(straight_road(1), "speed", "lane_offset")
        assert phi["lane_offset"].unique().tolist() == [2.5]
        assert feature_weights(["speed", "lane_offset"]).tolist() == [1, 2]
        with pytest.raises(ValueError, match="registered already"):
            register("lane_offset", unit="m", clip=(0.0, 5.0), weight=2.0, spread=0.5)
    finally:
        del FEATURES["lane_offset"]


def test_each_feature_of_the_paper_can_be_left_out_by_name() -> None:
    for name in feature_names("full"):
        assert feature_names(f"without_{name}") == tuple(other for other in feature_names("full") if other != name)


def test_normalised_weights_divide_by_the_squared_spread_and_others_are_the_papers() -> None:
    names = feature_names("full")
    assert feature_weights(names).tolist() == feature_weights(names, "paper").tolist() == [10, 5, 2, 1, 1]
    want = torch.tensor([FEATURES[name].weight / FEATURES[name].spread ** 2 for name in names])
    torch.testing.assert_close(feature_weights(names, "normalised"), want)
    assert feature_weights(names, {"effort": 7.0}).tolist() == [10, 5, 2, 7, 1]


def test_a_red_light_is_violated_at_the_step_that_passes_its_stop_point() -> None:
    scene = red_light(speed=7.7)
    phi, valid = of_log(scene, "red_light")
    stop = scene.lights.stop_point[0, 0, 0]
    x = scene.agents.position[0, CURRENT_STEP:, 0]
    passes = (x[:-1] < stop) & (x[1:] > stop)
    assert valid.all() and passes.sum() == 1
    assert torch.equal(phi["red_light"][0], passes.float())
    within = phi["red_light"].unflatten(1, (-1, 5)).amax(-1)
    assert within.sum() == 1 and not phi["red_light"][:, 4::5].any(), "between two measured steps"
    assert torch.equal(of_log(scene, "red_light", stride=5)[0]["red_light"], within)
    scene.lights.state[:] = LightState.GO
    assert not of_log(scene, "red_light")[0]["red_light"].any()


def test_without_lights_nobody_violates_one() -> None:
    scene = straight_road(2)
    assert len(scene.lights.lane_id) == 0
    assert not of_log(scene, "red_light")[0]["red_light"].any()


def along_a_lane(heading: float = 0.3, offset: float = 1.5) -> Scene:
    """One car that slides along a lane, beside its centre line."""
    poses = torch.stack((8.0 * TIME, torch.full_like(TIME, offset), torch.full_like(TIME, heading)), -1)[None]
    edge, lane = torch.tensor([[-100.0, -50], [100, -50]]), torch.tensor([[-100.0, 0], [0, 0], [100, 0]])
    return build_scene(poses, [(MapKind.EDGE_BOUNDARY, edge), (MapKind.LANE_SURFACE_STREET, lane)])


def test_lane_features_are_those_of_the_nearest_centre_line() -> None:
    phi, _ = of_log(along_a_lane(), "lane_deviation", "heading_error")
    torch.testing.assert_close(phi["lane_deviation"], torch.full((1, 80), 1.5))
    torch.testing.assert_close(phi["heading_error"], torch.full((1, 80), 0.3))
    phi, _ = of_log(along_a_lane(heading=6.0), "heading_error")
    torch.testing.assert_close(phi["heading_error"], torch.full((1, 80), 2 * torch.pi - 6.0))


def test_a_map_without_lanes_is_refused_by_the_features_that_need_one() -> None:
    with pytest.raises(ValueError, match="no lane, which the feature 'lane_deviation' needs"):
        of_log(circling(), "lane_deviation")


def test_time_to_collision_is_the_gap_over_the_closing_speed() -> None:
    x = torch.stack((10.0 * TIME, 30.0 + 5.0 * TIME))
    poses = torch.stack((x, torch.zeros_like(x), torch.zeros_like(x)), -1)
    scene = build_scene(poses, [(MapKind.EDGE_BOUNDARY, torch.tensor([[-100.0, -50], [100, -50]]))])
    phi, _ = of_log(scene, "time_to_collision")
    gap = (x[1] - x[0] - CAR[0])[CURRENT_STEP + 1 :]
    want = torch.where(gap > 0, (gap / 5).clamp(max=5), 5.0)
    torch.testing.assert_close(phi["time_to_collision"][0], want, atol=1e-3, rtol=0)
    assert phi["time_to_collision"][1].unique().tolist() == [5.0]


def test_a_leader_whose_log_lacks_the_step_before_leads_nobody() -> None:
    x = torch.stack((10.0 * TIME, 30.0 + 5.0 * TIME))
    poses = torch.stack((x, torch.zeros_like(x), torch.zeros_like(x)), -1)
    scene = build_scene(poses, [(MapKind.EDGE_BOUNDARY, torch.tensor([[-100.0, -50], [100, -50]]))])
    whole, _ = of_log(scene, "time_to_collision")
    hole = 40
    scene.agents.valid[1, CURRENT_STEP + 1 + hole] = False
    phi, _ = of_log(scene, "time_to_collision")
    changed = (phi["time_to_collision"] != whole["time_to_collision"])[0].nonzero()[:, 0].tolist()
    assert set(changed) <= {hole, hole + 1}
    assert phi["time_to_collision"][0, hole : hole + 2].tolist() == [5.0, 5.0]


@given(
    name=st.sampled_from(sorted(FEATURES)),
    holes=st.lists(st.tuples(st.integers(0, 2), st.integers(CURRENT_STEP - 1, 90)), min_size=1, max_size=6),
    seed=st.integers(0, 100),
)
@settings(max_examples=40, deadline=None)
def test_a_hole_in_the_log_changes_nothing_but_the_steps_that_read_it(
    name: str, holes: list[tuple[int, int]], seed: int
) -> None:
    scene = straight_road(3, seed=seed)
    rollouts = log_trajectory(scene, 80)[None].repeat(2, 1, 1, 1)
    rollouts[..., :2] += torch.randn(2, 3, 80, 2, generator=torch.Generator().manual_seed(seed)).cumsum(2) * 0.1
    whole, _ = occupancy_features(scene, rollouts, [name])
    holes = [(agent, step) for agent, step in holes if step != CURRENT_STEP]
    for agent, step in holes:
        scene.agents.valid[agent, step] = False
        scene.agents.position[agent, step] = 0  # what lies in a hole is no place
        scene.agents.heading[agent, step] = 0
    phi, valid = occupancy_features(scene, rollouts, [name])
    past = FEATURES[name].past
    reading = torch.zeros(3, 80, dtype=torch.bool)
    for agent, step in holes:
        first = step - CURRENT_STEP - 1
        reading[agent, max(first, 0) : max(first + past + 1, 0)] = True
    assert torch.equal(valid, ~reading)
    # Neighbours read the step too, but only where the hole is within their own past.
    untouched = ~reading.any(0)
    assert torch.equal(phi[:, :, untouched], whole[:, :, untouched])
    assert not phi[:, reading].any()
    if name not in ("collision", "clearance", "time_to_collision"):
        assert torch.equal(phi[:, ~reading], whole[:, ~reading])


def test_bad_options_are_refused_with_the_value() -> None:
    scene = straight_road(2)
    log = log_trajectory(scene, 80)[None]
    with pytest.raises(ValueError, match="'safety'.*'full'"):
        occupancy_features(scene, log, "safety")
    with pytest.raises(ValueError, match="'jerk'"):
        occupancy_features(scene, log, ["speed", "jerk"])
    with pytest.raises(ValueError, match="clips are given for"):
        occupancy_features(scene, log, ["speed"], clips={"effort": (0, 1)})
    with pytest.raises(ValueError, match="got 0"):
        occupancy_features(scene, log, stride=0)
    with pytest.raises(ValueError, match=r"\[R, 2, T, 4\]"):
        occupancy_features(scene, log[:, :1])
    with pytest.raises(ValueError, match="past steps, got 3"):
        register("jerk", unit="m/s^3", clip=(0, 1), weight=1.0, spread=1.0, past=3)
    with pytest.raises(ValueError, match="above 0, got 0"):
        register("jerk", unit="m/s^3", clip=(0, 1), weight=1.0, spread=0.0)
    with pytest.raises(ValueError, match="'equal'.*'normalised'"):
        feature_weights(["speed"], "equal")
    with pytest.raises(ValueError, match="comes twice in .*'speed', 'speed'"):
        feature_names(["speed", "speed"])
    for weight in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match=f"'speed' must be a number of 0 or more, got {weight}"):
            feature_weights(["speed"], {"speed": weight})
    with pytest.raises(ValueError, match=r"'speed' must be \(low, high\) with low < high, got \(25, 0\)"):
        feature_clips(["speed"], {"speed": (25, 0)})
