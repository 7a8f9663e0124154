"""One shard of a :class:`~envs.store.SceneStore`: a file of packed scenes behind each other, and a record of them.

A scene is one block of :mod:`envs.codec` in the frame of :mod:`envs.framing`, read alone. The record at the end says
where each one lies and what was learnt while it was made, so that a store can be searched and described without
unpacking a scene.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from envs.card import Card
from envs.codec import checksum, decode, encode
from envs.files import write_bytes
from envs.framing import Framing
from envs.scene import Scene, SceneError
from envs.sources.fields import one_line, shown
from envs.validation import check_scene_id

Content = TypeVar("Content")

FORMAT_VERSION = 3
"""Of the files in a store; a store of another version must be converted again."""
SUFFIX = ".scenes"
"""Of a shard's file."""

MAX_JSON = 1 << 27
"""Bytes of a manifest; one that lists a hundred thousand bad inputs has about 2^25."""

_SKIPPED = [{"input": str, "record": int, "error": str}]
_RECORD_SHAPE = {
    "scene_ids": [str],
    "units": [(str, int)],
    "sizes": [int],
    "checksums": [int],
    "num_agents": [int],
    "has_lights": [bool],
    "lacks": [int],
    "skipped": _SKIPPED,
    "notes": {str: int},
    "card": {str: {str: int}},
    "last": bool,
}
"""Of the fields of :class:`ShardRecord`, see :func:`check_shape`."""
_FRAMING = Framing("shard", b"SCENES\x00" + bytes([FORMAT_VERSION]))


@dataclass
class ShardRecord:
    """What a shard holds.

    Attributes:
        scene_ids: in order.
        units: where each scene came from, ``(input, record)``.
        sizes: bytes of each scene's block.
        checksums: of each scene's content, see :func:`~envs.codec.checksum`.
        num_agents: agents of each scene that are present at the current step.
        has_lights: whether each scene has a traffic light.
        lacks: flags of :class:`~envs.scene.Lacks` of each scene.
        skipped: records that gave no scene: ``input``, ``record`` and ``error``.
        notes: what readers could not take over -> how often.
        card: counts of the scenes' content, see :class:`~envs.card.Card`.
        last: no further shard comes of the same part of the inputs.
    """

    scene_ids: list[str] = field(default_factory=list)
    units: list[tuple[str, int]] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    checksums: list[int] = field(default_factory=list)
    num_agents: list[int] = field(default_factory=list)
    has_lights: list[bool] = field(default_factory=list)
    lacks: list[int] = field(default_factory=list)
    skipped: list[dict[str, Any]] = field(default_factory=list)
    notes: dict[str, int] = field(default_factory=dict)
    card: dict[str, dict[str, int]] = field(default_factory=dict)
    last: bool = True

    @property
    def num_records(self) -> int:
        """Records of the inputs that went into the shard, those that gave no scene too."""
        return len(self.units) + len(self.skipped)


class ShardWriter:
    """Gathers packed scenes and writes them as one shard: all of it appears at once, or nothing.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from envs.sources.synthetic import straight_road
        >>> with TemporaryDirectory() as parent:
        ...     writer = ShardWriter()
        ...     writer.add(straight_road(3), ("nowhere", 0))
        ...     record = writer.write(Path(parent, "00000.scenes"))
        ...     Shard(Path(parent, "00000.scenes")).scene(0).agents.position.shape
        torch.Size([3, 91, 3])
    """

    def __init__(self) -> None:
        self.record = ShardRecord()
        self.notes: Counter[str] = Counter()
        self._card = Card()
        self._blocks: list[bytes] = []

    def add(self, scene: Scene, unit: tuple[str, int]) -> None:
        """Add a scene.

        Args:
            scene: uncollated.
            unit: where it came from, ``(input, record)``.

        Raises:
            SceneError: the format would not give it back as it is.
        """
        block, record = encode(scene), self.record
        self._blocks.append(block)
        self._card.add(scene)
        record.scene_ids.append(scene.scene_id)
        record.units.append(unit)
        record.sizes.append(len(block))
        record.checksums.append(checksum(block))
        record.num_agents.append(int(scene.agents.present.sum()))
        record.has_lights.append(len(scene.lights.lane_id) > 0)
        record.lacks.append(int(scene.lacks))

    def skip(self, unit: tuple[str, int], error: SceneError) -> None:
        """Note a record that gave no scene."""
        self.record.skipped.append({"input": unit[0], "record": unit[1], "error": str(error)})

    def write(self, path: Path, *, last: bool = True) -> ShardRecord:
        """Write the shard; its folder must exist.

        Args:
            path: of the file.
            last: no further shard comes of the same part of the inputs.
        """
        self.record.notes, self.record.card = dict(sorted(self.notes.items())), self._card.counts
        self.record.last = last
        write_bytes(path, _FRAMING.pack(self._blocks, {"version": FORMAT_VERSION, **asdict(self.record)}))
        return self.record


class Shard:
    """Reads the scenes of one shard; nothing is kept open or in memory between two scenes.

    Args:
        path: of the file.

    Raises:
        SceneError: no shard, or a damaged one.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.record = read_record(path)

    @cached_property
    def _offsets(self) -> list[int]:
        return _FRAMING.offsets(self.record.sizes)

    def scene(self, row: int) -> Scene:
        """One scene, as a copy of its own.

        Raises:
            SceneError: it is damaged.
        """
        try:
            with self.path.open("rb") as file:
                file.seek(self._offsets[row])
                block = file.read(self.record.sizes[row])
            scene = decode(block)
            if scene.scene_id != self.record.scene_ids[row]:
                raise SceneError(f"it holds the scene {shown(scene.scene_id)} instead.")
            return scene
        except (OSError, SceneError) as error:
            name = f"{self.path}, scene {row} ({self.record.scene_ids[row]})"
            raise SceneError(f"{name}: {error} Remove the file, then convert the scenes again.") from error


def read_record(path: Path) -> ShardRecord:
    """The record of a shard.

    Raises:
        SceneError: there is none, it is damaged or of another version.
    """
    try:
        content, end = _FRAMING.read_record(path)
        content = dict(content)
        if content.pop("version") != FORMAT_VERSION:
            raise SceneError(f"{path}: of another version than {FORMAT_VERSION}; convert the scenes again.")
        record = ShardRecord(**content)
        _check_record(record, path, end)
        return record
    except FileNotFoundError as error:
        raise SceneError(f"{path}: the file is missing; convert the scenes again.") from error
    except SceneError:
        raise
    except (OSError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise SceneError(f"{path}: damaged ({one_line(error)}); convert the scenes again.") from error


def _check_record(record: ShardRecord, path: Path, end: int) -> None:
    """The record must fit itself and the blocks before it, which end at ``end``."""
    for name, shape in _RECORD_SHAPE.items():
        check_shape(getattr(record, name), shape, name)
    record.units = [(name, number) for name, number in record.units]
    for name in ("units", "sizes", "checksums", "num_agents", "has_lights", "lacks"):
        if len(getattr(record, name)) != len(record.scene_ids):
            raise ValueError(f"{name} has not one value for each of {len(record.scene_ids)} scenes")
    _FRAMING.check_sizes(record.sizes, end)
    for scene_id in record.scene_ids:
        check_scene_id(scene_id, str(path))


def check_shape(value: Any, shape: Any, name: str) -> None:
    """Compare decoded JSON with what it must be.

    Args:
        value: decoded.
        shape: a type (``int`` is a whole number that is not negative, ``object`` is anything), ``[shape]`` of a list,
            a tuple of the shapes of a list's items, ``{str: shape}`` of an object of any keys, or the shapes of an
            object's entries by their keys.
        name: of the value.

    Raises:
        ValueError: naming what is of another shape.

    Examples:
        >>> check_shape({"a": [1, -2]}, {str: [int]}, "counts")
        Traceback (most recent call last):
        ...
        ValueError: counts['a'][1] is -2, which it must not be
    """
    found = _misfit(value, shape)
    if found is not None:
        place, wrong = found
        raise ValueError(f"{name}{place} is {shown(wrong)}, which it must not be")


def _misfit(value: Any, shape: Any) -> tuple[str, Any] | None:
    """Where below a value and what is of another shape, if anything is."""
    if isinstance(shape, list):
        fits = isinstance(value, list)
        below = ((index, shape[0]) for index in range(len(value) if fits else 0))
    elif isinstance(shape, tuple):
        fits, below = isinstance(value, list) and len(value) == len(shape), enumerate(shape)
    elif isinstance(shape, dict) and str in shape:
        fits = isinstance(value, dict)
        below = ((key, shape[str]) for key in (value if fits else ()))
    elif isinstance(shape, dict):
        fits, below = isinstance(value, dict) and value.keys() == shape.keys(), shape.items()
    else:
        fits = type(value) is int and 0 <= value < 2**63 if shape is int else isinstance(value, shape)
        below = ()
    if not fits:
        return "", value
    for key, inner in below:
        if (found := _misfit(value[key], inner)) is not None:
            return f"[{shown(key)}]{found[0]}", found[1]
    return None


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


def read_versioned(path: Path, cls: type[Content], shape: dict[str, Any]) -> Content:
    """Read a JSON file of the store into its dataclass.

    Args:
        path: of the file.
        cls: what it holds.
        shape: of its fields, see :func:`check_shape`.

    Raises:
        SceneError: no such file, damaged, or of another version than :data:`FORMAT_VERSION`.
    """
    again = f"remove {path.parent} and convert the scenes again."
    try:
        if path.stat().st_size > MAX_JSON:
            raise SceneError(f"{path}: has more than {MAX_JSON} bytes; {again}")
        content = dict(json.loads(path.read_text(encoding="utf-8")))
        version = content.pop("version", None)
        if version != FORMAT_VERSION:
            raise SceneError(f"{path}: version {shown(version)} where {FORMAT_VERSION} is read; {again}")
        result = cls(**content)
        for name, inner in shape.items():
            check_shape(getattr(result, name), inner, name)
        return result
    except FileNotFoundError as error:
        raise SceneError(f"{path}: the file is missing; {again}") from error
    except SceneError:
        raise
    except (OSError, RecursionError, TypeError, ValueError) as error:
        raise SceneError(f"{path}: damaged ({one_line(error)}); {again}") from error
