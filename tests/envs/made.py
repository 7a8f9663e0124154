"""Small valid inputs of every format, made by hand: tests break them one way, the fuzz run in ten thousand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from envs.scene import CURRENT_STEP, LOG_STEPS, Scene
from envs.shards import ShardWriter, file_digest
from envs.sources.scenario import Scenario
from envs.store import Manifest, write_manifest

# --- WOMD -----------------------------------------------------------------------------------------------------------


def make_scenario(scenario_id: str = "made", num_tracks: int = 2) -> Any:
    """A valid Scenario proto: cars that drive along x, a lane, a road edge, a light."""
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


def make_rich_scenario(scenario_id: str = "rich") -> Any:
    """A valid Scenario proto with something in every field that is read, and steps that are not valid."""
    scenario = make_scenario(scenario_id, num_tracks=3)
    for state in scenario.tracks[2].states[40:]:
        state.Clear()
    scenario.tracks[1].object_type, scenario.tracks[2].object_type = 2, 3
    lane, after = scenario.map_features[0].lane, scenario.map_features.add(id=9).lane
    after.polyline.add(x=12_100.0, y=-7_000.0)
    lane.exit_lanes.append(9)
    after.entry_lanes.append(7)
    lane.left_neighbors.add(feature_id=9)
    after.right_neighbors.add(feature_id=7)
    scenario.map_features.add(id=10).road_line.type = 3
    scenario.map_features[-1].road_line.polyline.add(x=12_000.0, y=-7_002.0)
    sign = scenario.map_features.add(id=20).stop_sign
    sign.lane.append(7)
    sign.position.x, sign.position.y = 12_050.0, -7_003.0
    for number, field in enumerate(("crosswalk", "speed_bump", "driveway"), 21):
        polygon = getattr(scenario.map_features.add(id=number), field).polygon
        for x, y in ((12_000.0, -7_000.0), (12_003.0, -7_000.0), (12_003.0, -7_004.0)):
            polygon.add(x=x, y=y, z=30.0)
    return scenario


# --- GPUDrive -------------------------------------------------------------------------------------------------------


def gpudrive_track(x: float, heading: float, **more: Any) -> dict[str, Any]:
    return {
        "position": [{"x": x + 0.5 * step, "y": 200.0, "z": 5.0} for step in range(91)],
        "heading": [heading] * 91,
        "velocity": [{"x": 5.0, "y": 0.0} for _ in range(91)],
        "valid": [True] * 91,
        "length": 4.5,
        "width": 2.0,
        "height": 1.5,
        "type": "vehicle",
        **more,
    }


def gpudrive_road(kind: str, xs: tuple[float, ...], **more: Any) -> dict[str, Any]:
    return {"geometry": [{"x": x, "y": 195.0, "z": 5.0} for x in xs], "type": kind, **more}


def newer_gpudrive() -> dict[str, Any]:
    """A valid file of the dialect with ids, radians and metadata."""
    return {
        "name": "x",
        "scenario_id": "newer",
        "objects": [gpudrive_track(1000.0, 0.1, id=7), gpudrive_track(1020.0, -3.0, id=9, type="cyclist")],
        "roads": [
            gpudrive_road("lane", (900.0, 1100.0), id=3, map_element_id=2),
            gpudrive_road("road_edge", (900.0, 1100.0), id=4, map_element_id=16),
        ],
        "tl_states": {},
        "metadata": {"sdc_track_index": 0, "objects_of_interest": [], "tracks_to_predict": [{"track_index": 1}]},
    }


def older_gpudrive() -> dict[str, Any]:
    """A valid file of the dialect without ids or metadata, in degrees, with a light."""
    roads = [("lane", (900.0, 1100.0)), ("road_edge", (900.0, 1100.0)), ("stop_sign", (950.0,))]
    return {
        "name": "x",
        "scenario_id": "older",
        "objects": [gpudrive_track(1000.0, 360.0), gpudrive_track(1020.0, -90.0)],
        "roads": [gpudrive_road(kind, xs) for kind, xs in roads],
        "tl_states": {
            "117": {"state": ["stop", "arrow_go"], "x": [1.0, 2.0], "y": [0, 0], "z": [0, 0], "time_index": [4, 5]}
        },
    }


# --- Argoverse 2: a street that runs east from (1000, 200) and climbs by 2 % -----------------------------------------


def ground(x: float) -> float:
    return 50 + 0.02 * (x - 1000)


def line(*points: tuple[float, float]) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": ground(x)} for x, y in points]


def lane(
    number: int, left: list, right: list, marks: tuple[str, str] = ("NONE", "NONE"), **more: Any
) -> dict[str, Any]:
    return {
        "id": number,
        "is_intersection": False,
        "lane_type": "VEHICLE",
        "left_lane_boundary": left,
        "right_lane_boundary": right,
        "left_lane_mark_type": marks[0],
        "right_lane_mark_type": marks[1],
        "predecessors": [],
        "successors": [],
        "left_neighbor_id": None,
        "right_neighbor_id": None,
        **more,
    }


def along(y: float, start: float = 1000, end: float = 1060) -> list[dict[str, float]]:
    return line((start, y), (end, y))


def rectangle(x0: float, y0: float, x1: float, y1: float) -> dict[str, Any]:
    return {"area_boundary": line((x0, y0), (x0, y1), (x1, y1), (x1, y0))}  # clockwise, as in the files


def argoverse_map() -> dict[str, Any]:
    """From the right: a bicycle lane (13), two lanes (10, 11), an oncoming one (12); lane 14 goes on after lane 10."""
    oncoming = {"left_lane_boundary": along(207)[::-1], "right_lane_boundary": along(210.5)[::-1]}
    lanes = [
        lane(10, along(203.5), along(200), ("DASHED_WHITE", "SOLID_WHITE"), successors=[14, 15], left_neighbor_id=11)
        | {"right_neighbor_id": 13},
        lane(11, along(207), along(203.5), ("DOUBLE_SOLID_YELLOW", "DASHED_WHITE"), left_neighbor_id=12)
        | {"right_neighbor_id": 10},
        lane(12, [], [], ("DOUBLE_SOLID_YELLOW", "UNKNOWN"), left_neighbor_id=11) | oncoming,
        lane(13, along(200), along(198.5), ("SOLID_WHITE", "NONE"), lane_type="BIKE", left_neighbor_id=10),
        lane(14, along(203.5, 1060, 1090), along(200, 1060, 1090), predecessors=[10], is_intersection=True),
    ]
    return {
        "lane_segments": {str(item["id"]): item for item in lanes},
        "pedestrian_crossings": {
            "5": {"id": 5, "edge1": line((1030, 198), (1030, 211)), "edge2": line((1033, 198), (1033, 211))}
        },
        # Two tiles with a hairline between them.
        "drivable_areas": {
            "1": {"id": 1, **rectangle(1000, 197, 1059.98, 212)},
            "2": {"id": 2, **rectangle(1060.02, 197, 1100, 212)},
        },
    }


def argoverse_rows(track: str, kind: str, category: int, steps: range, y: float = 201.75) -> list[dict[str, Any]]:
    return [
        {
            "scenario_id": "made",
            "track_id": track,
            "object_type": kind,
            "object_category": category,
            "timestep": step,
            "position_x": 1005 + 0.5 * step,
            "position_y": y,
            "heading": 0.25,
            "velocity_x": 5.0,
            "velocity_y": 0.5,
        }
        for step in steps
    ]


def columns_of(table: list[dict[str, Any]]) -> dict[str, list]:
    return {field: np.array([row[field] for row in table], dtype=object).tolist() for field in table[0]}


def argoverse_columns() -> dict[str, list]:
    """Rows of five tracks, one of which is gone before the 91 steps begin and one of which comes late."""
    table = [
        *argoverse_rows("7", "vehicle", 3, range(110)),
        *argoverse_rows("8", "pedestrian", 2, range(25, 40), y=199.0),
        *argoverse_rows("9", "vehicle", 0, range(19)),
        *argoverse_rows("AV", "vehicle", 1, range(110), y=205.0),
        *argoverse_rows("4", "cyclist", 2, range(30, 110)),
    ]
    return columns_of(table)


# --- a store --------------------------------------------------------------------------------------------------------


def write_store(folder: Path, *shards: list[Scene], source: str = "made", split: str = "") -> Path:
    """Write a store by hand to a folder, one shard for each list of scenes."""
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
