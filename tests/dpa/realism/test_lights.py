"""Driving through red lights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dpa.realism.lights import red_light_violation
from envs.scene import LightState, MapKind, RoadMap, Scene
from envs.sources.synthetic import no_lights, red_light, straight_road
from tests.dpa.realism.golden import lights_from_npz


def violations(scene: Scene) -> list[int]:
    position = scene.agents.position[None, :, 10:, :2]
    return red_light_violation(scene, position, scene.agents.valid[None, :, 10:])[0, 0].nonzero()[:, 0].tolist()


def one_lane_with_red_light() -> Scene:
    """A car on the only street of its map. Beside a second one, 5 m away and with points 10 m apart like the first, the
    official distance would take it to be on the other."""
    scene = red_light(speed=8.5)
    scene.road.kind[1] = int(MapKind.LANE_BIKE)
    return scene


def test_passing_the_stop_point_at_red_counts_once() -> None:
    # 8.5 m/s reach the stop point at 20 m after 2.35 s; the first step beyond it is the 24th
    assert violations(one_lane_with_red_light()) == [23]


def test_standing_on_the_very_stop_point_for_a_step_hides_the_passage() -> None:
    scene = one_lane_with_red_light()
    scene.agents.position[0, 10 + 24, 0] = 20.0
    scene.agents.position[0, 10 + 23, 0] = 19.5
    assert violations(scene) == []


@pytest.mark.parametrize("state", [LightState.GO, LightState.CAUTION, LightState.FLASHING_STOP, LightState.UNKNOWN])
def test_other_states_do_not_count(state: LightState) -> None:
    scene = one_lane_with_red_light()
    scene.lights.state = torch.full_like(scene.lights.state, int(state))
    assert violations(scene) == []


def test_the_light_of_another_lane_does_not_count() -> None:
    scene = one_lane_with_red_light()
    scene.lights.lane_id = torch.tensor([3])
    assert violations(scene) == []


def test_neither_lanes_that_are_no_street_nor_missing_lights_matter() -> None:
    scene = one_lane_with_red_light()
    scene.road.kind[0] = int(MapKind.LANE_FREEWAY)
    assert violations(scene) == []
    scene = one_lane_with_red_light()
    scene.lights = no_lights()
    assert violations(scene) == []


@pytest.mark.parametrize("case", range(10))
def test_violations_equal_the_official_ones(shared: Path, case: int) -> None:
    data = dict(np.load(shared / "realism" / "golden" / "micro" / f"red_light_{case:02}.npz"))
    count = torch.from_numpy(np.diff(data["lane_ptr"]))
    scene = straight_road(num_vehicles=1)
    scene.road = RoadMap(
        points=torch.from_numpy(data["lane_xyz"]).float(),
        start=count.cumsum(0) - count,
        count=count,
        kind=torch.from_numpy(data["lane_type"]).long(),
        feature_id=torch.from_numpy(data["lane_id"]).long(),
        speed_limit=torch.zeros(len(count)),
        links=torch.empty(0, 3, dtype=torch.int64),
        batch_size=[],
    )
    scene.lights = lights_from_npz(data, torch.zeros(3))
    position = torch.from_numpy(np.stack([data["x"], data["y"]], -1))[None, :, 10:]
    valid = torch.from_numpy(data["valid"])[None, :, 10:]
    got = red_light_violation(scene, position, valid)[0].numpy()
    np.testing.assert_array_equal(got, data["violation"][:, 11:])
