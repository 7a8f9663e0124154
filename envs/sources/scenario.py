"""Message classes for the Scenario proto of the Waymo Open Motion Dataset.

Field numbers are facts of the format (SPEC section 9). Fields that nothing here reads (camera, lidar) are left out: a
parser skips what it does not know.
"""

from __future__ import annotations

from envs.sources.protobuf import message_classes

_POINTS = {"polygon": (1, "MapPoint*")}
_LINE = {"type": (1, "int32"), "polyline": (2, "MapPoint*")}

_CLASSES = message_classes(
    "envs.womd",
    {
        "Scenario": {
            "timestamps_seconds": (1, "double*"),
            "tracks": (2, "Track*"),
            "objects_of_interest": (4, "int32*"),
            "scenario_id": (5, "string"),
            "sdc_track_index": (6, "int32"),
            "dynamic_map_states": (7, "DynamicMapState*"),
            "map_features": (8, "MapFeature*"),
            "current_time_index": (10, "int32"),
            "tracks_to_predict": (11, "RequiredPrediction*"),
        },
        "Track": {"id": (1, "int32"), "object_type": (2, "int32"), "states": (3, "ObjectState*")},
        "ObjectState": {
            "center_x": (2, "double"),
            "center_y": (3, "double"),
            "center_z": (4, "double"),
            "length": (5, "float"),
            "width": (6, "float"),
            "height": (7, "float"),
            "heading": (8, "float"),
            "velocity_x": (9, "float"),
            "velocity_y": (10, "float"),
            "valid": (11, "bool"),
        },
        "RequiredPrediction": {"track_index": (1, "int32"), "difficulty": (2, "int32")},
        "DynamicMapState": {"lane_states": (1, "TrafficSignalLaneState*")},
        "TrafficSignalLaneState": {"lane": (1, "int64"), "state": (2, "int32"), "stop_point": (3, "MapPoint")},
        "MapFeature": {
            "id": (1, "int64"),
            "lane": (3, "LaneCenter"),
            "road_line": (4, "RoadLine"),
            "road_edge": (5, "RoadEdge"),
            "stop_sign": (7, "StopSign"),
            "crosswalk": (8, "Crosswalk"),
            "speed_bump": (9, "SpeedBump"),
            "driveway": (10, "Driveway"),
        },
        "MapPoint": {"x": (1, "double"), "y": (2, "double"), "z": (3, "double")},
        "LaneCenter": {
            "speed_limit_mph": (1, "double"),
            "type": (2, "int32"),
            "interpolating": (3, "bool"),
            "polyline": (8, "MapPoint*"),
            "entry_lanes": (9, "int64[]"),
            "exit_lanes": (10, "int64[]"),
            "left_neighbors": (11, "LaneNeighbor*"),
            "right_neighbors": (12, "LaneNeighbor*"),
        },
        "LaneNeighbor": {"feature_id": (1, "int64")},
        "RoadLine": _LINE,
        "RoadEdge": _LINE,
        "StopSign": {"lane": (1, "int64*"), "position": (2, "MapPoint")},
        "Crosswalk": _POINTS,
        "SpeedBump": _POINTS,
        "Driveway": _POINTS,
    },
)

Scenario = _CLASSES["Scenario"]
"""The message class: ``Scenario.FromString(data)``."""
