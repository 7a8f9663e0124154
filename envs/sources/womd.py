"""Waymo Open Motion Dataset: Scenario protos in TFRecord files -> scenes.

A file is a TFRecord (plain or gzip), or one serialized Scenario where its name ends in ``.binproto`` or ``.pb``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from google.protobuf.message import DecodeError

from envs.scene import CURRENT_STEP, LARGEST_NUMBER, LOG_STEPS, LinkKind, MapKind, Scene, SceneError
from envs.sources.fields import one_line
from envs.sources.files import find_files, is_remote, open_file
from envs.sources.recording import LightListing, Polyline, Recording, agent_kind, check_count, light_state, map_kind
from envs.sources.scenario import Scenario, unknown_fields
from envs.sources.source import Notes, Record, Source
from envs.sources.tfrecord import MAX_PAYLOAD, count_frames, is_packed, read_bytes, read_frames, unpacked
from envs.validation import check_scene_id

METRES_PER_SECOND_PER_MPH = 0.44704
_BARE_SUFFIXES = (".binproto", ".pb")
_STATE_FIELDS = (
    *("center_x", "center_y", "center_z", "length", "width", "height"),
    *("heading", "velocity_x", "velocity_y"),
)
_INVALID_STATE = (0.0,) * len(_STATE_FIELDS)
_POLYGONS = {"crosswalk": MapKind.CROSSWALK, "speed_bump": MapKind.SPEED_BUMP, "driveway": MapKind.DRIVEWAY}


def read_womd(path: str | Path) -> Iterator[Scene]:
    """Scenes of one WOMD file, in file order, each validated.

    Args:
        path: a TFRecord of Scenario protos, or one bare Scenario (``.binproto``, ``.pb``).

    Raises:
        SceneError: naming the file and the record: broken frame or checksum, no Scenario, not
            91 steps (the test split holds 11), no SDC, and all that :meth:`~envs.scene.Scene.validate` refuses.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from envs.sources.scenario import Scenario
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "empty.binproto"
        ...     size = path.write_bytes(Scenario(scenario_id="none").SerializeToString())
        ...     next(read_womd(path))
        Traceback (most recent call last):
        ...
        envs.scene.SceneError: ...empty.binproto, record 0 (scene none): it has no tracks; ...
    """
    return WOMD.scenes(str(path))


def scene_from_scenario(scenario: Any, name: str, notes: Notes | None = None) -> Scene:
    """One parsed Scenario -> scene.

    Args:
        scenario: a message of :data:`~envs.sources.scenario.Scenario`, or of the official class.
        name: what errors call it.
        notes: counts types and states that are not known.
    """
    notes = Counter() if notes is None else notes
    check_scene_id(scenario.scenario_id, name)
    name = f"{name} (scene {scenario.scenario_id})"
    _check_steps(scenario, name)
    _check_counts(scenario, name)
    states = np.array([[_state(state) for state in track.states] for track in scenario.tracks], dtype=np.float64)
    _check_states(states, name)
    features = scenario.map_features
    return Recording(
        scene_id=scenario.scenario_id,
        position=states[..., :3],
        extent=states[..., 3:6],
        heading=states[..., 6],
        velocity=states[..., 7:9],
        valid=np.array([[state.valid for state in track.states] for track in scenario.tracks]),
        kind=[agent_kind(track.object_type, notes) for track in scenario.tracks],
        track_id=[track.id for track in scenario.tracks],
        sdc=scenario.sdc_track_index if scenario.HasField("sdc_track_index") else -1,
        predict=[required.track_index for required in scenario.tracks_to_predict],
        polylines=[line for feature in features if (line := _polyline(feature, notes)) is not None],
        links=[link for feature in features if feature.HasField("lane") for link in _links(feature.id, feature.lane)],
        lights=_lights(scenario, notes),
    ).to_scene(name)


def _check_steps(scenario: Any, name: str) -> None:
    if not scenario.tracks:
        raise SceneError(f"{name}: it has no tracks; leave the scene out.")
    check_count("track", len(scenario.tracks), name)
    for track in scenario.tracks:
        if len(track.states) != LOG_STEPS:
            raise SceneError(
                f"{name}: track {track.id} has {len(track.states)} steps where {LOG_STEPS} are needed. The test split "
                "holds the 11 steps of history only: take the training or validation split."
            )
    if scenario.current_time_index != CURRENT_STEP:
        raise SceneError(f"{name}: the current step is {scenario.current_time_index}; it must be {CURRENT_STEP}.")
    if len(scenario.dynamic_map_states) not in (0, LOG_STEPS):
        raise SceneError(
            f"{name}: {len(scenario.dynamic_map_states)} steps of traffic lights; there must be {LOG_STEPS} or none."
        )


def _check_counts(scenario: Any, name: str) -> None:
    """Two bytes of a file make a point, a listing or a link; what is made of them here has a hundred times as many."""
    check_count("track to predict", len(scenario.tracks_to_predict), name)
    check_count("map feature", len(scenario.map_features), name)
    check_count("light listing", sum(len(step.lane_states) for step in scenario.dynamic_map_states), name)
    points = links = 0
    for feature in scenario.map_features:
        lane = feature.lane
        points += len(lane.polyline) + len(feature.road_line.polyline) + len(feature.road_edge.polyline)
        points += sum(len(getattr(feature, field).polygon) for field in _POLYGONS)
        links += len(lane.exit_lanes) + len(lane.entry_lanes) + len(lane.left_neighbors) + len(lane.right_neighbors)
    check_count("point of the map", points, name)
    check_count("link", links, name)


def _check_states(states: np.ndarray, name: str) -> None:
    """``[A, L, 9]``, 0 where invalid."""
    bad = ~(np.abs(states) <= LARGEST_NUMBER)
    if bad.any():
        track, step, field = np.argwhere(bad)[0]
        raise SceneError(
            f"{name}: tracks[{track}].states[{step}].{_STATE_FIELDS[field]} is {states[track, step, field]:g}; must be "
            f"a finite number between -{LARGEST_NUMBER:g} and {LARGEST_NUMBER:g}, or the state must be invalid."
        )


def _state(state: Any) -> tuple[float, ...]:
    """Position (3), size (3), heading and velocity (2) of one state, in the order of the fields' names."""
    if not state.valid:
        return _INVALID_STATE
    return (
        state.center_x,
        state.center_y,
        state.center_z,
        state.length,
        state.width,
        state.height,
        state.heading,
        state.velocity_x,
        state.velocity_y,
    )


def _polyline(feature: Any, notes: Notes) -> Polyline | None:
    make = partial(Polyline, feature.id)
    if feature.HasField("lane"):
        lane = feature.lane
        kind = map_kind("lane", lane.type, notes)
        return make(kind, _xyz(lane.polyline), lane.speed_limit_mph * METRES_PER_SECOND_PER_MPH)
    for field in ("road_line", "road_edge"):
        if feature.HasField(field):
            line = getattr(feature, field)
            return make(map_kind(field, line.type, notes), _xyz(line.polyline))
    if feature.HasField("stop_sign"):
        return make(MapKind.STOP_SIGN, _xyz([feature.stop_sign.position]))
    for field, kind in _POLYGONS.items():
        if feature.HasField(field):
            return make(kind, _xyz(getattr(feature, field).polygon))
    notes["map feature of an unknown kind, left out"] += 1
    return None


def _xyz(points: Any) -> list[tuple[float, float, float]]:
    return [(point.x, point.y, point.z) for point in points]


def _links(lane_id: int, lane: Any) -> Iterator[tuple[int, int, int]]:
    yield from ((lane_id, after, LinkKind.EXIT) for after in lane.exit_lanes)
    yield from ((before, lane_id, LinkKind.EXIT) for before in lane.entry_lanes)
    yield from ((lane_id, beside.feature_id, LinkKind.LEFT) for beside in lane.left_neighbors)
    yield from ((lane_id, beside.feature_id, LinkKind.RIGHT) for beside in lane.right_neighbors)


def _lights(scenario: Any, notes: Notes) -> list[LightListing]:
    # An unset stop point is (0, 0, 0) of the world: proto2's default, and what the official metric reads.
    return [
        LightListing(
            step,
            row.lane,
            light_state(row.state, notes),
            (row.stop_point.x, row.stop_point.y, row.stop_point.z),
        )
        for step, listed in enumerate(scenario.dynamic_map_states)
        for row in listed.lane_states
    ]


def payloads(path: str) -> Iterator[Callable[[], bytes]]:
    """The serialized Scenarios of a file in one pass, each read when its function is called.

    Args:
        path: local or an address.

    Raises:
        SceneError: the file, or the rest of it, cannot be read.
    """
    with open_file(path) as file, unpacked(file) as content:
        if _is_bare(path):
            yield partial(_read_bare, content, f"{path}, record 0")
        else:
            yield from read_frames(content, path)


def _read_bare(file: BinaryIO, name: str) -> bytes:
    payload = read_bytes(file, MAX_PAYLOAD + 1, name)
    if len(payload) > MAX_PAYLOAD:
        raise SceneError(f"{name}: has more than {MAX_PAYLOAD} bytes; at most so many are read.")
    return payload


def _is_bare(path: str) -> bool:
    return path.removesuffix(".gz").endswith(_BARE_SUFFIXES)


def _count(path: str) -> int | None:
    """Scenes of a file, if that is cheap to tell."""
    if _is_bare(path):
        return 1
    if is_remote(path):
        return None
    with open_file(path) as file:
        return None if is_packed(file) else count_frames(file)


def _records(path: str) -> Iterator[Record]:
    with closing(payloads(path)) as contents:
        for index, read in enumerate(contents):
            yield Record(path, index, partial(_make, read, f"{path}, record {index}"))


def _make(read: Callable[[], bytes], name: str, notes: Notes) -> Scene:
    payload = read()
    try:
        scenario = Scenario.FromString(payload)
    except DecodeError as error:
        raise SceneError(f"{name}: not a Scenario proto ({one_line(error)}); convert WOMD's scenario files.") from error
    scene = scene_from_scenario(scenario, name, notes)
    del scenario  # a large one and its copy are too much
    notes.update(f"unknown field {field}, left out" for field in unknown_fields(payload))
    return scene


WOMD = Source(
    name="womd",
    help="Waymo Open Motion Dataset: TFRecord files of Scenario protos",
    find=lambda paths: find_files(paths, "*.tfrecord*", *(f"*{suffix}" for suffix in _BARE_SUFFIXES)),
    records=_records,
    count=_count,
)
