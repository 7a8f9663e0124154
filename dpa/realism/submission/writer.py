"""Write a submission: scenario by scenario, resumable after a kill, the same bytes whatever came between.

While rollouts come in, they lie in one journal beside the archive, already in their final bytes (up to 5.4 MB for a
scene of 128 agents). :meth:`~SubmissionWriter.finish` cuts it into shards and packs them. So the number of shards and
the metadata may still change on the way, and the archive does not depend on the order in which the scenarios were made.
"""

from __future__ import annotations

import fcntl
import gzip
import hashlib
import io
import json
import os
import shutil
import tarfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Self

from google.protobuf.message import DecodeError
from torch import Tensor

from dpa.realism.submission import wire
from dpa.realism.submission.convert import encode_rollouts, present_ids
from dpa.realism.submission.messages import NUM_ROLLOUTS, CorruptError, ScenarioRollouts, SubmissionError
from dpa.realism.submission.metadata import Metadata
from envs.files import sync, whole, write_json
from envs.options import differences
from envs.progress import progress
from envs.scene import Scene

SHARD_SCENARIOS = 300
"""Scenarios of a shard if nothing else is asked for: 1.6 GB where each has 128 agents; 150 shards of the test split."""
COMPRESSION_LEVEL = 1
"""Of gzip. Coordinates hardly compress: higher levels gain nothing and take more than twice the time."""
MAX_SHARDS = 99_999
"""What five digits in a shard's name can count."""
SUFFIX = ".tar.gz"


class Record(NamedTuple):
    """Where a scenario lies in the journal [bytes]."""

    offset: int
    size: int


class SubmissionWriter:
    """Writes one ``.tar.gz``; with the same arguments again, it goes on where a kill left it.

    Args:
        path: of the archive; ends in ``.tar.gz``.
        metadata: of the submission.
        scene_ids: of all scenes to submit; a scene is named by its index here.
        decided_by: what the rollouts depend on, as plain JSON values: rollouts made otherwise are not mixed in.

    Keyword Args:
        num_shards: N; scenario ``index`` lies in shard ``index % N``. By default one for :data:`SHARD_SCENARIOS`
            scenarios.

    Attributes:
        path: of the archive.
        done: indices of the scenarios that are written.

    Raises:
        SubmissionError: a path or number that does not fit, scene ids that are empty or occur twice, another process
            writes here, or a journal or archive that was made from something else.

    Examples:
        >>> import tempfile, torch
        >>> from dpa.realism.submission.reader import SubmissionReader
        >>> from envs.sources.synthetic import straight_road
        >>> metadata = Metadata("me@example.org", "mine", False, False, False, "7M", True)
        >>> scene = straight_road(num_vehicles=2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "mine.tar.gz")
        ...     with SubmissionWriter(path, metadata, [scene.scene_id], {"seed": 0}) as writer:
        ...         writer.add(0, scene, torch.zeros(32, 2, 80, 4))
        ...         _ = writer.finish()
        ...     [message.scenario_id for message in SubmissionReader(path)]
        ['straight_road_2_None']
    """

    def __init__(
        self,
        path: str | Path,
        metadata: Metadata,
        scene_ids: Sequence[str],
        decided_by: Mapping[str, Any],
        *,
        num_shards: int | None = None,
    ) -> None:
        self.path = Path(path)
        self._metadata, self._scene_ids = metadata.to_bytes(), list(scene_ids)
        _check_ids(self._scene_ids)
        self._num_shards = _number_of_shards(num_shards, len(self._scene_ids))
        if not self.path.name.endswith(SUFFIX) or self.path.name == SUFFIX:
            raise SubmissionError(f"{self.path}: a submission is named *{SUFFIX}; give such a path.")
        digest = hashlib.sha256("\n".join(self._scene_ids).encode()).hexdigest()
        # Through JSON and back, so that it compares with what lies on disk.
        self._options = json.loads(json.dumps({"scenes": digest, "decided_by": dict(decided_by)}, sort_keys=True))
        self._card = {**self._options, "metadata": asdict(metadata), "num_shards": self._num_shards}
        self._card = json.loads(json.dumps(self._card))
        self._folder = self.path.with_name(f".{self.path.name}.journal")
        self._card_path = self.path.with_name(f"{self.path.name}.json")
        self._sizes = [len(self._metadata)] * self._num_shards
        self._records: dict[int, Record] = {}
        self._journal: BinaryIO | None = None
        self.finished = self._is_finished()
        if not self.finished:
            self._open_journal()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def done(self) -> frozenset[int]:
        """Indices of the scenarios that are written."""
        return frozenset(range(len(self._scene_ids)) if self.finished else self._records)

    def add(self, index: int, scene: Scene, poses: Tensor, controlled: Tensor | None = None) -> None:
        """Write the rollouts of a scene to disk; a scene that is there already is left as it is.

        Args:
            index: of the scene among ``scene_ids``.
            scene: uncollated.
            poses: ``[32, A, 80, 4]``, see :func:`~dpa.realism.submission.convert.encode_rollouts`.
            controlled: ``[A]`` bool, the agents that were simulated; all by default.

        Raises:
            SubmissionError: another scene than the index says, another number of rollouts, an agent that followed its
                log, a pose that cannot be written, or a shard that would grow to 2 GB.
        """
        if not 0 <= index < len(self._scene_ids) or self._scene_ids[index] != scene.scene_id:
            raise SubmissionError(f"{self.path}: scene {scene.scene_id!r} is not number {index} of this submission.")
        if index in self.done:
            return
        _check_rules(scene, poses, controlled)
        payload = encode_rollouts(scene, poses).SerializeToString(deterministic=True)
        record = wire.rollouts_head(len(payload)) + payload
        self._check_room(index, len(record))
        offset = self._journal.seek(0, os.SEEK_END)
        self._journal.write(record)
        self._journal.flush()
        os.fsync(self._journal.fileno())
        self._note(index, Record(offset, len(record)))

    def finish(self) -> Path:
        """Pack the shards; afterwards the archive is there, a ``.json`` beside it says what it is of.

        Returns:
            ``path``.

        Raises:
            SubmissionError: scenes are missing.
        """
        if self.finished:
            return self.path
        missing = [name for index, name in enumerate(self._scene_ids) if index not in self._records]
        if missing:
            raise SubmissionError(
                f"{self.path}: {len(missing)} of {len(self._scene_ids)} scenes have no rollouts yet, the first is "
                f"{missing[0]!r}; add them all."
            )
        with whole(self.path) as part, part.open("wb") as file:
            self._pack(file)
        write_json(self._card_path, self._card)
        self.finished = True
        self.close()
        shutil.rmtree(self._folder)
        return self.path

    def close(self) -> None:
        """Let go of the journal; what was added stays."""
        if self._journal is not None:
            self._journal.close()

    def _is_finished(self) -> bool:
        """The archive is there and ours; what is left of its journal goes."""
        if not self.path.exists():
            return False
        try:
            card = json.loads(self._card_path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            card = {}
        if card != self._card:
            # A kill between the archive and its card leaves the journal, from which both are made again.
            if not self._folder.exists():
                _check_same(self.path, card, self._card)
            return False
        shutil.rmtree(self._folder, ignore_errors=True)
        return True

    def _open_journal(self) -> None:
        """Find the scenarios of an earlier run, and drop what a kill cut short."""
        options = self._folder / "options.json"
        self._folder.mkdir(parents=True, exist_ok=True)
        self._journal = (self._folder / "rollouts").open("a+b")
        try:
            fcntl.flock(self._journal, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._journal.close()
            raise SubmissionError(f"{self.path}: another process is writing it; wait, or name another file.") from None
        try:
            if options.exists():
                _check_same(self._folder, json.loads(options.read_text(encoding="utf-8")), self._options)
            else:
                write_json(options, self._options)
                sync(self._folder)
            end = self._read_journal()
        except BaseException:
            self._journal.close()
            raise
        self._journal.truncate(end)
        self._journal.seek(end)

    def _read_journal(self) -> int:
        """Note the whole scenarios of the journal; returns the offset [bytes] behind the last of them."""
        size = self._journal.seek(0, os.SEEK_END)
        self._journal.seek(0)
        numbers = {name: index for index, name in enumerate(self._scene_ids)}
        end = 0
        try:
            for field in wire.walk(self._journal, size, str(self._folder)):
                message = ScenarioRollouts.FromString(field.body)
                index = numbers.get(message.scenario_id)
                if field.number != wire.ROLLOUTS_FIELD or index is None or len(message.joint_scenes) != NUM_ROLLOUTS:
                    break
                record = Record(end, len(field.head) + len(field.body))
                self._check_room(index, record.size)
                self._note(index, record)
                end += record.size
        except (CorruptError, DecodeError):
            pass  # Each scenario reaches the disk before the next is begun: only the last one can be damaged.
        return end

    def _check_room(self, index: int, size: int) -> None:
        shard = index % self._num_shards
        size += self._sizes[shard]
        if size >= wire.MAX_SHARD_BYTES:
            raise SubmissionError(
                f"{self.path}: {wire.shard_name(shard, self._num_shards)} would grow to {size} bytes with scene "
                f"{self._scene_ids[index]}; the limit is {wire.MAX_SHARD_BYTES}. Run it again with more than "
                f"{self._num_shards} shards: what is written is kept."
            )

    def _note(self, index: int, record: Record) -> None:
        self._sizes[index % self._num_shards] += record.size
        self._records[index] = record

    def _pack(self, file: BinaryIO) -> None:
        bar = progress(total=len(self._scene_ids), description="pack submission", unit="scene")
        with (
            bar,
            # No name and no time, in gzip as in tar: the bytes depend on the content alone.
            gzip.GzipFile("", "wb", COMPRESSION_LEVEL, file, mtime=0) as packed,
            tarfile.open(fileobj=packed, mode="w|", format=tarfile.USTAR_FORMAT) as archive,
        ):
            for shard in range(self._num_shards):
                member = tarfile.TarInfo(wire.shard_name(shard, self._num_shards))
                member.size = self._sizes[shard]
                archive.addfile(member, io.BufferedReader(_Pieces(self._shard(shard, bar))))

    def _shard(self, shard: int, bar: Any) -> Iterator[bytes]:
        """The bytes of a shard, piece by piece."""
        yield self._metadata
        for index in range(shard, len(self._scene_ids), self._num_shards):
            record = self._records[index]
            self._journal.seek(record.offset)
            yield self._journal.read(record.size)
            bar.update()


def plan_submission(
    path: str | Path, metadata: str | Path | None, num_rollouts: int, num_shards: int | None = None
) -> Callable[[Sequence[str], Mapping[str, Any]], SubmissionWriter]:
    """Check what is known before any rollout.

    Args:
        path: of the archive.
        metadata: YAML file, see :meth:`~dpa.realism.submission.metadata.Metadata.load`.
        num_rollouts: K, that will be made of each scene.
        num_shards: see :class:`SubmissionWriter`.

    Returns:
        What opens the writer, from the ids of the scenes and what decides their rollouts.

    Raises:
        SubmissionError: no metadata, or a number of rollouts that the challenge does not take.

    Examples:
        >>> plan_submission("mine.tar.gz", "metadata.yaml", num_rollouts=8)
        Traceback (most recent call last):
        ...
        dpa.realism.submission.messages.SubmissionError: mine.tar.gz: a submission holds 32 rollouts ..., got 8; ...
    """
    if num_rollouts != NUM_ROLLOUTS:
        raise SubmissionError(
            f"{path}: a submission holds {NUM_ROLLOUTS} rollouts of each scene, got {num_rollouts}; roll out "
            f"{NUM_ROLLOUTS}."
        )
    if metadata is None:
        raise SubmissionError(
            f"{path}: a submission needs metadata; name a YAML file with account_name and the others."
        )
    return partial(SubmissionWriter, path, Metadata.load(metadata), num_shards=num_shards)


class _Pieces(io.RawIOBase):
    """Byte strings behind each other, as a file to read."""

    def __init__(self, pieces: Iterator[bytes]) -> None:
        self._pieces, self._rest = pieces, memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        if not self._rest:
            self._rest = memoryview(next(self._pieces, b""))
        count = min(len(buffer), len(self._rest))
        buffer[:count], self._rest = self._rest[:count], self._rest[count:]
        return count


def _check_ids(scene_ids: list[str]) -> None:
    if not scene_ids or not all(scene_ids):
        raise SubmissionError(f"a submission needs scenes that have ids, got {scene_ids[:3]}.")
    seen: set[str] = set()
    for name in scene_ids:
        if name in seen:
            raise SubmissionError(f"scene {name!r} occurs twice; a submission holds each scenario once.")
        seen.add(name)


def _number_of_shards(asked: int | None, scenes: int) -> int:
    number = -(-scenes // SHARD_SCENARIOS) if asked is None else asked
    if not 1 <= number <= min(scenes, MAX_SHARDS):
        raise SubmissionError(f"the number of shards must be 1 to {min(scenes, MAX_SHARDS)} (scenes), got {number}.")
    return number


def _check_rules(scene: Scene, poses: Tensor, controlled: Tensor | None) -> None:
    if len(poses) != NUM_ROLLOUTS:
        raise SubmissionError(
            f"scene {scene.scene_id}: a submission holds {NUM_ROLLOUTS} rollouts of each scene, got {len(poses)}; "
            f"roll out {NUM_ROLLOUTS}."
        )
    if controlled is not None and not controlled.all():
        logged = [track for track, moved in zip(present_ids(scene), controlled.tolist(), strict=True) if not moved]
        raise SubmissionError(
            f"scene {scene.scene_id}: {len(logged)} agents followed their log (the first is track {logged[0]}); every "
            "agent must be simulated: use a policy with a larger max_controlled."
        )


def _check_same(where: Path, there: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    if differ := differences(there, here):
        raise SubmissionError(f"{where} was written with other options ({differ}); remove it, or name another file.")
