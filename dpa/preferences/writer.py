"""Writing a preference store: chunk by chunk, atomically, from any number of processes and machines."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO
from uuid import uuid4

import numpy as np
from tensordict import TensorDictBase

from dpa.preferences.chunk import PREFIX, PackedGroup, chunk_content, chunk_files, chunk_name, read_record
from dpa.preferences.codec import encode
from dpa.preferences.group import Group, take_groups
from dpa.preferences.provenance import METADATA_FILE, Provenance, StoreError
from envs.files import PARTIAL_PREFIX, sync

LOCK_SECONDS = 300.0
"""A chunk is written in far less than a second; who holds the lock for longer has lost its file system."""
LOCK_FILE = ".lock"


class PreferenceWriter:
    """Appends ranked groups to a store, together with whoever else does.

    Groups wait in memory, packed, until ``chunk_scenes`` of them make a chunk; :meth:`close`, or the end of a ``with``
    block, writes the rest. A chunk is written aside, synchronised and renamed, so a process that is killed loses at
    most what waits. To resume, open the folder again with the same provenance and leave out :attr:`scenes_done`.

    Any number of writers may append at the same time, also from several machines on a file system that they share and
    that knows locks (``flock``). Only while a chunk is written does its writer hold the folder's lock; it then looks
    which scenes have come in the meantime. **A scene is stored once, and the first wins**: a group follows from scene,
    policy, options and seed, so a second one says the same.

    Args:
        folder: of the store; made if missing.
        provenance: what the groups come from.
        chunk_scenes: scenes of one chunk.

    Raises:
        StoreError: the folder holds groups of another origin, or is not a store and not empty.

    Examples:
        >>> import tempfile
        >>> from dpa.preferences.examples import example_groups, example_provenance
        >>> folder = tempfile.mkdtemp()
        >>> with PreferenceWriter(folder, example_provenance()) as writer:
        ...     writer.append(example_groups(num_scenes=3))
        3
        >>> with PreferenceWriter(folder, example_provenance()) as writer:
        ...     sorted(writer.scenes_done)
        [0, 1, 2]
    """

    def __init__(self, folder: str | Path, provenance: Provenance, chunk_scenes: int = 64) -> None:
        if chunk_scenes < 1:
            raise ValueError(f"chunk_scenes must be 1 or more, got {chunk_scenes}.")
        if not 0 <= provenance.vocab_size <= np.iinfo(np.int16).max + 1:
            raise ValueError(f"a vocabulary of {provenance.vocab_size} tokens does not fit the 16 bits of a store.")
        self.folder, self.provenance, self.chunk_scenes = Path(folder), provenance, chunk_scenes
        self._waiting: dict[int, PackedGroup] = {}
        self._stored: set[int] = set()
        self._seen: set[str] = set()
        self._num_features: int | None = None
        self.folder.mkdir(parents=True, exist_ok=True)
        self._check_folder()
        with _locked(self.folder), _new_file(self.folder) as file:
            if not (self.folder / METADATA_FILE).exists():
                _put(file, self.provenance.to_json().encode(), self.folder / METADATA_FILE)
            found = Provenance.from_folder(self.folder)
            found.check_same(self.provenance, self.folder)
            self.provenance = found  # 1 and 1.0 are the same to the check, and not to the digest in every chunk
            self._look()

    def _check_folder(self) -> None:
        ours = (METADATA_FILE, PREFIX, LOCK_FILE, PARTIAL_PREFIX)
        strange = sorted(path.name for path in self.folder.iterdir() if not path.name.startswith(ours))
        if strange and not (self.folder / METADATA_FILE).exists():
            raise StoreError(f"{self.folder} is no preference store and holds {strange[:3]}; name an empty folder.")

    @property
    def scenes_done(self) -> frozenset[int]:
        """Scenes whose groups are on disk for good, as of the last look: when opened, and at every chunk written."""
        return frozenset(self._stored)

    def append(self, groups: TensorDictBase) -> int:
        """Take groups, batch size ``[S]``, as :class:`~dpa.ranking.transform.RankRollouts` gives them.

        Returns:
            how many were taken; those of scenes that are there or wait already are left out.

        Raises:
            StoreError: a value does not fit the store; nothing of ``groups`` is taken.
        """
        new: dict[int, PackedGroup] = {}
        for group in self._checked(groups):
            if not any(group.scene in known for known in (self._stored, self._waiting, new)):
                new[group.scene] = PackedGroup(
                    group.scene,
                    len(group.tokens),
                    group.feature_share.shape[-1],
                    encode(group, self.provenance.layout),
                )
        self._waiting |= new
        while len(self._waiting) >= self.chunk_scenes:
            self._flush()
        return len(new)

    def close(self) -> None:
        """Write what waits."""
        while self._waiting:
            self._flush()

    def __enter__(self) -> PreferenceWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()

    def _checked(self, groups: TensorDictBase) -> list[Group]:
        try:
            taken = take_groups(groups, self.provenance)
        except StoreError as error:
            raise StoreError(f"{self.folder}: {error}") from None
        if taken:
            self._same_features(taken[0].feature_share.shape[-1])
        return taken

    def _same_features(self, number: int) -> None:
        """All groups of a store have as many feature shares: of every feature that the distance weighs, or none."""
        known = {0, len(self.provenance.features)} if self._num_features is None else {self._num_features}
        if number not in known:
            raise StoreError(
                f"{self.folder}: groups with shares of {number} features where {sorted(known)} are kept; rank with the "
                "options of this store, or name a new folder."
            )
        self._num_features = number

    def _look(self) -> None:
        """See what all writers have stored."""
        for path in chunk_files(self.folder):
            if path.name not in self._seen:
                record = read_record(path, self.provenance)
                self._same_features(record.num_features)
                self._stored |= set(record.scenes)
                self._seen.add(path.name)

    def _flush(self) -> None:
        """Write the groups that have waited longest as one chunk, but for those that another writer has stored."""
        waited = list(self._waiting.values())[: self.chunk_scenes]
        # The new file comes before the look: making one lets a network file system see what other machines have made.
        with _locked(self.folder), _new_file(self.folder) as file:
            self._look()
            new = [group for group in waited if group.scene not in self._stored]
            if new:
                content = chunk_content(new, self.provenance)
                _put(file, content, self.folder / chunk_name(content))
        self._stored |= {group.scene for group in new}
        for group in waited:
            del self._waiting[group.scene]


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a store alone; the system lets go when the process ends, however it ends."""
    with (folder / LOCK_FILE).open("a") as lock:
        _acquire(lock, folder)
        for leftover in folder.glob(f"{PARTIAL_PREFIX}*"):  # of a writer that was killed: living ones hold the lock
            leftover.unlink(missing_ok=True)
        yield


def _acquire(lock: IO[str], folder: Path) -> None:
    end = time.monotonic() + LOCK_SECONDS
    while True:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() > end:
                raise StoreError(
                    f"{folder / LOCK_FILE} was held by another writer for {LOCK_SECONDS:g} s; end the writer that "
                    "hangs, then run the same command again."
                ) from None
        except OSError as error:
            raise StoreError(
                f"{folder} cannot be locked ({error.strerror}); write to a file system that knows flock."
            ) from None
        time.sleep(0.005)


@contextmanager
def _new_file(folder: Path) -> Iterator[IO[bytes]]:
    """A file that is gone afterwards, unless it was put in place."""
    path = folder / f"{PARTIAL_PREFIX}{uuid4().hex}"
    try:
        with path.open("xb") as file:
            yield file
    finally:
        path.unlink(missing_ok=True)


def _put(file: IO[bytes], content: bytes, path: Path) -> None:
    """Fill a new file and put it in place at once, for good."""
    file.write(content)
    file.flush()
    os.fsync(file.fileno())
    os.replace(file.name, path)
    sync(path.parent)
