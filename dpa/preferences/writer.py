"""Writing a preference store: chunk by chunk, atomically, resumable."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from dpa.preferences.provenance import METADATA_FILE, Provenance, StoreError
from dpa.preferences.store import (
    CHECKSUM_FILE,
    CHUNK_PREFIX,
    SCENE_ARRAYS,
    PreferenceStore,
    checksum,
    chunk_folders,
)
from envs import keys

_UNFINISHED = ".unfinished-"
_LOCK = ".writer"


class PreferenceWriter:
    """Appends ranked groups to a store; the only writer of its folder while it is open.

    Groups wait in memory until ``chunk_scenes`` of them make a chunk; :meth:`close`, or the end of a ``with`` block,
    writes the rest. A chunk is written aside, synchronised and renamed, so a process that is killed loses at most the
    chunk in progress. To resume, open the folder again with the same provenance and leave out :attr:`scenes_done`.

    Args:
        folder: of the store; made if missing.
        provenance: what the groups come from.
        chunk_scenes: scenes of one chunk.

    Raises:
        StoreError: the folder holds groups of another origin, is not a store and not empty, or is being written.

    Examples:
        >>> import tempfile
        >>> from dpa.preferences.examples import example_groups, example_provenance
        >>> folder = tempfile.mkdtemp()
        >>> with PreferenceWriter(folder, example_provenance()) as writer:
        ...     writer.append(example_groups(num_scenes=3))
        >>> with PreferenceWriter(folder, example_provenance()) as writer:
        ...     sorted(writer.scenes_done)
        [0, 1, 2]
    """

    def __init__(self, folder: str | Path, provenance: Provenance, chunk_scenes: int = 64) -> None:
        if chunk_scenes < 1:
            raise ValueError(f"chunk_scenes must be 1 or more, got {chunk_scenes}.")
        if not 1 <= provenance.vocab_size <= np.iinfo(np.int16).max + 1:
            raise ValueError(f"a vocabulary of {provenance.vocab_size} tokens does not fit the 16 bits of a store.")
        self.folder, self.provenance, self.chunk_scenes = Path(folder), provenance, chunk_scenes
        self.folder.mkdir(parents=True, exist_ok=True)
        self._lock = _lock(self.folder)
        try:
            self._open()
        except BaseException:
            self._lock.close()
            raise

    def _open(self) -> None:
        if (self.folder / METADATA_FILE).exists():
            Provenance.from_folder(self.folder).check_same(self.provenance, self.folder)
        else:
            strange = sorted(p.name for p in self.folder.iterdir() if not p.name.startswith((_UNFINISHED, _LOCK)))
            if strange:
                raise StoreError(f"{self.folder} is no preference store and holds {strange[:3]}; name an empty folder.")
            _write(self.folder / METADATA_FILE, self.provenance.to_json())
        for leftover in self.folder.glob(f"{_UNFINISHED}*"):  # of a writer that was killed: the lock says it is gone
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        self._stored = set(PreferenceStore(self.folder).scenes.tolist())
        self._pending: list[dict[str, np.ndarray]] = []
        numbers = [int(path.name.removeprefix(CHUNK_PREFIX)) for path in chunk_folders(self.folder)]
        self._next = max(numbers, default=-1) + 1

    @property
    def scenes_done(self) -> frozenset[int]:
        """Scenes whose groups are on disk for good."""
        return frozenset(self._stored)

    def append(self, groups: TensorDictBase) -> None:
        """Take groups, batch size ``[S]``, as :class:`~dpa.ranking.transform.RankRollouts` gives them.

        Raises:
            StoreError: a scene is there already, or a value does not fit the store; nothing of ``groups`` is taken.
        """
        scenes = groups[keys.SCENE].tolist()
        known = self._stored | {int(group["scene"]) for group in self._pending}
        twice = sorted({scene for scene in scenes if scene in known or scenes.count(scene) > 1})
        if twice:
            raise StoreError(f"{self.folder}: scenes {twice[:5]} would be stored twice; leave out writer.scenes_done.")
        self._check(groups)
        self._pending += [self._group(group) for group in groups.cpu()]
        while len(self._pending) >= self.chunk_scenes:
            self._flush(self.chunk_scenes)

    def close(self) -> None:
        """Write what waits, and let other writers in."""
        try:
            if self._pending:
                self._flush(len(self._pending))
        finally:
            self._lock.close()

    def __enter__(self) -> PreferenceWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._lock.close()

    def _check(self, groups: TensorDictBase) -> None:
        tokens, valid = groups[keys.TOKENS], groups[keys.TOKEN_VALID]
        origin = self.provenance
        if tokens.shape[1] != origin.num_rollouts or tokens.shape[-1] != origin.horizon:
            raise StoreError(
                f"{self.folder} holds groups of {origin.num_rollouts} rollouts and {origin.horizon} decisions, got "
                f"{tokens.shape[1]} and {tokens.shape[-1]}."
            )
        used = tokens[valid[:, None].expand_as(tokens)]
        if used.numel() and (int(used.min()) < 0 or int(used.max()) >= origin.vocab_size):
            raise StoreError(
                f"{self.folder}: tokens from {int(used.min())} to {int(used.max())} are outside the vocabulary of "
                f"{origin.vocab_size}; give the vocab_size of the tokenizer."
            )
        for key in (keys.DISTANCE, keys.AGENT_DISTANCE, keys.ADE):
            if not torch.isfinite(groups[key]).all():
                bad = groups[keys.SCENE][~torch.isfinite(groups[key]).flatten(1).all(-1)][0]
                raise StoreError(f"{self.folder}: scene {int(bad)} has a {key} that is not finite; rank it again.")

    def _group(self, group: TensorDict) -> dict[str, np.ndarray]:
        """Arrays of one scene, agents first, without the padding at the end."""
        valid, ranked = group[keys.TOKEN_VALID], group[keys.AGENT_RANKED]
        used = (valid.any(-1) | ranked).nonzero()
        size = int(used.max()) + 1 if len(used) else 0
        tokens = torch.where(valid, group[keys.TOKENS], 0)

        def rows(value: Tensor) -> Tensor:
            return value.transpose(0, 1)[:size]

        return {
            "scene": np.int64(int(group[keys.SCENE])),
            "num_agents": np.int64(size),
            "distance": group[keys.DISTANCE].float().numpy(),
            "ade": group[keys.ADE].float().numpy(),
            "tokens": rows(tokens).numpy().astype(self.provenance.token_dtype),
            "token_valid": valid[:size].numpy(),
            "agent_distance": rows(group[keys.AGENT_DISTANCE]).float().numpy(),
            "agent_ranked": ranked[:size].numpy(),
        }

    def _flush(self, size: int) -> None:
        """Write the first ``size`` waiting groups as one chunk."""
        groups = self._pending[:size]
        aside = self.folder / f"{_UNFINISHED}{self._next:08d}"
        try:
            aside.mkdir()
            _write_arrays(aside, groups)
            aside.rename(self.folder / f"{CHUNK_PREFIX}{self._next:08d}")
        except BaseException:
            shutil.rmtree(aside, ignore_errors=True)
            raise
        self._next += 1
        self._pending = self._pending[size:]
        self._stored |= {int(group["scene"]) for group in groups}


def _write_arrays(folder: Path, groups: list[dict[str, np.ndarray]]) -> None:
    """The arrays of a chunk and their checksums."""
    for name in groups[0]:
        join = np.stack if name in SCENE_ARRAYS else np.concatenate
        with (folder / f"{name}.npy").open("wb") as file:
            np.save(file, join([group[name] for group in groups]), allow_pickle=False)
            _synchronise(file)
    sums = {path.name: checksum(path) for path in sorted(folder.glob("*.npy"))}
    _write(folder / CHECKSUM_FILE, json.dumps(sums, indent=2))


def _lock(folder: Path) -> IO[str]:
    """Hold the folder for one writer; the system lets go when the process ends, however it ends."""
    file = (folder / _LOCK).open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise StoreError(f"{folder} is being written by another process; wait for it or name another folder.") from None
    return file


def _write(path: Path, text: str) -> None:
    """Put a small file in place at once."""
    aside = path.with_name(f"{_UNFINISHED}{path.name}")
    with aside.open("w") as file:
        file.write(text)
        _synchronise(file)
    os.replace(aside, path)


def _synchronise(file: IO) -> None:
    file.flush()
    os.fsync(file.fileno())
