"""One shard of a :class:`~envs.store.SceneStore`: a folder of flat, memory-mapped arrays, and a record of them.

Scenes are ragged, so a shard holds one array for each field with the rows of all its scenes behind each other, and the
number of rows that each scene has. Arrays are written by tensordict (``TensorDict.load_memmap`` opens a shard for
inspection) and take the least room that loses nothing: whole numbers in the narrowest type that holds the shard's
values, states of agents only where they are valid (they are zero elsewhere).
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import torch
from tensordict import TensorDict
from torch import Tensor

from envs.scene import Agents, Lights, RoadMap, Scene, SceneError

Content = TypeVar("Content")

FORMAT_VERSION = 1
"""Of the files in a store; a store of another version must be converted again."""
RECORD_FILE = "shard.json"
"""In the folder of a shard: its :class:`ShardRecord`."""
PARTIAL_PREFIX = ".partial-"
"""Folders and files that are being written; left over only by a process that was killed."""

_PARTS = {"agents": Agents, "road": RoadMap, "lights": Lights}
_AT_VALID_STATES = ("agents.heading", "agents.position", "agents.velocity")
_ROWS = {
    "agents": ["agents.valid", "agents.extent", "agents.kind", "agents.track_id", "agents.predict", "agents.sdc"],
    "states": list(_AT_VALID_STATES),
    "points": ["road.points"],
    "polylines": ["road.start", "road.count", "road.kind", "road.feature_id", "road.speed_limit"],
    "links": ["road.links"],
    "lights": ["lights.lane_id", "lights.state", "lights.stop_point"],
    "scenes": ["origin"],
}
"""What one row of an array is -> the arrays of such rows."""
_NAMES = [name for names in _ROWS.values() for name in names]
_INTEGERS = (torch.int8, torch.int16, torch.int32, torch.int64)
_MEMORY_TYPES = (torch.float32, torch.float64, torch.int64, torch.bool)


@dataclass(frozen=True)
class ShardRecord:
    """What a shard holds; ``shard.json`` in its folder.

    Attributes:
        scene_ids: in order.
        units: where each scene came from, ``(input, record)``.
        num_agents: agents of each scene that are present at the current step.
        counts: table name -> rows of each scene in the arrays of that table.
        arrays: array name -> ``dtype``, ``shape`` and ``sha256`` of its file.
        skipped: inputs that gave no scene: ``input``, ``record`` and ``error``.
    """

    scene_ids: list[str]
    units: list[tuple[str, int]]
    num_agents: list[int]
    counts: dict[str, list[int]]
    arrays: dict[str, dict[str, Any]]
    skipped: list[dict[str, Any]] = field(default_factory=list)


def write_shard(
    folder: Path,
    scenes: Sequence[Scene],
    units: Sequence[tuple[str, int]],
    skipped: Sequence[dict[str, Any]] = (),
) -> ShardRecord:
    """Write scenes to a new shard: all of it appears at once, or nothing.

    Args:
        folder: the shard's folder; it must not exist, its parent must.
        scenes: uncollated scenes.
        units: where each came from, ``(input, record)``.
        skipped: what to note of inputs that gave no scene.

    Raises:
        SceneError: a scene that the format would not give back as it is.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from envs.sources.synthetic import straight_road
        >>> with TemporaryDirectory() as parent:
        ...     folder = Path(parent, "shard")
        ...     record = write_shard(folder, [straight_road(3)], [("nowhere", 0)])
        ...     Shard(folder, read_record(folder)).scene(0).agents.position.shape
        torch.Size([3, 91, 3])
    """
    pieces = [_flatten(scene) for scene in scenes]
    arrays = {name: _narrow(torch.cat([piece[name] for piece in pieces])) for name in _NAMES if pieces}
    partial = folder.with_name(f"{PARTIAL_PREFIX}{folder.name}-{os.getpid()}")
    try:
        TensorDict.from_dict(arrays, batch_size=[]).unflatten_keys(".").memmap(partial)
        record = ShardRecord(
            scene_ids=[scene.scene_id for scene in scenes],
            units=list(units),
            num_agents=[int(scene.agents.present.sum()) for scene in scenes],
            counts={rows: [len(piece[names[0]]) for piece in pieces] for rows, names in _ROWS.items()},
            arrays={name: _describe(partial, name, values) for name, values in arrays.items()},
            skipped=list(skipped),
        )
        write_json(partial / RECORD_FILE, {"version": FORMAT_VERSION, **asdict(record)})
        os.replace(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return record


def read_record(folder: Path) -> ShardRecord:
    """The record of a shard.

    Raises:
        SceneError: there is none, or it is of another version.
    """
    return read_versioned(folder / RECORD_FILE, ShardRecord)


class Shard:
    """Reads the scenes of one shard.

    The arrays are private, read-only mappings: whatever happens to a tensor in memory, the file stays as it is.

    Args:
        folder: the shard's folder.
        record: what it holds.
    """

    def __init__(self, folder: Path, record: ShardRecord) -> None:
        self.folder = folder
        self.record = record

    @cached_property
    def _arrays(self) -> TensorDict:
        arrays = {name: _map(self.folder, name, entry) for name, entry in self.record.arrays.items()}
        return TensorDict(arrays, batch_size=[]).lock_()

    @cached_property
    def _tables(self) -> list[tuple[list[int], list[tuple[str, Tensor]]]]:
        """For each kind of row: where each scene's rows start, and the arrays of such rows."""
        tables = []
        for rows, names in _ROWS.items():
            offsets = [0, *torch.tensor(self.record.counts[rows], dtype=torch.int64).cumsum(0).tolist()]
            if any(len(self._arrays[name]) != offsets[-1] for name in names):
                raise SceneError(f"{self.folder}: the {rows} do not add up to the arrays; convert the scenes again.")
            tables.append((offsets, [(name, self._arrays[name]) for name in names]))
        return tables

    def scene(self, row: int) -> Scene:
        """A fresh copy of one scene."""
        piece = {
            name: _widen(values[offsets[row] : offsets[row + 1]])
            for offsets, arrays in self._tables
            for name, values in arrays
        }
        return _unflatten(piece, self.record.scene_ids[row])

    def verify(self) -> None:
        """Compare every array with its checksum.

        Raises:
            SceneError: naming the first file that differs.
        """
        for name, entry in self.record.arrays.items():
            path = _array_path(self.folder, name)
            if file_digest(path) != entry["sha256"]:
                raise SceneError(f"{path}: the content does not fit its checksum; convert the scenes again.")


def _flatten(scene: Scene) -> dict[str, Tensor]:
    """Scene -> array name -> rows."""
    valid = scene.agents.valid
    piece = {"origin": scene.origin[None]}
    for part, cls in _PARTS.items():
        for name in cls.__dataclass_fields__:
            piece[f"{part}.{name}"] = getattr(getattr(scene, part), name)
    for name in _AT_VALID_STATES:
        if piece[name][~valid].any():
            raise SceneError(f"scene {scene.scene_id}: {name} is not zero at an invalid step; set it to zero there.")
        piece[name] = piece[name][valid]
    for name, values in piece.items():
        if values.dtype not in _MEMORY_TYPES:
            raise SceneError(f"scene {scene.scene_id}: {name} is {values.dtype}; see envs.scene for its type.")
    return piece


def _unflatten(piece: dict[str, Tensor], scene_id: str) -> Scene:
    """Inverse of :func:`_flatten`."""
    valid = piece["agents.valid"]
    rows = valid.flatten().nonzero().squeeze(1)
    for name in _AT_VALID_STATES:
        states = piece[name]
        filled = states.new_zeros(valid.numel(), *states.shape[1:]).index_copy_(0, rows, states)
        piece[name] = filled.view(valid.shape + states.shape[1:])
    parts = {
        part: cls(**{name: piece[f"{part}.{name}"] for name in cls.__dataclass_fields__}, batch_size=[])
        for part, cls in _PARTS.items()
    }
    return Scene(**parts, origin=piece["origin"][0], scene_id=scene_id, batch_size=[])


def _narrow(values: Tensor) -> Tensor:
    """Whole numbers in the narrowest type that holds them; anything else as it is."""
    if values.dtype != torch.int64:
        return values
    low, high = (int(values.min()), int(values.max())) if values.numel() else (0, 0)
    for dtype in _INTEGERS:
        if torch.iinfo(dtype).min <= low and high <= torch.iinfo(dtype).max:
            return values.to(dtype)
    raise AssertionError("int64 holds every int64")


def _widen(values: Tensor) -> Tensor:
    """A copy in the type that scenes have in memory."""
    return values.to(torch.int64, copy=True) if values.dtype in _INTEGERS else values.clone()


def _array_path(folder: Path, name: str) -> Path:
    return folder / (name.replace(".", "/") + ".memmap")


def _describe(folder: Path, name: str, values: Tensor) -> dict[str, Any]:
    path = _array_path(folder, name)
    path.touch()  # tensordict writes no file for an empty array
    return {
        "dtype": str(values.dtype).removeprefix("torch."),
        "shape": list(values.shape),
        "sha256": file_digest(path),
    }


def _map(folder: Path, name: str, entry: dict[str, Any]) -> Tensor:
    """Map one array; not through ``TensorDict.load_memmap``, whose mappings are shared with the file."""
    path, dtype, shape = _array_path(folder, name), getattr(torch, entry["dtype"]), torch.Size(entry["shape"])
    expected = shape.numel() * dtype.itemsize
    if not path.is_file():
        raise SceneError(f"{path}: the file is missing; convert the scenes again.")
    if (size := path.stat().st_size) != expected:
        raise SceneError(f"{path}: {size} bytes where {expected} are needed; convert the scenes again.")
    if not expected:
        return torch.empty(shape, dtype=dtype)
    return torch.from_file(str(path), shared=False, size=shape.numel(), dtype=dtype).view(shape)


def file_digest(path: Path) -> str:
    """SHA-256 of a file.

    Raises:
        SceneError: there is no such file.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError as error:
        raise SceneError(f"{path}: the file is missing; convert the scenes again.") from error


def write_json(path: Path, content: Any) -> None:
    """Write JSON so that readers see the old file or the new one, never a part."""
    partial = path.with_name(PARTIAL_PREFIX + path.name)
    partial.write_text(json.dumps(content) + "\n", encoding="utf-8")
    os.replace(partial, path)


def read_versioned(path: Path, cls: type[Content]) -> Content:
    """Read a JSON file of the store into its dataclass.

    Raises:
        SceneError: no such file, damaged, or of another version than :data:`FORMAT_VERSION`.
    """
    try:
        content = dict(json.loads(path.read_text(encoding="utf-8")))
        version = content.pop("version", None)
        if version != FORMAT_VERSION:
            raise SceneError(f"{path}: version {version} where {FORMAT_VERSION} is read; convert the scenes again.")
        return cls(**content)
    except FileNotFoundError as error:
        raise SceneError(f"{path}: the file is missing; convert the scenes again.") from error
    except SceneError:
        raise
    except (TypeError, ValueError) as error:
        raise SceneError(f"{path}: damaged ({error}); convert the scenes again.") from error
