"""One shard of a :class:`~envs.store.SceneStore`: a file of packed scenes behind each other, and a record of them.

    magic | scene | scene | ... | record (JSON, packed) | length of the record | magic

A scene is one block of :mod:`envs.codec` and is read alone, by one seek. The record at the end says where each one lies
and what was learnt while it was made, so that a store can be searched and described without unpacking a scene.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections import Counter
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any, TypeVar

import zstandard

from envs.card import Card
from envs.codec import LEVEL, MAX_BYTES, decode, encode
from envs.scene import Scene, SceneError

Content = TypeVar("Content")

FORMAT_VERSION = 2
"""Of the files in a store; a store of another version must be converted again."""
SUFFIX = ".scenes"
"""Of a shard's file."""
PARTIAL_PREFIX = ".partial-"
"""Files that are being written; left over only by a process that was killed."""

_MAGIC = b"SCENES\x00" + bytes([FORMAT_VERSION])
_FOOTER = struct.Struct(f"<Q{len(_MAGIC)}s")


@dataclass
class ShardRecord:
    """What a shard holds.

    Attributes:
        scene_ids: in order.
        units: where each scene came from, ``(input, record)``.
        sizes: bytes of each scene's block.
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
        content = json.dumps({"version": FORMAT_VERSION, **asdict(self.record)}).encode()
        packed = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compress(content)
        write_bytes(path, b"".join([_MAGIC, *self._blocks, packed, _FOOTER.pack(len(packed), _MAGIC)]))
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
        return list(accumulate(self.record.sizes, initial=len(_MAGIC)))

    def scene(self, row: int) -> Scene:
        """One scene, as a copy of its own.

        Raises:
            SceneError: it is damaged.
        """
        try:
            with self.path.open("rb") as file:
                file.seek(self._offsets[row])
                block = file.read(self.record.sizes[row])
            return decode(block)
        except (OSError, SceneError) as error:
            name = f"{self.path}, scene {row} ({self.record.scene_ids[row]})"
            raise SceneError(f"{name}: {error} Convert the scenes again.") from error


def read_record(path: Path) -> ShardRecord:
    """The record of a shard.

    Raises:
        SceneError: there is none, it is damaged or of another version.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(0, size - _FOOTER.size))
            footer = file.read(_FOOTER.size)
            length, magic = _FOOTER.unpack(footer) if len(footer) == _FOOTER.size else (0, b"")
            if magic != _MAGIC or not 0 < length <= size - _FOOTER.size:
                raise SceneError(f"{path}: no shard of version {FORMAT_VERSION}, or a cut one; convert again.")
            file.seek(size - _FOOTER.size - length)
            content = json.loads(_unpacked(file.read(length)))
        if content.pop("version") != FORMAT_VERSION:
            raise SceneError(f"{path}: of another version than {FORMAT_VERSION}; convert the scenes again.")
        content["units"] = [(name, record) for name, record in content["units"]]
        return ShardRecord(**content)
    except FileNotFoundError as error:
        raise SceneError(f"{path}: the file is missing; convert the scenes again.") from error
    except SceneError:
        raise
    except (OSError, KeyError, TypeError, ValueError, zstandard.ZstdError) as error:
        raise SceneError(f"{path}: damaged ({error}); convert the scenes again.") from error


def _unpacked(packed: bytes) -> bytes:
    if not 0 <= zstandard.frame_content_size(packed) <= MAX_BYTES:
        raise ValueError("a record of that size is none of ours")
    return zstandard.ZstdDecompressor().decompress(packed)


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


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that readers see the old one or the new one, never a part, whatever ends the process."""
    partial = path.with_name(f"{PARTIAL_PREFIX}{path.name}-{os.getpid()}")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> None:
    """Write JSON like :func:`write_bytes`."""
    write_bytes(path, (json.dumps(content) + "\n").encode())


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
