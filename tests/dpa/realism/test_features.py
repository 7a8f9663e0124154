"""Measurements of each step against the official code, and its quirks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from dpa.realism import RealismConfig
from envs.scene import Scene
from envs.sources.synthetic import build_scene, straight_road
from tests.dpa.realism.golden import CODES, SHIPPED, Golden, golden_config, measured

CONFIG = RealismConfig.load("2025")

FLIPS = {
    # two boxes touch in the log, in exact numbers: the distance is +6e-8 here and -2e-7 there
    ("synth_a", "collision_per_step"): 33,
    # corners as near to one polyline as to another but for the last bit
    ("synth_a", "distance_to_road_edge"): 20,
    ("synth_a", "offroad_per_step"): 20,
}
"""How many of 18,480 values may differ, where rounding decides; none elsewhere."""


def check_against_official(golden: Golden, *, moved: bool, code: str = "code2025") -> None:
    scene = golden.load_scene(moved=moved)
    found = measured(scene, golden.load_rollouts(scene), golden_config(code, CODES[code]))
    official = golden.load_features(code)
    np.testing.assert_array_equal(found.track_id.numpy(), official["log_object_id"])
    np.testing.assert_array_equal(found.valid[:, 2:].numpy(), official["log_valid"][0])
    np.testing.assert_allclose(
        found.displacement.numpy(), official["sim_average_displacement_error"], rtol=1e-5, atol=1e-5
    )
    for name, value in found.values.items():
        if code == "code2023" and name in ("collision_per_step", "offroad_per_step"):
            continue  # the first code gave events of whole rollouts only; test_metric has those
        expected = np.concatenate([official[f"log_{name}"], official[f"sim_{name}"]])
        allowed = FLIPS.get((golden.scene, name), 0)
        if expected.dtype == bool:
            wrong = value.numpy() != expected
        else:
            np.testing.assert_array_equal(value.isnan().numpy(), np.isnan(expected), name)
            wrong = np.abs(value.numpy() - expected) > 2e-3 * (1 + np.abs(expected))
            # accelerations out of invalid history are of the order of 1e5 and the log is not scored there
            wrong[0] &= official["log_valid"][0]
        assert wrong.sum() <= allowed, name


@pytest.mark.parametrize("kind", ["constvel", "cv_noise", "log_noise_iid", "log_noise_smooth", "logged"])
@pytest.mark.parametrize("scene", ["synth_a", "synth_b"])
def test_measurements_equal_the_official_ones(scene: str, kind: str) -> None:
    check_against_official(Golden(SHIPPED, scene, kind), moved=False)


@pytest.mark.parametrize("kind", ["logged", "log_noise_smooth"])
def test_measurements_equal_the_official_ones_on_a_real_scene(shared: Path, kind: str) -> None:
    check_against_official(Golden(shared / "realism" / "golden", "637f20cafde22ff8", kind), moved=True)


@pytest.mark.parametrize("code", ["code2023", "code2023dec"])
@pytest.mark.parametrize("kind", ["cv_noise", "log_noise_smooth"])
@pytest.mark.parametrize("scene", ["synth_a", "synth_b"])
def test_measurements_equal_those_of_the_code_of_2023(scene: str, kind: str, code: str) -> None:
    check_against_official(Golden(SHIPPED, scene, kind), moved=False, code=code)


@pytest.mark.parametrize("code", ["code2023", "code2023dec"])
def test_measurements_equal_those_of_the_code_of_2023_on_a_real_scene(shared: Path, code: str) -> None:
    golden = Golden(shared / "realism" / "golden", "637f20cafde22ff8", "log_noise_smooth")
    check_against_official(golden, moved=True, code=code)


def log_as_rollout(scene: Scene) -> torch.Tensor:
    agents = scene.agents
    return agents.trajectory[None, agents.present, 11:]


def test_differences_at_the_end_of_a_rollout_are_not_a_number() -> None:
    scene = straight_road(num_vehicles=1)
    values = measured(scene, log_as_rollout(scene), CONFIG).values
    assert values["linear_speed"].isnan().sum(-1).unique().tolist() == [1]
    assert values["angular_acceleration"].isnan().sum(-1).unique().tolist() == [2]
    assert not values["linear_speed"][..., 0].isnan().any()


def test_speed_counts_the_height_too() -> None:
    scene = straight_road(num_vehicles=1, speed=10.0)
    rollout = log_as_rollout(scene)
    rollout[..., 2] = 0.5 * torch.arange(80)
    speed = measured(scene, rollout, CONFIG).values["linear_speed"][1, 0, 40]
    assert speed.item() == pytest.approx(math.hypot(10, 5), rel=1e-4)


def test_invalid_history_lies_at_the_origin_of_the_world() -> None:
    scene = straight_road(num_vehicles=2, speed=10.0)
    rollout = log_as_rollout(scene)
    scene.agents.valid[1, 9] = False
    scene.agents.position[1, 9] = 0
    scene.origin = torch.tensor([3000.0, 4000.0, 0.0], dtype=torch.float64)
    acceleration = measured(scene, rollout, CONFIG).values["linear_acceleration"][1, 1, 0]
    # speed at step 10 is half the way to the origin in 0.1 s, speed at step 12 nearly nothing beside it
    assert acceleration.item() == pytest.approx(-(5000 / 0.2) / 0.2, rel=1e-2)


def test_time_to_collision_is_the_gap_over_the_closing_speed() -> None:
    poses = torch.zeros(2, 91, 3)
    time = torch.arange(91) * 0.1
    poses[0, :, 0] = 10 * time
    poses[1, :, 0] = 60 + 6 * time
    edge = torch.tensor([[200.0, 5.0], [-200.0, 5.0]])
    scene = build_scene(poses, [(15, edge)])
    ttc = measured(scene, log_as_rollout(scene), CONFIG).values["time_to_collision"]
    gap = 60 - 4.6 - 4 * time[11:]
    expected = (gap / 4).clamp(max=5.0)
    torch.testing.assert_close(ttc[1, 0, :-1], expected[:-1], atol=1e-2, rtol=0)
    assert ttc[1, 0, -1] == 5.0
    assert (ttc[1, 1] == 5.0).all()


def test_headings_on_both_sides_of_pi_do_not_follow_each_other() -> None:
    def shortest(heading: float) -> float:
        poses = torch.zeros(2, 91, 3)
        poses[0, :, 0] = -torch.arange(91.0)
        poses[1, :, 0] = -100 - 0.2 * torch.arange(91)
        poses[0, :, 2], poses[1, :, 2] = 3.1, heading
        scene = build_scene(poses, [(15, torch.tensor([[200.0, 5.0], [-200.0, 5.0]]))])
        return measured(scene, log_as_rollout(scene), CONFIG).values["time_to_collision"][1, 0].min().item()

    assert shortest(3.1) < 5.0
    assert shortest(-3.1) == 5.0
