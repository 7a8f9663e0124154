"""Fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from envs.scene import CURRENT_STEP, LOG_STEPS, Scene
from envs.shards import ShardWriter, file_digest
from envs.sources.scenario import Scenario
from envs.store import Manifest, write_manifest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with real scenes and golden values; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("DPA_SHARED", REPOSITORY.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"needs the real scenes and golden values in {folder} (set DPA_SHARED)")
    return folder


@pytest.fixture(scope="session")
def write_store() -> Callable[..., Path]:
    """Writes a store by hand to a folder, one shard for each list of scenes."""

    def write(folder: Path, *shards: list[Scene], source: str = "made", split: str = "") -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        entries = []
        for number, scenes in enumerate(shards):
            writer, path = ShardWriter(), folder / f"{number:05d}.scenes"
            for row, scene in enumerate(scenes):
                writer.add(scene, ("made", row))
            writer.write(path)
            entries.append({"name": path.name, "scenes": len(scenes), "sha256": file_digest(path)})
        write_manifest(folder, Manifest(source, {"split": split}, "", complete=True, shards=entries))
        return folder

    return write


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
