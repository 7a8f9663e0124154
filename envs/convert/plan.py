"""What a conversion has to do, before any scene is read: which records of which inputs go into which shards."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from envs.scene import SceneError
from envs.shards import SUFFIX
from envs.sources import Source

BYTES_PER_SCENE = 1_000_000
"""Of a raw WOMD file; a first guess at the scenes of an input that only reading could count."""


class Input(NamedTuple):
    """One input.

    Attributes:
        name: the file, or what a generator is told.
        size: its bytes; a file of another size is another file.
    """

    name: str
    size: int


@dataclass(frozen=True)
class Piece:
    """Some consecutive records of one input.

    Attributes:
        input: the file, or what a generator is told.
        size: bytes of the whole input; a file of another size is another file.
        start: first record.
        stop: one after the last; None to the end of an input that only reading can count.
    """

    input: str
    size: int
    start: int
    stop: int | None


@dataclass(frozen=True)
class Task:
    """Work of one process at a time; small, so that it travels to a worker.

    Attributes:
        source: name of the source.
        number: place in the plan.
        pieces: their records in order: one shard of them, or as many as a piece without end needs.
        out: folder of the store.
        shard_size: most records of a shard.
        skip_bad: note records that give no scene instead of failing.
    """

    source: str
    number: int
    pieces: tuple[Piece, ...]
    out: Path = field(repr=False)
    shard_size: int
    skip_bad: bool

    @property
    def is_open(self) -> bool:
        """Whether only reading can tell how many shards it gives."""
        return self.pieces[-1].stop is None

    @property
    def num_expected(self) -> int:
        """Records, estimated where they cannot be counted."""
        if self.is_open:
            return max(1, self.pieces[0].size // BYTES_PER_SCENE)
        return sum(piece.stop - piece.start for piece in self.pieces)

    def path(self, part: int) -> Path:
        """Of one of its shards."""
        return self.out / (f"{self.number:05d}-{part:04d}{SUFFIX}" if self.is_open else f"{self.number:05d}{SUFFIX}")

    def paths(self) -> Iterator[Path]:
        """Of the shards that are there already, in order."""
        for part in range(10_000 if self.is_open else 1):
            if not self.path(part).exists():
                return
            yield self.path(part)


def find_inputs(source: Source, paths: Sequence[str]) -> list[Input]:
    """What the user named, one by one; nothing is read of it.

    Raises:
        SceneError: nothing there.
    """
    return [Input(name, source.size(name)) for name in source.find(paths)]


def make_plan(
    source: Source, inputs: Sequence[Input], out: Path, *, shard_size: int, limit: int | None, skip_bad: bool
) -> list[Task]:
    """Tasks in the order of the store; they depend on the inputs and options alone.

    Inputs whose scenes can be counted are cut into shards of equal size across their borders; any other one is a task
    of its own, to be read in one pass.

    Args:
        source: of the inputs.
        inputs: see :func:`find_inputs`.
        out: folder of the store.
        shard_size: most records of a shard.
        limit: take only so many records, the first ones (inputs that cannot be counted are then read to count them).
        skip_bad: note records that give no scene instead of failing.

    Raises:
        SceneError: no scenes, or an input that cannot be opened.
    """
    groups: list[list[Piece]] = []
    room, left = 0, limit
    for name, size in inputs:
        count = source.count(name)
        if left is not None:
            count = min(left, count) if count is not None else _count(source, name, left, skip_bad)
            left -= count
        if count is None:
            groups.append([Piece(name, size, 0, None)])
            room = 0
            continue
        for start, stop in _cuts(count, room, shard_size):
            if room == 0:
                groups.append([])
                room = shard_size
            groups[-1].append(Piece(name, size, start, stop))
            room -= stop - start
        if left == 0:
            break
    if not groups:
        named = ", ".join(name for name, _ in inputs[:5])
        raise SceneError(f"{named}: no scenes in there; give inputs of the source {source.name}.")
    return [Task(source.name, number, tuple(pieces), out, shard_size, skip_bad) for number, pieces in enumerate(groups)]


def _count(source: Source, name: str, most: int, skip_bad: bool) -> int:
    """Records of an input, up to some number; where the rest cannot be read it counts as one that is bad."""
    counted = 0
    try:
        for _ in islice(source.records(name), most):
            counted += 1
    except SceneError:
        if not skip_bad:
            raise
        counted += 1
    return counted


def _cuts(count: int, room: int, shard_size: int) -> Iterator[tuple[int, int]]:
    """Cut ``count`` records where shards end, the first of which has room for ``room`` more."""
    start = 0
    while start < count:
        stop = min(count, start + (room or shard_size))
        yield start, stop
        start, room = stop, 0


def digest(inputs: Sequence[Input]) -> str:
    """What makes the plan this one, beside the options: the inputs, their sizes and their order."""
    return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()
