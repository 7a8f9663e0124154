"""Fixtures of the tests of the world."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from envs.scene import CURRENT_STEP, LOG_STEPS
from envs.sources.scenario import Scenario


@pytest.fixture
def make_scenario() -> Callable[..., Any]:
    """Makes a valid Scenario proto that tests then break: cars that drive along x, a lane, a road edge, a light."""

    def make(scenario_id: str = "made", num_tracks: int = 2) -> Any:
        scenario = Scenario(scenario_id=scenario_id, sdc_track_index=0, current_time_index=CURRENT_STEP)
        for index in range(num_tracks):
            track = scenario.tracks.add(id=100 + index, object_type=1)
            for step in range(LOG_STEPS):
                track.states.add(
                    center_x=12_000.0 + step - 10 * index,
                    center_y=-7_000.5,
                    center_z=30.25,
                    heading=0.5,
                    velocity_x=10.0,
                    length=4.5,
                    width=2.0,
                    height=1.5,
                    valid=True,
                )
        lane = scenario.map_features.add(id=7).lane
        lane.type, lane.speed_limit_mph = 2, 45.0
        edge = scenario.map_features.add(id=8).road_edge
        edge.type = 1
        for x in (11_900.0, 12_100.0):
            lane.polyline.add(x=x, y=-7_000.0, z=30.0)
            edge.polyline.add(x=x, y=-7_004.0, z=30.0)
        for _ in range(LOG_STEPS):
            light = scenario.dynamic_map_states.add().lane_states.add(lane=7, state=4)
            light.stop_point.x, light.stop_point.y, light.stop_point.z = 12_050.0, -7_000.0, 30.0
        scenario.tracks_to_predict.add(track_index=num_tracks - 1)
        return scenario

    return make
