"""Each quirk of the official code makes the difference that its name says, and no other."""

from __future__ import annotations

import math

import pytest
import torch

from dpa.realism import Quirk, RealismConfig, realism
from dpa.realism.lights import red_light_violation
from envs.geometry.edges import RoadEdges
from envs.scene import CURRENT_STEP, LightState, MapKind, Scene
from envs.sources.synthetic import build_scene, red_light, straight_road
from tests.dpa.realism.golden import measured

OFFICIAL = RealismConfig.load("2025")
CLEAN = OFFICIAL.replace(quirks=frozenset())


def without(quirk: Quirk) -> RealismConfig:
    return OFFICIAL.replace(quirks=OFFICIAL.quirks - {quirk})


def log_as_rollout(scene: Scene) -> torch.Tensor:
    agents = scene.agents
    return agents.trajectory[None, agents.present, 11:]


def likelihood(scene: Scene, rollouts: torch.Tensor, config: RealismConfig, name: str) -> float:
    return realism(scene, rollouts, config).likelihood[name]


def test_every_year_but_2023_has_all_quirks_that_are_not_of_2023_alone() -> None:
    of_2023 = {Quirk.GHOSTS, Quirk.POINTS_AT_ZERO}
    assert RealismConfig.load("2024").quirks == OFFICIAL.quirks == frozenset(Quirk) - of_2023
    assert Quirk.POINTS_AT_ZERO in RealismConfig.load("2023").quirks


def test_nan_in_last_bin() -> None:
    # 80 steps of 11 m/s, the last speed unknown: 79 of 80 samples in its bin, or 79 of 79
    scene = straight_road(num_vehicles=1, speed=11.0)
    rollout = log_as_rollout(scene)
    assert likelihood(scene, rollout, OFFICIAL, "linear_speed") == pytest.approx(79.1 / 81, rel=1e-5)
    config = without(Quirk.NAN_IN_LAST_BIN)
    assert likelihood(scene, rollout, config, "linear_speed") == pytest.approx(79.1 / 80, rel=1e-5)


def test_unmasked_samples() -> None:
    # the log has its last 40 steps only at 11 m/s; the rollout drives 21 m/s where the log has none
    scene = straight_road(num_vehicles=1, speed=11.0)
    scene.agents.valid[0, 11:51] = False
    rollout = log_as_rollout(scene)
    rollout[0, 0, :40, 0] -= 10 * 0.1 * torch.arange(40, 0, -1)
    config = without(Quirk.UNMASKED_SAMPLES)
    assert likelihood(scene, rollout, OFFICIAL, "linear_speed") < 0.6
    assert likelihood(scene, rollout, config, "linear_speed") > 0.95


def test_invalid_at_origin() -> None:
    scene = straight_road(num_vehicles=1, speed=10.0)
    rollout = log_as_rollout(scene)
    scene.agents.valid[0, 9] = False
    scene.origin = torch.tensor([3000.0, 4000.0, 0.0], dtype=torch.float64)

    def first_acceleration(config: RealismConfig) -> float:
        return measured(scene, rollout, config).values["linear_acceleration"][1, 0, 0].item()

    assert abs(first_acceleration(OFFICIAL)) > 1e5
    assert math.isnan(first_acceleration(without(Quirk.INVALID_AT_ORIGIN)))


def test_a_speed_across_a_hole_of_the_log_reaches_no_leader_in_the_clean_metric() -> None:
    # the follower is as fast as its leader; across the hole it seems to come from the origin of the world
    scene = straight_road(num_vehicles=2, speed=10.0)
    rollout = log_as_rollout(scene)
    follower = int(scene.agents.position[:, CURRENT_STEP, 0].argmin())
    scene.agents.valid[follower, 50] = False
    scene.agents.position[follower, 50] = -torch.tensor([3000.0, 4000.0, 0.0])
    scene.origin = torch.tensor([3000.0, 4000.0, 0.0], dtype=torch.float64)

    def shortest(config: RealismConfig) -> float:
        return measured(scene, rollout, config).values["time_to_collision"][0].min().item()

    clean = without(Quirk.INVALID_AT_ORIGIN)
    assert shortest(OFFICIAL) < 0.1 and shortest(clean) == 5.0
    assert likelihood(scene, rollout, OFFICIAL, "time_to_collision") < 0.95
    assert likelihood(scene, rollout, clean, "time_to_collision") > 0.95


def test_nobody_crosses_a_red_light_from_the_origin_in_the_clean_metric() -> None:
    scene = red_light(speed=8.5)
    last = int(scene.agents.valid[0].nonzero()[-1])
    scene.agents.valid[0, last - 1] = False
    scene.agents.position[0, last - 1] = 0.0  # before the stop line, as the origin of the world may be
    before = scene.agents.position[0, last, 0]
    assert before > scene.lights.stop_point[0, last, 0]
    official = frozenset(Quirk) - {Quirk.PLUS_FOR_MINUS, Quirk.LANES_TO_ORIGIN}
    assert last - CURRENT_STEP - 1 in violations(scene, official)
    assert last - CURRENT_STEP - 1 not in violations(scene, official - {Quirk.INVALID_AT_ORIGIN})


def test_an_agent_without_a_logged_future_has_no_part_in_the_clean_displacement() -> None:
    scene = straight_road(num_vehicles=3)
    rollout = log_as_rollout(scene)
    rollout[..., 1] += 1.0
    scene.agents.valid[2, CURRENT_STEP + 1 :] = False
    scored = realism(scene, rollout, without(Quirk.HISTORY_IN_ADE))
    assert scored.min_ade == pytest.approx(1.0) and scored.ade == pytest.approx(1.0)


def test_ends_unscored() -> None:
    # the first step is as fast as the rollouts, all others are not: it counts only in the clean metric
    scene = straight_road(num_vehicles=1, speed=11.0)
    rollout = log_as_rollout(scene)
    scene.agents.valid[0, 13:] = False  # steps 11 and 12 remain: one speed, at step 11
    assert math.isnan(likelihood(scene, rollout, OFFICIAL, "linear_speed"))
    assert likelihood(scene, rollout, without(Quirk.ENDS_UNSCORED), "linear_speed") > 0.9


def test_unwrapped_turn() -> None:
    poses = torch.zeros(2, 91, 3)
    poses[0, :, 0], poses[1, :, 0] = -torch.arange(91.0), -100 - 0.2 * torch.arange(91)
    poses[0, :, 2], poses[1, :, 2] = 3.1, -3.1
    scene = build_scene(poses, [(15, torch.tensor([[200.0, 5.0], [-200.0, 5.0]]))])

    def shortest(config: RealismConfig) -> float:
        return measured(scene, log_as_rollout(scene), config).values["time_to_collision"][1, 0].min().item()

    assert shortest(OFFICIAL) == 5.0
    assert shortest(without(Quirk.UNWRAPPED_TURN)) < 5.0


def test_last_ttc() -> None:
    # a leader that is never reached but at the last step's unknown speed: 5 s at every other step too
    scene = straight_road(num_vehicles=2, speed=10.0)
    rollout = log_as_rollout(scene)
    scene.agents.valid[:, 11:90] = False  # only the last step is scored
    assert likelihood(scene, rollout, OFFICIAL, "time_to_collision") > 0.9
    assert math.isnan(likelihood(scene, rollout, without(Quirk.LAST_TTC), "time_to_collision"))


def test_longest_ring() -> None:
    angle = torch.linspace(0, 2 * torch.pi, 9)
    ring = torch.stack((angle.cos(), angle.sin(), torch.zeros(9)), -1) * 10  # counter-clockwise: the road is inside
    longer = torch.stack((torch.linspace(500, 600, 20), torch.zeros(20), torch.zeros(20)), -1)
    beyond_the_seam = torch.tensor([[11.0, 0.01, 0.0]])
    opened, closed = (RoadEdges.from_polylines([ring, longer], every_ring=every) for every in (False, True))
    assert closed.signed_distance(beyond_the_seam) > 0
    assert opened.previous[0] == -1 and closed.previous[0] == 7


def test_points_at_zero() -> None:
    point, edge = torch.tensor([[0.0, 50.0, 0.0], [0.0, 50.0, 0.0]]), torch.tensor([[-9.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    query = torch.tensor([[0.0, 3.0, 0.0]])
    assert RoadEdges.from_polylines([point, edge]).signed_distance(query) == -3
    assert RoadEdges.from_polylines([point, edge], points_at_zero=True).signed_distance(query) == 0


def violations(scene: Scene, quirks: frozenset[Quirk]) -> list[int]:
    position = scene.agents.position[None, :, CURRENT_STEP:, :2]
    valid = scene.agents.valid[None, :, CURRENT_STEP:]
    return red_light_violation(scene, position, valid, quirks)[0, 0].nonzero()[:, 0].tolist()


def test_plus_for_minus() -> None:
    # the stop point lies between two points of its lane, and beside a point of a second lane 2.5 m away
    scene = red_light(speed=8.5)
    scene.lights.stop_point[..., 0] = 25.0
    second = slice(int(scene.road.start[2]), int(scene.road.start[2] + scene.road.count[2]))
    scene.road.kind[2] = int(MapKind.LANE_SURFACE_STREET)
    scene.road.points[second, 0] += 5.0
    assert violations(scene, frozenset(Quirk)) == []
    assert violations(scene, frozenset(Quirk) - {Quirk.PLUS_FOR_MINUS}) == [29]


def test_lanes_to_origin() -> None:
    # a short second lane ends at (40.8, -5.4); its way to the origin leads through the car, 0.2 m beside its own lane
    scene = red_light(speed=8.5)
    scene.agents.position[..., 1] = -2.7
    scene.road.points = torch.cat((scene.road.points, torch.tensor([[40.8, -99.0, 0.0], [40.8, -5.4, 0.0]])))
    scene.road.start[1], scene.road.count[1] = len(scene.road.points) - 2, 2
    assert violations(scene, frozenset()) == [23]
    assert violations(scene, frozenset({Quirk.LANES_TO_ORIGIN})) == []


def test_absent_stop_at_origin() -> None:
    # the light is not listed until the car is past it; until then its stop point is the origin, here far ahead
    scene = red_light(speed=8.5)
    scene.road.kind[1] = int(MapKind.LANE_BIKE)
    step = CURRENT_STEP + 24
    scene.lights.state[:, :step] = int(LightState.ABSENT)
    scene.lights.stop_point[:, :step] = torch.tensor([1e3, 0.0, 0.0])
    official = frozenset(Quirk) - {Quirk.PLUS_FOR_MINUS}
    assert violations(scene, official) == [23]
    assert violations(scene, official - {Quirk.ABSENT_STOP_AT_ORIGIN}) == []


def test_history_in_ade() -> None:
    scene = straight_road(num_vehicles=1)
    rollout = log_as_rollout(scene)
    rollout[..., 1] += 1.0
    assert realism(scene, rollout, OFFICIAL).min_ade == pytest.approx(80 / 91)
    assert realism(scene, rollout, without(Quirk.HISTORY_IN_ADE)).min_ade == pytest.approx(1.0)


def test_ghosts() -> None:
    # the second car leaves the log; without a position it lies at the origin of the world, where the first one stands
    poses = torch.zeros(2, 91, 3)
    poses[1, :, 0] = 50.0
    scene = build_scene(poses, [(15, torch.tensor([[200.0, 5.0], [-200.0, 5.0]]))])
    rollout = log_as_rollout(scene)
    scene.agents.valid[1, 40:] = False
    scene.agents.position[1, 40:] = 0

    def log_collides(config: RealismConfig) -> bool:
        return measured(scene, rollout, config).values["collision_per_step"][0, 0].any().item()

    assert not log_collides(OFFICIAL)
    assert log_collides(OFFICIAL.replace(quirks=OFFICIAL.quirks | {Quirk.GHOSTS}))


def test_quirks_false_leaves_out_all_of_them() -> None:
    scene = straight_road(num_vehicles=3, seed=0)
    rollouts = log_as_rollout(scene).expand(4, -1, -1, -1)
    assert realism(scene, rollouts, "2025", quirks=False) == realism(scene, rollouts, CLEAN)
    assert realism(scene, rollouts, "2025", quirks=False) != realism(scene, rollouts, "2025")
