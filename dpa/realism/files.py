"""Scenarios and rollouts from files, in the layouts in which people pass them on.

A scenario is a TFRecord or a serialized Scenario of the Waymo Open Motion Dataset, a scene of a store, or an ``.npz``
of arrays in world coordinates. Rollouts are an ``.npz`` of ``x, y, z, heading [R, A, 80]`` with ``object_id [A]``, or
a submission of the challenge.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpa.realism.submission import SubmissionReader, decode_rollouts
from dpa.realism.tracks import HORIZON
from envs.files import read_arrays
from envs.scene import CURRENT_STEP, LOG_STEPS, Scene, SceneError
from envs.sources.recording import (
    KIND_OF_FEATURE,
    LightListing,
    Polyline,
    Recording,
    agent_kind,
    light_state,
    map_kind,
)
from envs.sources.source import Notes
from envs.sources.womd import METRES_PER_SECOND_PER_MPH, read_womd
from envs.store import MANIFEST_FILE, SceneStore

ARRAYS = ".npz"
_POSE = ("x", "y", "z", "heading")


class Simulated(NamedTuple):
    """A scene and rollouts of it.

    Attributes:
        scene: uncollated.
        poses: ``[R, A, 80, 4]``, as :func:`dpa.realism.realism` takes them.
        name: of the file that the rollouts are from.
    """

    scene: Scene
    poses: Tensor
    name: str


class Scenarios:
    """Scenes of a file or folder, by id.

    Scenes of files stay in memory once they are read, since rollouts may come in any order; of a store none does, so
    convert large sets first.

    Args:
        path: a store, a file of scenarios, or a folder of such files.

    Raises:
        ValueError: nothing is there (also SceneError, a ValueError).
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise ValueError(f"{self.path} does not exist; give a file or folder of scenarios, or a store.")
        self.store = SceneStore(self.path) if (self.path / MANIFEST_FILE).is_file() else None
        self._unread = iter(()) if self.store else self._read()
        self._seen: dict[str, Scene] = {}

    def find(self, scene_id: str) -> Scene:
        """The scene of an id; files are read only as far as needed.

        Raises:
            ValueError: there is none.
        """
        if self.store:
            return self.store[self.store.index_of(scene_id)]
        while scene_id not in self._seen:
            scene = next(self._unread, None)
            if scene is None:
                raise ValueError(f"{self.path} has no scenario {scene_id!r}; its scenarios: {', '.join(self._seen)}.")
            self._seen[scene.scene_id] = scene
        return self._seen[scene_id]

    def ids(self) -> list[str]:
        """Ids of all scenes, in order."""
        if self.store:
            return self.store.scene_ids
        self._seen |= {scene.scene_id: scene for scene in self._unread}
        return list(self._seen)

    def only(self) -> Scene:
        """The scene, where there is one.

        Raises:
            ValueError: there are several.
        """
        names = self.ids()
        if len(names) != 1:
            some = ", ".join(names[:5])
            raise ValueError(f"{self.path} has {len(names)} scenarios; choose one by its id: {some} ...")
        return self.find(names[0])

    def _read(self) -> Iterator[Scene]:
        files = [self.path]
        if self.path.is_dir():
            files = sorted(file for file in self.path.iterdir() if file.is_file())
        for file in files:
            if file.suffix == ARRAYS:
                yield scene_from_arrays(read_arrays(file), str(file))
            else:
                yield from read_womd(file)


def read_rollouts(path: str | Path, scenarios: Scenarios, scene_id: str | None = None) -> Iterator[Simulated]:
    """Rollouts of a file or folder, each with its scene.

    Args:
        path: an ``.npz``, a folder of them, or a submission. An ``.npz`` in a folder is of the scenario that its name
            starts with, up to ``__``.
        scenarios: where the scenes are.
        scene_id: only this scenario; needed for an ``.npz`` if there are several scenarios.

    Raises:
        ValueError: what is wrong with a file, by name.
    """
    path = Path(path)
    if path.suffix == ARRAYS:
        scene = scenarios.only() if scene_id is None else scenarios.find(scene_id)
        yield Simulated(scene, poses_from_arrays(read_arrays(path), scene, str(path)), str(path))
    elif path.is_dir() and any(path.glob(f"*{ARRAYS}")):
        for file in sorted(path.glob(f"*{ARRAYS}")):
            name = file.stem.split("__")[0]
            if scene_id in (None, name):
                scene = scenarios.find(name)
                yield Simulated(scene, poses_from_arrays(read_arrays(file), scene, str(file)), str(file))
    else:
        for message in SubmissionReader(path):
            if scene_id in (None, message.scenario_id):
                scene = scenarios.find(message.scenario_id)
                yield Simulated(scene, decode_rollouts(scene, message), str(path))


def poses_from_arrays(arrays: dict[str, np.ndarray], scene: Scene, name: str) -> Tensor:
    """Rollouts in world coordinates -> those that :func:`dpa.realism.realism` takes.

    Args:
        arrays: ``x``, ``y``, ``z``, ``heading`` of shape ``[R, A, 80]`` and ``object_id [A]``, in any order of agents.
        scene: that they are of.
        name: what errors call them.

    Returns:
        ``[R, A, 80, 4]`` in the frame of the scene, agents in its order.

    Raises:
        ValueError: an array is missing or of another shape, or the agents are not those of the scene.
    """
    missing = sorted({*_POSE, "object_id"} - arrays.keys())
    if missing:
        raise ValueError(f"{name} has no array {', '.join(missing)}; rollouts need {', '.join(_POSE)} and object_id.")
    _check_numbers({key: arrays[key] for key in (*_POSE, "object_id")}, name)
    if arrays["object_id"].ndim != 1:
        raise ValueError(f"{name}: object_id must have the shape [A], got {list(arrays['object_id'].shape)}.")
    ids, wanted = arrays["object_id"].tolist(), scene.agents.track_id[scene.agents.present].tolist()
    if sorted(ids) != sorted(wanted):
        raise ValueError(
            f"{name} must have every agent of scene {scene.scene_id} that is there at the current step once, and no "
            f"other: it lacks {sorted(set(wanted) - set(ids))}, has {sorted(set(ids) - set(wanted))} beyond, and "
            f"{len(ids)} in all where {len(wanted)} are needed."
        )
    shapes = {arrays[key].shape for key in _POSE}
    if len(shapes) > 1 or len(next(iter(shapes))) != 3 or next(iter(shapes))[1:] != (len(ids), HORIZON):
        raise ValueError(
            f"{name}: {', '.join(_POSE)} must have the shape [R, {len(ids)}, {HORIZON}], got "
            f"{', '.join(str(list(arrays[key].shape)) for key in _POSE)}."
        )
    column = {track: index for index, track in enumerate(ids)}
    world = torch.from_numpy(np.stack([arrays[key] for key in _POSE], -1)).double()
    world[..., :3] -= scene.origin
    return world[:, [column[track] for track in wanted]].float()


def _check_numbers(arrays: dict[str, np.ndarray], name: str) -> None:
    for key, array in arrays.items():
        if array.dtype.kind not in "iuf" or array.dtype.itemsize > 8:
            raise ValueError(f"{name}: {key} must hold numbers, got {array.dtype}.")


def scene_from_arrays(arrays: dict[str, np.ndarray], name: str) -> Scene:
    """A scenario of arrays in world coordinates -> scene.

    Args:
        arrays: tracks ``x, y, z, heading, length, width, height, vx, vy, valid [N, 91]``, ``object_id`` and
            ``object_type [N]``; ``sdc_track_index``, ``tracks_to_predict``, ``scenario_id`` and
            ``current_time_index``, which is 10; map features as ``KIND_xyz [n, 3]`` with offsets ``KIND_ptr``,
            ``KIND_id`` and, for lanes, lines and edges, ``KIND_type``; lights as ``tl_ptr [92]``, ``tl_lane_id``,
            ``tl_state``, ``tl_stop_point``.
        name: what errors call them.

    Raises:
        ValueError: an array is missing or of another shape (also SceneError, a ValueError).
    """
    notes: Notes = Counter()
    if others := sorted(key for key, array in arrays.items() if array.dtype.kind not in "biufU"):
        raise ValueError(
            f"{name} is no scenario of arrays: {others[0]} holds {arrays[others[0]].dtype}; write it again."
        )
    try:
        stacked = {
            "position": np.stack([arrays[key] for key in ("x", "y", "z")], -1).astype(np.float64),
            "extent": np.stack([arrays[key] for key in ("length", "width", "height")], -1),
            "velocity": np.stack([arrays[key] for key in ("vx", "vy")], -1),
        }
        recording = Recording(
            scene_id=str(arrays["scenario_id"]),
            heading=arrays["heading"],
            valid=arrays["valid"],
            kind=[agent_kind(number, notes) for number in arrays["object_type"].tolist()],
            track_id=arrays["object_id"].tolist(),
            sdc=int(arrays["sdc_track_index"]),
            predict=arrays["tracks_to_predict"].tolist(),
            polylines=[line for kind in KIND_OF_FEATURE for line in _polylines(arrays, kind, notes)],
            lights=list(_lights(arrays, notes)),
            **stacked,
        )
        if recording.position.shape[1:] != (LOG_STEPS, 3) or int(arrays["current_time_index"]) != CURRENT_STEP:
            raise ValueError(f"tracks must have {LOG_STEPS} steps and step {CURRENT_STEP} as the current one")
        if notes:
            raise ValueError("; ".join(notes))
        return recording.to_scene(name).validate(name)
    except SceneError:  # names the file itself
        raise
    except (KeyError, IndexError, TypeError) as error:
        raise ValueError(f"{name} is no scenario of arrays: {error}; write it again.") from error
    except ValueError as error:
        raise ValueError(f"{name} is no scenario of arrays: {error}.") from None


def _polylines(arrays: dict[str, np.ndarray], feature: str, notes: Notes) -> Iterator[Polyline]:
    points, ptr, types = arrays[f"{feature}_xyz"], arrays[f"{feature}_ptr"], arrays.get(f"{feature}_type")
    limits = arrays.get(f"{feature}_speed_limit_mph", np.zeros(len(ptr) - 1)) * METRES_PER_SECOND_PER_MPH
    for row, feature_id in enumerate(arrays[f"{feature}_id"].tolist()):
        kind = KIND_OF_FEATURE[feature] if types is None else map_kind(feature, int(types[row]), notes)
        yield Polyline(feature_id, kind, points[ptr[row] : ptr[row + 1]], float(limits[row]))


def _lights(arrays: dict[str, np.ndarray], notes: Notes) -> Iterator[LightListing]:
    ptr = arrays["tl_ptr"]
    for step in range(len(ptr) - 1):
        for row in range(ptr[step], ptr[step + 1]):
            stop = tuple(arrays["tl_stop_point"][row].tolist())
            state = light_state(int(arrays["tl_state"][row]), notes)
            yield LightListing(step, int(arrays["tl_lane_id"][row]), state, stop)
