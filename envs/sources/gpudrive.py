"""GPUDrive (and Nocturne) JSON of WOMD scenes, one scene in a file: ``.json``, ``.json.gz`` or ``.json.xz``.

Two dialects are about. The newer one has ids, radians and a ``metadata`` entry that names the SDC and the tracks to
predict. The older one has none of them: headings are degrees, the SDC is the last object, no track is marked for
prediction, and some files give map features no id and no exact kind. Neither has lane topology or speed limits.
"""

from __future__ import annotations

import gzip
import json
import lzma
import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from envs.scene import LOG_STEPS, AgentKind, LightState, Scene, SceneError
from envs.sources.recording import KIND_OF_FEATURE, LightListing, Polyline, Recording
from envs.sources.source import Source, Unit, find_files

_OPENERS = {".gz": gzip.open, ".xz": lzma.open}
_RADIANS_LIMIT = math.pi + 1e-3
"""No heading in radians is larger; the slack is for float32, whose pi is larger than pi."""
_MOVING_SPEED = 1.0
"""Faster agents travel where they head [m/s]."""


def read_gpudrive(path: str | Path) -> Scene:
    """The scene of one GPUDrive JSON file, validated.

    Ids that the file lacks are positions in its lists. Invalid steps may hold anything (-10000 and 0.0001 occur).

    Raises:
        SceneError: naming the file: not JSON, an entry missing or of the wrong type, not 91 steps, no SDC, and all that
            :meth:`~envs.scene.Scene.validate` refuses.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "scene.json"
        ...     size = path.write_text('{"scenario_id": "1a"}')
        ...     read_gpudrive(path)
        Traceback (most recent call last):
        ...
        envs.scene.SceneError: ...scene.json, record 0: the entry 'objects' is missing; ...
    """
    return next(GPUDRIVE.scenes(str(path)))


def scene_from_json(data: dict[str, Any], name: str) -> Scene:
    """One decoded file -> scene.

    Args:
        data: what the JSON holds.
        name: what errors call it.
    """
    objects, roads = data["objects"], data["roads"]
    if not objects:
        raise SceneError(f"{name}: it has no objects; leave the scene out.")
    _check_steps(objects, name)
    valid = np.array([item["valid"] for item in objects], dtype=bool)
    metadata = data.get("metadata", {"sdc_track_index": len(objects) - 1, "tracks_to_predict": []})
    size = np.array([[item["length"], item["width"], item["height"]] for item in objects], dtype=np.float64)
    velocity = np.array([[(v["x"], v["y"]) for v in item["velocity"]] for item in objects])
    return Recording(
        scene_id=data["scenario_id"],
        position=np.array([[(p["x"], p["y"], p["z"]) for p in item["position"]] for item in objects]),
        heading=_radians(np.array([item["heading"] for item in objects]), velocity, valid),
        velocity=velocity,
        extent=np.broadcast_to(size[:, None], (len(objects), LOG_STEPS, 3)),
        valid=valid,
        kind=[_named(AgentKind, item["type"], "object type", name) for item in objects],
        track_id=[item.get("id", index) for index, item in enumerate(objects)],
        sdc=metadata["sdc_track_index"],
        predict=[track["track_index"] for track in metadata["tracks_to_predict"]],
        polylines=[_polyline(road, index) for index, road in enumerate(roads)],
        lights=_lights(data["tl_states"], name),
    ).to_scene(name)


def _check_steps(objects: list[dict[str, Any]], name: str) -> None:
    for index, item in enumerate(objects):
        for field in ("position", "heading", "velocity", "valid"):
            if len(item[field]) != LOG_STEPS:
                raise SceneError(
                    f"{name}: object {index} has {len(item[field])} steps of {field} where {LOG_STEPS} are needed; "
                    "convert a split with the whole 9.1 s."
                )


def _radians(heading: np.ndarray, velocity: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """``[A, L]`` headings in radians, whichever unit the file has.

    A heading beyond pi says degrees. WOMD's own headings can pass pi too (they are not wrapped), so a file with such
    headings is taken for radians after all where the directions of travel fit radians better.
    """
    if not (np.abs(heading[valid]) > _RADIANS_LIMIT).any():
        return heading
    moving = valid & (np.hypot(velocity[..., 0], velocity[..., 1]) > _MOVING_SPEED)
    travel = np.arctan2(velocity[moving][:, 1], velocity[moving][:, 0])
    if np.cos(heading[moving] - travel).sum() > np.cos(np.deg2rad(heading[moving]) - travel).sum():
        return heading
    return np.remainder(np.deg2rad(heading) + math.pi, 2 * math.pi) - math.pi


def _polyline(road: dict[str, Any], index: int) -> Polyline:
    kind = road["map_element_id"] if "map_element_id" in road else KIND_OF_FEATURE[road["type"]]
    return Polyline(road.get("id", index), kind, [(p["x"], p["y"], p["z"]) for p in road["geometry"]])


def _lights(table: dict[str, dict[str, list]], name: str) -> list[LightListing]:
    return [
        LightListing(step, int(lane), _named(LightState, state, f"light of lane {lane}", name), (x, y, z))
        for lane, light in table.items()
        for step, state, x, y, z in zip(
            *(light[field] for field in ("time_index", "state", "x", "y", "z")), strict=True
        )
    ]


def _named(enum: type, value: str, what: str, name: str) -> int:
    if value.upper() not in enum.__members__:
        raise SceneError(f"{name}: the {what} is {value!r}; known: {[member.lower() for member in enum.__members__]}.")
    return int(enum[value.upper()])


@contextmanager
def _open(path: str) -> Iterator[Callable[[Unit], Scene]]:
    def make(unit: Unit) -> Scene:
        opener = _OPENERS.get(Path(path).suffix, open)
        try:
            with opener(path, "rt", encoding="utf-8") as file:
                data = json.load(file)
            return scene_from_json(data, unit.name)
        except SceneError:
            raise
        except KeyError as error:
            raise SceneError(f"{unit.name}: the entry {error} is missing; it is not a GPUDrive scene.") from error
        except (AttributeError, EOFError, OSError, TypeError, ValueError, lzma.LZMAError, zlib.error) as error:
            raise SceneError(f"{unit.name}: not a GPUDrive scene ({error}); fetch the file again.") from error

    yield make


GPUDRIVE = Source(
    name="gpudrive",
    help="GPUDrive JSON of WOMD scenes, one in a file: .json, .json.gz or .json.xz",
    find=lambda paths: find_files(paths, "*.json", "*.json.gz", "*.json.xz"),
    locate=lambda path: iter([Unit(path)]),
    open=_open,
)
