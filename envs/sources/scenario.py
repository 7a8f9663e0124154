"""Message classes for the Scenario proto of the Waymo Open Motion Dataset.

Field numbers are facts of the format (realism.md 9). Fields that no scene keeps (lidar, camera, boundary segments of
lanes) are listed too, so that a field which is really unknown can be told from them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from google.protobuf.message import Message
from google.protobuf.unknown_fields import UnknownFieldSet

from envs.sources.protobuf import message_classes

_POINTS = {"polygon": (1, "MapPoint*")}
_LINE = {"type": (1, "int32"), "polyline": (2, "MapPoint*")}

_CLASSES = message_classes(
    "envs.womd",
    {
        "Scenario": {
            "timestamps_seconds": (1, "double*"),
            "field_3": (3, "bytes"),  # empty in some of Waymo's files, and not in the published description
            "tracks": (2, "Track*"),
            "objects_of_interest": (4, "int32*"),
            "scenario_id": (5, "string"),
            "sdc_track_index": (6, "int32"),
            "dynamic_map_states": (7, "DynamicMapState*"),
            "map_features": (8, "MapFeature*"),
            "current_time_index": (10, "int32"),
            "tracks_to_predict": (11, "RequiredPrediction*"),
            "compressed_frame_laser_data": (12, "bytes*"),
            "frame_camera_tokens": (13, "bytes*"),
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
            "left_boundaries": (13, "bytes*"),
            "right_boundaries": (14, "bytes*"),
        },
        "LaneNeighbor": {
            "feature_id": (1, "int64"),
            "self_start_index": (2, "int32"),
            "self_end_index": (3, "int32"),
            "neighbor_start_index": (4, "int32"),
            "neighbor_end_index": (5, "int32"),
            "boundaries": (6, "bytes*"),
        },
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
LARGEST_UNKNOWN = 1 << 20
"""Bytes of unknown fields of one scene beyond which they are not told apart: that takes a second."""


def unknown_fields(payload: bytes) -> Iterator[str]:
    """Fields of a serialized Scenario that the format above does not have, as ``Message.number``, one for each time.

    Of more than :data:`LARGEST_UNKNOWN` bytes only that is said.

    Examples:
        >>> list(unknown_fields(Scenario(scenario_id="a").SerializeToString()))
        []
        >>> field_99 = bytes([0x98, 0x06, 0x01])
        >>> list(unknown_fields(Scenario(scenario_id="a").SerializeToString() + field_99))
        ['Scenario.99']
    """
    scenario = Scenario.FromString(payload)
    size = scenario.ByteSize()
    scenario.DiscardUnknownFields()
    unknown = size - scenario.ByteSize()
    del scenario  # a large one twice is too much
    if unknown > LARGEST_UNKNOWN:
        yield "(megabytes of them)"
    elif unknown:  # walking through a hundred thousand points is slow, and hardly ever needed
        yield from _walk(Scenario.FromString(payload))


def _walk(message: Any) -> Iterator[str]:
    yield from (f"{message.DESCRIPTOR.name}.{field.field_number}" for field in UnknownFieldSet(message))
    for field, value in message.ListFields():
        if field.message_type is not None:
            for inner in [value] if isinstance(value, Message) else value:
                yield from _walk(inner)
