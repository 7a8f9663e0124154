"""Safety measures, on scenes where each is known by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dpa.safety import MEASURES, Motion, safety
from dpa.safety.__main__ import main
from dpa.safety.close_pass import close_pass
from dpa.safety.wrong_way import drives_against
from envs.geometry.frames import rotate
from envs.scene import CURRENT_STEP, AgentKind, LightState, MapKind, Scene, select_agents
from envs.sources.synthetic import CAR, build_scene, no_lights, red_light, straight_road

TIME = (torch.arange(91) - CURRENT_STEP) * 0.1
AHEAD = TIME[CURRENT_STEP + 1 :]
LENGTH, WIDTH = CAR[:2]
EDGE = [(MapKind.EDGE_BOUNDARY, torch.tensor([[500.0, 50.0], [-500.0, 50.0]]))]


def log_of(scene: Scene) -> Tensor:
    """The log as the one rollout: ``[1, A, 80, 4]``."""
    agents, present = scene.agents, scene.agents.present
    return agents.trajectory[present][None, :, CURRENT_STEP + 1 :]


def measured(scene: Scene, trajectories: Tensor | None = None, controlled: Tensor | None = None) -> dict:
    """Safety of trajectories, or of the log, with everybody controlled by default."""
    trajectories = log_of(scene) if trajectories is None else trajectories
    everybody = torch.ones(trajectories.shape[1], dtype=torch.bool)
    return safety(scene, trajectories, everybody if controlled is None else controlled)


def driving(x: Tensor, y: Tensor | float, heading: float = 0.0) -> Tensor:
    """One rollout of one agent: ``[1, 1, 80, 4]``."""
    rows = (x, torch.as_tensor(y).expand(80), torch.zeros(80), torch.full((80,), heading))
    return torch.stack(rows, -1)[None, None]


# --- wrong way: lanes go east at y = -2.5 and west at y = 2.5 --------------------------------------------------------


@pytest.mark.parametrize(
    ("speed", "y", "share"),
    [(10.0, -2.5, 0.0), (10.0, 2.5, 1.0), (-10.0, -2.5, 1.0), (-10.0, 2.5, 0.0), (0.8, 2.5, 0.0), (10.0, 6.5, 0.0)],
    ids=["with its lane", "against the other lane", "in reverse", "turned round", "creeping", "beside the road"],
)
def test_a_vehicle_that_drives_against_the_nearest_lane_is_on_the_wrong_way(
    speed: float, y: float, share: float
) -> None:
    assert measured(straight_road(1), driving(speed * AHEAD, y))["wrong_way"] == share


@pytest.mark.parametrize(("seconds", "share"), [(0.4, 0.0), (1.6, 1.0)])
def test_less_than_a_second_on_the_wrong_side_does_not_count(seconds: float, share: float) -> None:
    part = (AHEAD - 2) / seconds
    y = torch.where((part > 0.01) & (part < 1.01), 2.5, -2.5)
    assert measured(straight_road(1), driving(10 * AHEAD, y))["wrong_way"] == share


def test_an_agent_whose_log_is_on_the_wrong_way_too_is_not_blamed() -> None:
    scene = straight_road(1)
    scene.agents.position[..., 1] = 2.5
    assert drives_against(Motion.of(scene, log_of(scene), torch.tensor([True]))).all()
    assert measured(scene)["wrong_way"] == 0


def test_shares_are_over_rollouts_and_agents() -> None:
    scene = straight_road(2)
    rollouts = log_of(scene).repeat(4, 1, 1, 1)
    rollouts[0, 1, :, 1] = 2.5
    assert measured(scene, rollouts)["wrong_way"] == 1 / 8
    assert measured(scene, rollouts, torch.tensor([False, True]))["wrong_way"] == 1 / 4
    assert measured(scene, rollouts, torch.tensor([True, False]))["wrong_way"] == 0


# --- red light: a stop point at x = 20 on the lane that goes east ----------------------------------------------------


def lit(*states: LightState, lanes: tuple[int, ...] = (1, 1)) -> Scene:
    """The road of :func:`red_light`, driven at 8 m/s, with lights of the given states at one stop point."""
    scene = red_light(speed=8.0)
    lights = scene.lights
    lights.lane_id = torch.tensor(lanes[: len(states)])
    lights.state = torch.tensor(states)[:, None].expand(-1, 91).clone()
    lights.stop_point = lights.stop_point.expand(len(states), -1, -1).clone()
    return scene


@pytest.mark.parametrize("state", list(LightState))
def test_crossing_the_stop_line_counts_at_red_only(state: LightState) -> None:
    assert measured(lit(state))["red_light"] == (state in (LightState.STOP, LightState.ARROW_STOP))


@pytest.mark.parametrize(("red", "share"), [(slice(0, 34), 1.0), (slice(34, 91), 0.0)])
def test_it_is_the_front_that_crosses(red: slice, share: float) -> None:
    scene = lit(LightState.GO)
    scene.lights.state[:, red] = int(LightState.STOP)  # the front is there after 2.21 s, the centre after 2.5 s
    assert measured(scene)["red_light"] == share


@pytest.mark.parametrize(
    "rollout",
    [
        driving(8 * AHEAD.clamp(max=2.0), -2.5),
        driving(8 * AHEAD, -4.5),
        driving(40 - 8 * AHEAD, -2.5),
        driving(8 + 4 * AHEAD, -22.5 + 4 * math.sqrt(3) * AHEAD, math.pi / 3),
    ],
    ids=["stops before it", "passes beside it", "comes from beyond", "comes from the side"],
)
def test_what_does_not_run_the_light(rollout: Tensor) -> None:
    scene = lit(LightState.STOP)
    scene.agents.position[0, CURRENT_STEP] = rollout[0, 0, 0, :3]
    assert measured(scene, rollout)["red_light"] == 0


def test_who_may_have_taken_a_lane_with_a_free_light_is_not_blamed() -> None:
    assert measured(lit(LightState.STOP, LightState.GO))["red_light"] == 0
    assert measured(lit(LightState.STOP, LightState.STOP))["red_light"] == 1
    assert measured(lit(LightState.STOP, LightState.GO, lanes=(1, 99)))["red_light"] == 1, "lane 99 is not on the map"


# --- close pass: two cars that cross at a right angle ----------------------------------------------------------------


def crossing(delay: float, speeds: tuple[float, float] = (10.0, 10.0), angle: float = math.pi / 2) -> Scene:
    """The first car is at the origin after 3 s, the second one comes at an angle and is there later by a delay."""
    first, second = (TIME - 3) * speeds[0], (TIME - 3 - delay) * speeds[1]
    zero = torch.zeros(91)
    turned = (second * math.cos(angle), second * math.sin(angle), zero + angle)
    return build_scene(torch.stack((torch.stack((first, zero, zero), -1), torch.stack(turned, -1))), EDGE)


@pytest.mark.parametrize(("encroachment", "share"), [(-0.3, 0.0), (0.1, 1.0), (0.5, 1.0), (0.8, 1.0), (1.1, 0.0)])
def test_two_cars_pass_closely_if_less_than_a_second_lies_between_them(encroachment: float, share: float) -> None:
    # At 10 m/s each of them needs (LENGTH + WIDTH) / 10 s to clear the place that both need.
    scene = crossing((LENGTH + WIDTH) / 10 + encroachment)
    assert measured(scene)["close_pass"] == share, "a collision (negative time) is not a close pass"


@settings(max_examples=60, deadline=None)
@given(
    encroachment=st.floats(0.05, 2.5),
    speeds=st.tuples(st.floats(4, 20), st.floats(4, 20)),
)
def test_the_time_found_is_that_of_the_rectangles(encroachment: float, speeds: tuple[float, float]) -> None:
    delay = encroachment + (LENGTH + WIDTH) / 2 * (1 / speeds[0] + 1 / speeds[1])
    found = measured(crossing(delay, speeds))["close_pass"]
    if encroachment < 0.8:
        assert found == 1
    elif encroachment > 1.0:
        assert found == 0


def test_one_who_follows_does_not_pass_closely() -> None:
    assert measured(straight_road(2, speed=20.0, gap=10.0))["close_pass"] == 0
    assert measured(crossing(0.9, angle=math.radians(20)))["close_pass"] == 0
    assert measured(crossing(1.2, angle=math.radians(60)))["close_pass"] == 1


def test_both_of_a_pair_are_involved_but_only_the_controlled_are_counted() -> None:
    scene = crossing(1.1)
    rollouts = log_of(scene)
    assert measured(scene, rollouts, torch.tensor([True, False]))["close_pass"] == 1
    scene.agents.kind[:] = AgentKind.PEDESTRIAN
    assert measured(scene, rollouts)["close_pass"] == 0, "two pedestrians walk as close as they like"
    scene.agents.kind[0] = AgentKind.VEHICLE
    assert measured(scene, rollouts)["close_pass"] == 1


def test_nobody_is_passed_where_the_log_does_not_see_them() -> None:
    scene = crossing(1.1)
    scene.agents.valid[1, CURRENT_STEP + 25 :] = False
    assert not close_pass(Motion.of(scene, log_of(scene), torch.ones(2, dtype=torch.bool))).any()


# --- harsh jerk ------------------------------------------------------------------------------------------------------


def braking(deceleration: float) -> Tensor:
    """From 10 m/s, after 2 s, in one rollout."""
    since = (AHEAD - 2).clamp(0, 10 / deceleration)
    return driving(10 * AHEAD.clamp(max=2.0) + 10 * since - deceleration * since**2 / 2, -2.5)


@pytest.mark.parametrize(("deceleration", "share"), [(2.0, 0.0), (3.0, 0.0), (5.0, 1.0), (8.0, 1.0)])
def test_a_hard_stop_jerks_and_a_soft_one_does_not(deceleration: float, share: float) -> None:
    # An instant change a of the acceleration, seen in differences over h = 0.5 s, peaks at 0.75 a / h.
    assert measured(straight_road(1), braking(deceleration))["harsh_jerk"] == share


def test_a_jerk_between_the_log_and_the_first_decision_counts() -> None:
    assert measured(straight_road(1), driving(torch.zeros(80), -2.5))["harsh_jerk"] == 1


def test_a_steady_turn_does_not_jerk_and_a_swerve_does() -> None:
    angle = 0.4 * TIME
    circle = torch.stack((20 * angle.sin(), 20 * (1 - angle.cos()), angle), -1)[None]
    assert measured(build_scene(circle, EDGE))["harsh_jerk"] == 0
    swerve = driving(10 * AHEAD, -2.5 + torch.sin(3 * (AHEAD - 3).clamp(0, 2 * math.pi / 3)))
    assert measured(straight_road(1), swerve)["harsh_jerk"] == 1


def test_a_stop_in_a_hole_of_the_log_is_not_seen() -> None:
    scene = straight_road(1)
    scene.agents.valid[0, CURRENT_STEP + 21 :] = False
    assert measured(scene, braking(8.0))["harsh_jerk"] == 0


# --- all of them -----------------------------------------------------------------------------------------------------


def test_a_scene_without_the_thing_has_no_value() -> None:
    scene = straight_road(2)
    assert measured(scene) == {"wrong_way": 0.0, "red_light": None, "close_pass": 0.0, "harsh_jerk": 0.0}
    assert measured(crossing(5.0))["wrong_way"] is None, "no lane"
    scene.agents.kind[:] = AgentKind.CYCLIST
    assert measured(scene) == {"wrong_way": None, "red_light": None, "close_pass": 0.0, "harsh_jerk": None}
    assert set(measured(scene, controlled=torch.zeros(2, dtype=torch.bool)).values()) == {None}
    unlit = red_light()
    unlit.lights = no_lights()
    assert measured(unlit)["red_light"] is None


def wild(seed: int) -> tuple[Scene, Tensor]:
    """A road with a light and rollouts in which everything happens."""
    scene = straight_road(6, speed=8.0, gap=9.0, seed=seed)
    scene.lights = red_light().lights
    generator = torch.Generator().manual_seed(seed)
    rollouts = log_of(scene).repeat(8, 1, 1, 1)
    turn = torch.randn(8, 6, 1, generator=generator) * AHEAD / 8
    step = rotate(torch.tensor([0.8, 0.0]), turn) * (1 + torch.randn(8, 6, 1, 1, generator=generator) / 8)
    rollouts[..., :2] = rollouts[..., :1, :2] + step.cumsum(2) - step[:, :, :1]
    rollouts[..., 3] = turn
    return scene, rollouts


@pytest.mark.parametrize("seed", range(6))
def test_neither_place_nor_direction_nor_order_of_agents_matters(seed: int) -> None:
    scene, rollouts = wild(seed)
    before = measured(scene, rollouts)
    order = torch.randperm(6, generator=torch.Generator().manual_seed(seed))
    assert measured(select_agents(scene, order), rollouts[:, order]) == pytest.approx(before)
    angle, shift = torch.tensor(2.0 + seed), torch.tensor([70.0, -30.0])
    scene = scene.clone()
    for points in (scene.agents.position, scene.road.points, scene.lights.stop_point, rollouts):
        points[..., :2] = rotate(points[..., :2], angle) + shift
    scene.agents.heading += angle
    rollouts[..., 3] += angle
    assert measured(scene, rollouts) == pytest.approx(before)


def test_the_wild_scenes_have_some_of_everything() -> None:
    values = [measured(*wild(seed)) for seed in range(6)]
    assert all(0 < sum(value[name] for value in values) < 6 for name in MEASURES)


def test_an_agent_that_is_not_present_changes_nothing() -> None:
    scene, rollouts = wild(0)
    more = select_agents(scene, torch.tensor([0, 1, 2, 3, 4, 5, 5]))
    more.agents.valid = more.agents.valid.clone()
    more.agents.valid[6, CURRENT_STEP] = False
    assert measured(more, rollouts) == measured(scene, rollouts)


@pytest.mark.parametrize("steps", [1, 4, 5, 7, 10, 16])
def test_rollouts_of_any_length_are_measured(steps: int) -> None:
    scene = crossing(0.5)
    assert measured(scene, log_of(scene)[:, :, :steps]).keys() == set(MEASURES)


def test_trajectories_that_do_not_fit_are_refused() -> None:
    scene = straight_road(2)
    log, everybody = log_of(scene), torch.ones(2, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"takes trajectories \[K, 2, T, 4\], got \[1, 1, 80, 4\]"):
        safety(scene, log[:, :1], everybody)
    with pytest.raises(ValueError, match="has 80 steps after the current one, got 160"):
        safety(scene, log.repeat(1, 1, 2, 1), everybody)
    with pytest.raises(ValueError, match=r"controlled is \[2\] bool, got \[3\] torch.bool"):
        safety(scene, log, torch.ones(3, dtype=torch.bool))


# --- of a store -----------------------------------------------------------------------------------------------------
def test_the_logs_of_a_store_tell_by_class_who_leaves_the_road(
    tmp_path: Path, write_store: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    poses = torch.zeros(4, 91, 3)
    poses[:, :, 0] = TIME
    poses[:, :, 1] = torch.tensor([0.0, 45.0, 60.0, 70.0])[:, None]  # the road ends at 50
    kinds = [AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.PEDESTRIAN, AgentKind.PEDESTRIAN]
    folder = write_store(tmp_path / "store", [build_scene(poses, EDGE, kind=torch.tensor(kinds))])
    main([str(folder)])
    told = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["off-road,", "vehicle", "0.0000", "of", "1", "agents"] in told
    assert ["off-road,", "pedestrian", "0.6667", "of", "3", "agents"] in told
    assert not any("cyclist" in line for line in told)


def test_no_scenes_to_measure_are_refused(
    tmp_path: Path, write_store: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_store(tmp_path / "store", [straight_road(1)])
    with pytest.raises(SystemExit, match="--limit must be 1 or more, got 0"):
        main([str(folder), "--limit", "0"])


if __name__ == "__main__":
    pytest.main([__file__])
