"""Making the shards of one task of a plan, from where an earlier process left off."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from typing import Any

from envs.convert.plan import Piece, Task
from envs.scene import Scene, SceneError
from envs.shards import ShardWriter, read_record
from envs.sources import SOURCES, Notes, Record, Source


def make_shards(task: Task, tick: Callable[[int], Any]) -> None:
    """Make the shards of a task that are not there yet, in one pass over its inputs.

    At most one shard of packed scenes, and one scene beside it, are in memory.

    Args:
        task: what to make.
        tick: called with 1 after each record.
    """
    done = [read_record(path) for path in task.paths()]
    if done and done[-1].last:
        return
    part, writer = len(done), ShardWriter()
    for record in islice(_records(task), sum(record.num_records for record in done), None):
        if writer.record.num_records == task.shard_size:
            writer.write(task.path(part), last=False)
            part, writer = part + 1, ShardWriter()
        _make(record, writer, skip_bad=task.skip_bad)
        tick(1)
    writer.write(task.path(part))


def _records(task: Task) -> Iterator[Record]:
    for piece in task.pieces:
        yield from _readable(SOURCES[task.source], piece)


def _readable(source: Source, piece: Piece) -> Iterator[Record]:
    """The records of a piece; where the rest cannot be read, one more that says so when it is made."""
    index = 0
    try:
        for record in source.records(piece.input):
            index = record.index + 1
            if piece.stop is not None and record.index >= piece.stop:
                return
            if record.index >= piece.start:
                yield record
    except SceneError as error:
        yield Record(piece.input, index, partial(_fail, error))


def _fail(error: SceneError, _: Notes) -> Scene:
    raise error


def _make(record: Record, writer: ShardWriter, *, skip_bad: bool) -> None:
    unit = (record.input, record.index)
    notes: Notes = Notes()
    try:
        writer.add(record.scene(notes), unit)
    except SceneError as error:
        if not skip_bad:
            raise
        writer.skip(unit, error)
    except Exception as error:
        error.add_note(f"while converting {record.name}")
        raise
    writer.notes.update(notes)
