"""One chunk of a preference store: a file of packed groups behind each other, and a record of them.

The file is named after its content: its name says whether all of it is as it was, and no two writers, on whatever
machines, can give one name to different chunks. A group is one block of :mod:`dpa.preferences.codec` in the frame of
:mod:`envs.framing`, and is read alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from dpa.preferences.codec import decode
from dpa.preferences.group import Group, group_shapes
from dpa.preferences.provenance import FORMAT, Provenance, StoreError
from envs.framing import Framing
from envs.shards import check_shape
from envs.sources.fields import one_line

PREFIX, SUFFIX = "chunk-", ".groups"
MENDING = "delete it and collect again: the scenes that it held are done anew"

_SHAPE = {"scenes": [int], "num_agents": [int], "sizes": [int], "num_features": int, "origin": str}
_FRAMING = Framing("chunk", b"GROUPS\x00" + bytes([FORMAT]))


@dataclass(frozen=True)
class ChunkRecord:
    """What a chunk holds.

    Attributes:
        scenes: of each group.
        num_agents: of each group.
        sizes: bytes of each group's block.
        num_features: D of all groups.
        origin: :attr:`~dpa.preferences.provenance.Provenance.digest` of the store.
    """

    scenes: list[int]
    num_agents: list[int]
    sizes: list[int]
    num_features: int
    origin: str

    @cached_property
    def offsets(self) -> list[int]:
        """Where each group's block begins."""
        return _FRAMING.offsets(self.sizes)


class PackedGroup(NamedTuple):
    """A group that waits to be written."""

    scene: int
    num_agents: int
    num_features: int
    block: bytes


def chunk_content(groups: Sequence[PackedGroup], origin: Provenance) -> bytes:
    """All bytes of a chunk.

    Args:
        groups: at least one, all with the same number of features.
        origin: of the store.
    """
    record = ChunkRecord(
        scenes=[group.scene for group in groups],
        num_agents=[group.num_agents for group in groups],
        sizes=[len(group.block) for group in groups],
        num_features=groups[0].num_features,
        origin=origin.digest,
    )
    return _FRAMING.pack([group.block for group in groups], asdict(record))


def chunk_name(content: bytes) -> str:
    """The name of a chunk's file."""
    return f"{PREFIX}{hashlib.sha256(content).hexdigest()[:32]}{SUFFIX}"


def chunk_files(folder: Path) -> list[Path]:
    """The chunks of a store, by name."""
    return sorted(path for path in folder.iterdir() if path.name.startswith(PREFIX))


def read_record(path: Path, origin: Provenance) -> ChunkRecord:
    """The record of a chunk.

    Args:
        path: of the file.
        origin: of the store that it lies in.

    Raises:
        StoreError: there is none, it is damaged, of another version, or of another store.
    """
    try:
        content, end = _FRAMING.read_record(path)
        check_shape(content, _SHAPE, "its record")
        record = ChunkRecord(**content)
        _check_record(record, end)
    except (OSError, RecursionError, ValueError) as error:
        raise StoreError(f"{path} is damaged ({one_line(error)}); {MENDING}.") from None
    if record.origin != origin.digest:
        raise StoreError(f"{path} belongs to another store; move it out of this one.")
    return record


def read_group(path: Path, record: ChunkRecord, row: int, origin: Provenance) -> Group:
    """One group of a chunk; only its own block is read.

    Args:
        path: of the chunk.
        record: of the chunk.
        row: of the group in it.
        origin: of the store.

    Raises:
        StoreError: it is damaged.
    """
    scene = record.scenes[row]
    try:
        with path.open("rb") as file:
            file.seek(record.offsets[row])
            group = decode(file.read(record.sizes[row]), origin.layout)
        sizes = (record.num_agents[row], origin.num_rollouts, origin.horizon, record.num_features)
        shapes = group_shapes(*sizes, origin.layout.shape)
        wanted = (scene, shapes["tokens"], record.num_features)
        found = (group.scene, group.tokens.shape, group.feature_share.shape[-1])
        if found != wanted:
            raise StoreError(f"scene, shape of tokens and features are {found} where {wanted} were noted")
    except (OSError, StoreError) as error:
        raise StoreError(f"{path}, scene {scene} is damaged ({one_line(error)}); {MENDING}.") from None
    return group


def intact(path: Path) -> bool:
    """Whether every byte of a chunk is as it was written."""
    return chunk_name(path.read_bytes()) == path.name


def _check_record(record: ChunkRecord, end: int) -> None:
    """The record must fit itself and the blocks before it, which end at ``end``."""
    if not len(record.scenes) == len(record.num_agents) == len(record.sizes) > 0:
        raise ValueError("its record has not one size and number of agents for each scene")
    _FRAMING.check_sizes(record.sizes, end)
