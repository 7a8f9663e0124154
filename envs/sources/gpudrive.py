"""GPUDrive JSON of WOMD scenes, one scene in a file: ``.json``, ``.json.gz`` or ``.json.xz``.

Two dialects are about. The newer one has ids, radians and a ``metadata`` entry that names the SDC and the tracks to
predict. The older one has none of them: headings are degrees, the SDC is the last object, no track is marked for
prediction, and some files give map features no id and no exact kind. Neither has lane topology or speed limits.
"""

from __future__ import annotations

import gzip
import io
import lzma
import math
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from envs.scene import LANE_KINDS, LOG_STEPS, AgentKind, Lacks, LightState, MapKind, Scene, SceneError
from envs.sources.fields import Field, decode_json, one_line
from envs.sources.files import find_files, read_file
from envs.sources.recording import KIND_OF_FEATURE, LightListing, Polyline, Recording
from envs.sources.source import Notes, Record, Source

MAX_BYTES = 1 << 24
"""Of an unpacked file; a scene has about 5 MB, and decoded JSON takes up to forty times its size in memory."""
MAX_XZ_MEMORY = 1 << 28
"""Bytes for unpacking itself: a file of some bytes can ask for gigabytes; the highest level of xz asks for 65 MiB."""
_LACKS = Lacks.TOPOLOGY | Lacks.SPEED_LIMITS
_RADIANS_LIMIT = math.pi + 1e-3
"""No heading in radians is larger; the slack is for float32, whose pi is larger than pi."""
_MOVING_SPEED = 1.0
"""Faster agents travel where they head [m/s]."""


def scene_from_json(top: Field, notes: Notes | None = None) -> Scene:
    """One decoded file -> scene.

    Tracks without an id have their place in the list for one, map features a negative number. Lights name lanes by id:
    where the map has none, a light belongs to the lane that begins nearest to where it stops traffic. Invalid steps may
    hold anything (-10000 and 0.0001 occur).

    Args:
        top: what the JSON holds.
        notes: counts classes, types and states that are not known.

    Raises:
        SceneError: naming the file: an entry missing or of the wrong type, not 91 steps, no SDC, and all that
            :meth:`~envs.scene.Scene.validate` refuses.
    """
    notes = Counter() if notes is None else notes
    objects = top["objects"].items(at_least=1)
    valid = np.array([_steps(item, "valid", Field.flag) for item in objects])
    velocity = np.stack([_table(item, "velocity", "x", "y") for item in objects])
    heading = np.array([_steps(item, "heading", partial(Field.number, finite=False)) for item in objects])
    extent = np.array([[item[side].number() for side in ("length", "width", "height")] for item in objects])
    metadata = top.get("metadata")
    polylines = [_polyline(road, index, notes) for index, road in enumerate(top["roads"].items())]
    lights = [listing for light in top["tl_states"].entries() for listing in _listings(light, notes)]
    return Recording(
        scene_id=top["scenario_id"].text(),
        position=np.stack([_table(item, "position", "x", "y", "z") for item in objects]),
        heading=_radians(heading, velocity, valid),
        velocity=velocity,
        extent=np.broadcast_to(extent[:, None], (len(objects), LOG_STEPS, 3)),
        valid=valid,
        kind=[_agent_kind(item["type"], notes) for item in objects],
        track_id=[_id(item, index) for index, item in enumerate(objects)],
        sdc=len(objects) - 1 if metadata is None else metadata["sdc_track_index"].integer(),
        predict=[] if metadata is None else _predicted(metadata),
        polylines=polylines,
        lights=lights if any(line.feature_id >= 0 for line in polylines) else _tied(lights, polylines),
        lacks=_LACKS | (Lacks.TARGETS if metadata is None else Lacks.NOTHING),
    ).to_scene(top.name)


def _steps(item: Field, key: str, read: Any) -> list:
    """One value for each step."""
    values = item[key].items()
    _check_steps(item[key], len(values))
    return [read(value) for value in values]


def _table(item: Field, key: str, *columns: str) -> np.ndarray:
    """``[L, columns]``; what is not finite must lie at an invalid step, which the scene checks."""
    table = item[key].table(*columns, finite=False)
    _check_steps(item[key], len(table))
    return table


def _check_steps(field: Field, count: int) -> None:
    if count != LOG_STEPS:
        raise SceneError(
            f"{field.name}: {field.path} has {count} steps where {LOG_STEPS} are needed; convert a split with the "
            "whole 9.1 s."
        )


def _id(item: Field, index: int) -> int:
    own = item.get("id")
    return index if own is None else own.integer(lowest=-(2**62))


def _predicted(metadata: Field) -> list[int]:
    return [track["track_index"].integer() for track in metadata["tracks_to_predict"].items()]


def _radians(heading: np.ndarray, velocity: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """``[A, L]`` headings in radians, whichever unit the file has.

    A heading beyond pi says degrees. WOMD's own headings can pass pi too (they are not wrapped), so a file with such
    headings is taken for radians after all where the directions of travel fit radians better.
    """
    finite = valid & np.isfinite(heading) & np.isfinite(velocity).all(-1)
    if not (np.abs(heading[finite]) > _RADIANS_LIMIT).any():
        return heading
    moving = finite & (np.hypot(velocity[..., 0], velocity[..., 1]) > _MOVING_SPEED)
    travel = np.arctan2(velocity[moving][:, 1], velocity[moving][:, 0])
    if np.cos(heading[moving] - travel).sum() > np.cos(np.deg2rad(heading[moving]) - travel).sum():
        return heading
    radians = np.full_like(heading, np.nan)
    np.remainder(np.deg2rad(heading) + math.pi, 2 * math.pi, out=radians, where=np.isfinite(heading))
    return radians - math.pi


def _agent_kind(field: Field, notes: Notes) -> AgentKind:
    name = field.text()
    if name.upper() not in AgentKind.__members__:
        notes[f"object of unknown type {name[:40]!r}, taken as OTHER"] += 1
    return AgentKind.__members__.get(name.upper(), AgentKind.OTHER)


def _polyline(road: Field, index: int, notes: Notes) -> Polyline:
    return Polyline(_id(road, -1 - index), _map_kind(road, notes), road["geometry"].table("x", "y", "z"))


def _map_kind(road: Field, notes: Notes) -> MapKind:
    """The exact kind where the file has it, or what its type alone says."""
    name = road["type"].text()
    if name not in KIND_OF_FEATURE:
        raise road["type"].error(f"be one of {', '.join(KIND_OF_FEATURE)}")
    number = road.get("map_element_id")
    if number is None:
        return KIND_OF_FEATURE[name]
    if number.integer(lowest=-(2**62)) not in set(MapKind):
        notes[f"{name} of unknown map_element_id {number.value}, taken as {KIND_OF_FEATURE[name].name}"] += 1
        return KIND_OF_FEATURE[name]
    return MapKind(number.value)


def _listings(light: Field, notes: Notes) -> Iterator[LightListing]:
    """All that a file says of the light of one lane, whose id is the key of the entry."""
    lane = light.key_as_integer()
    columns = {key: light[key].items() for key in ("time_index", "state", "x", "y", "z")}
    if len({len(column) for column in columns.values()}) > 1:
        counts = ", ".join(f"{len(column)} of {key}" for key, column in columns.items())
        raise SceneError(f"{light.name}: {light.path} has {counts}; must have as many of each.")
    for step, state, x, y, z in zip(*columns.values(), strict=True):
        point = (x.number(), y.number(), z.number())
        yield LightListing(step.integer(highest=LOG_STEPS - 1), lane, _light_state(state, notes), point)


def _tied(lights: list[LightListing], polylines: list[Polyline]) -> list[LightListing]:
    """Lights of a map without ids, each tied to the lane that begins nearest to its first stop point."""
    starts = {line.feature_id: line.points[0] for line in polylines if line.kind in LANE_KINDS and len(line.points)}
    nearest: dict[int, int] = {}
    for light in lights if starts else ():
        if light.lane_id not in nearest:
            nearest[light.lane_id] = min(starts, key=lambda lane: math.dist(starts[lane][:2], light.stop_point[:2]))
    return [replace(light, lane_id=nearest.get(light.lane_id, light.lane_id)) for light in lights]


def _light_state(field: Field, notes: Notes) -> LightState:
    name = field.text()
    if name.upper() not in LightState.__members__:
        notes[f"light of unknown state {name[:40]!r}, taken as UNKNOWN"] += 1
    return LightState.__members__.get(name.upper(), LightState.UNKNOWN)


def _records(path: str) -> Iterator[Record]:
    yield Record(path, 0, partial(_make, path))


def _make(path: str, notes: Notes) -> Scene:
    name = f"{path}, record 0"
    packed = read_file(path, MAX_BYTES)
    try:
        text = _unpacked(packed, Path(path).suffix)
    except (EOFError, OSError, lzma.LZMAError, zlib.error) as error:
        raise SceneError(f"{name}: cannot be unpacked ({one_line(error)}); fetch the file again.") from error
    if len(text) > MAX_BYTES:
        raise SceneError(f"{name}: has more than {MAX_BYTES >> 20} MiB when unpacked; that is no scene.")
    return scene_from_json(decode_json(text, name), notes)


def _unpacked(packed: bytes, suffix: str) -> bytes:
    """The content of a file; of one that is too large, a byte more than the limit."""
    if suffix == ".gz":
        with gzip.open(io.BytesIO(packed)) as content:
            return content.read(MAX_BYTES + 1)
    if suffix != ".xz":
        return packed
    content = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=MAX_XZ_MEMORY)
    text = content.decompress(packed, MAX_BYTES + 1)
    if not content.eof and len(text) <= MAX_BYTES:
        raise EOFError("the file ends too early")
    return text


GPUDRIVE = Source(
    name="gpudrive",
    help="GPUDrive JSON of WOMD scenes, one in a file: .json, .json.gz or .json.xz",
    find=lambda paths: find_files(paths, "*.json", "*.json.gz", "*.json.xz"),
    records=_records,
    count=lambda path: 1,
    lacks=_LACKS,
)
