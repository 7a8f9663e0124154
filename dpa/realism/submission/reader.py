"""Read a submission of any size, one scenario at a time: a ``.tar.gz``, a folder of shards, or one shard."""

from __future__ import annotations

import gzip
import io
import os
import tarfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from google.protobuf.message import DecodeError

from dpa.realism.submission.messages import CorruptError, ScenarioRollouts, SubmissionError
from dpa.realism.submission.metadata import Metadata
from dpa.realism.submission.wire import ROLLOUTS_FIELD, SHARD_NAME, walk

_GZIP_MAGIC = b"\x1f\x8b"
_MAX_METADATA_BYTES = 1 << 20
"""Metadata are some lines of text; the bound keeps a damaged shard out of memory."""
_CHUNK = 1 << 20


@dataclass
class Entry:
    """A file of a submission, while it is read.

    Attributes:
        name: in the archive or folder.
        size: in bytes.
        file: its bytes, to be read before the next entry is asked for; None for a folder or a link.
        metadata: serialized top-level fields that are no rollouts; complete once :meth:`rollouts` has ended.
    """

    name: str
    size: int
    file: BinaryIO | None
    metadata: bytes = field(default=b"", repr=False)

    def rollouts(self) -> Iterator[Any]:
        """``ScenarioRollouts`` messages of a shard, in its order, one in memory at a time.

        Raises:
            CorruptError: the shard is damaged; messages before the damage have been given.
        """
        if self.file is None:
            raise CorruptError(f"{self.name}: is a folder or a link, not a shard; pack the shards by their bare names.")
        self.metadata = b""
        for number, head, body in walk(self.file, self.size, self.name):
            if number == ROLLOUTS_FIELD:
                yield _parse(body, self.name)
            elif len(self.metadata) + len(body) > _MAX_METADATA_BYTES:
                raise CorruptError(f"{self.name}: field {number} is too long for metadata; write the file again.")
            else:
                self.metadata += head + body


class SubmissionReader:
    """The scenarios of a submission, in the order of the files.

    Iterating needs memory for one scenario, whatever the size of a shard, and takes nothing beyond what is asked for.

    Args:
        path: a ``.tar.gz``, a folder of shards, or one shard.

    Raises:
        SubmissionError: there is nothing at the path; while reading, :class:`~dpa.realism.submission.CorruptError`
            names the file that is damaged or no shard.

    Examples:
        >>> import tempfile
        >>> from dpa.realism.submission.messages import SimAgentsChallengeSubmission
        >>> shard = SimAgentsChallengeSubmission(scenario_rollouts=[{"scenario_id": "a"}, {"scenario_id": "b"}])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "submission.binproto")
        ...     size = path.write_bytes(shard.SerializeToString())
        ...     [message.scenario_id for message in SubmissionReader(path)]
        ['a', 'b']
    """

    def __init__(self, path: str | Path) -> None:
        self.path = check_exists(path)

    def __iter__(self) -> Iterator[Any]:
        """``ScenarioRollouts`` messages; :func:`~dpa.realism.submission.decode_rollouts` turns them into poses."""
        with damage_told(self.path):
            for entry in self._shards():
                yield from entry.rollouts()

    def metadata(self) -> Metadata:
        """Metadata of the first shard, which is read to its end for them.

        Raises:
            SubmissionError: no shard, or metadata that the challenge refuses.
        """
        with damage_told(self.path):
            for entry in self._shards():
                for _ in entry.rollouts():
                    pass
                return Metadata.from_bytes(entry.metadata)
        raise CorruptError(f"{self.path}: no shard in there; give a submission.")

    def _shards(self) -> Iterator[Entry]:
        for entry in entries(self.path):
            if not SHARD_NAME.fullmatch(entry.name):
                raise CorruptError(
                    f"{self.path}: {entry.name!r} is no name of a shard; name them like "
                    "submission.binproto-00007-of-00150, in no folder, and pack nothing else."
                )
            yield entry


def check_exists(path: str | Path) -> Path:
    """The path, if there is a file or a folder that may be read.

    Raises:
        SubmissionError: there is none.
    """
    path = Path(path)
    if not os.access(path, os.R_OK):
        raise SubmissionError(
            f"{path} does not exist or may not be read; give a .tar.gz, a folder of shards, or one shard."
        )
    return path


def entries(path: Path) -> Iterator[Entry]:
    """Everything that lies in a submission, shard or not.

    Args:
        path: of an archive, a folder or a shard; anything that is no folder and not named like a shard must be a
            ``.tar.gz``.

    Raises:
        CorruptError: no packed archive, or one that ends before its time; see also :func:`damage_told`.
    """
    if path.is_dir():
        for inner in sorted(path.iterdir()):
            yield from _entry_of(inner)
    elif SHARD_NAME.fullmatch(path.name):
        yield from _entry_of(path)
    else:
        yield from _members(path)


@contextmanager
def damage_told(path: Path) -> Iterator[None]:
    """Turn what unpacking raises on a damaged archive into one error that names it."""
    try:
        yield
    except (EOFError, OSError, zlib.error, tarfile.TarError) as error:
        raise CorruptError(f"{path}: the archive cannot be unpacked ({error}); pack or fetch it again.") from error


def _entry_of(path: Path) -> Iterator[Entry]:
    if not path.is_file():
        yield Entry(f"{path.name}/", 0, None)
        return
    with path.open("rb") as file:
        yield Entry(path.name, path.stat().st_size, file)


def _members(path: Path) -> Iterator[Entry]:
    with path.open("rb") as file:
        packed = file.read(len(_GZIP_MAGIC)) == _GZIP_MAGIC
    if not packed or not path.name.endswith(".tar.gz"):
        fix = "name it *.tar.gz" if packed else "pack the shards with tar and gzip (tar -czf)"
        raise CorruptError(f"{path}: is no .tar.gz, the only form that the challenge takes; {fix}.")
    with gzip.open(path) as unpacked:
        counted = _Counted(unpacked)
        with tarfile.open(fileobj=counted, mode="r|", bufsize=_CHUNK) as archive:
            for member in archive:
                yield Entry(member.name, member.size, archive.extractfile(member) if member.isreg() else None)
            # To the end, where gzip compares its checksum. tarfile takes a broken header for the end of the archive.
            while counted.read(_CHUNK):
                pass
            if counted.last > archive.offset or counted.position < archive.offset + tarfile.BLOCKSIZE:
                raise CorruptError(f"{path}: the archive breaks off at byte {archive.offset}; pack or fetch it again.")


class _Counted(io.RawIOBase):
    """Reads on, and knows how far it is and where the last byte that is not zero ended."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.position, self.last = file, 0, 0

    def read(self, size: int = -1) -> bytes:
        chunk = self._file.read(size)
        kept = len(chunk.rstrip(b"\0"))
        if kept:
            self.last = self.position + kept
        self.position += len(chunk)
        return chunk


def _parse(body: bytes, name: str) -> Any:
    try:
        message = ScenarioRollouts.FromString(body)
    except DecodeError as error:
        raise CorruptError(f"{name}: a scenario in there cannot be read ({error}); write the file again.") from error
    # The parser hands out an id that is no text as bytes.
    if isinstance(message.scenario_id, bytes):
        raise CorruptError(f"{name}: the scenario id {message.scenario_id!r} is no text; write the file again.")
    return message
