"""Ranked groups on disk: small, append-only, checked, and read through memory maps.

A store is a folder with ``metadata.json`` (what the groups came from) and one folder per chunk of scenes. Agents are
ragged, so a chunk holds flat arrays with the number of agents of each scene. A chunk appears by one rename, complete
with its checksums: whatever ends a writer, the store holds whole chunks only. :mod:`dpa.preferences.writer` writes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from dpa.preferences.provenance import Provenance, StoreError
from dpa.ranking.distance import rank_of
from envs import keys

CHECKSUM_FILE = "checksums.json"
CHUNK_PREFIX = "chunk-"

SCENE_ARRAYS = ("scene", "num_agents", "distance", "ade")
"""Arrays with one row per scene: ``[n]``, ``[n]``, ``[n, K]``, ``[n, K]``."""
AGENT_ARRAYS = ("tokens", "token_valid", "agent_distance", "agent_ranked")
"""Arrays with one row per agent: ``[m, K, T]``, ``[m, T]``, ``[m, K]``, ``[m]``."""


class PreferenceStore:
    """Read-only view of a store; indexing gives a padded tensordict of batch size ``[S]``.

    Args:
        folder: of the store.

    Raises:
        StoreError: the folder is no store, or a chunk is damaged.

    Examples:
        >>> import tempfile
        >>> from dpa.preferences import PreferenceWriter
        >>> from dpa.preferences.examples import example_groups, example_provenance
        >>> folder = tempfile.mkdtemp()
        >>> with PreferenceWriter(folder, example_provenance()) as writer:
        ...     writer.append(example_groups(num_scenes=3))
        >>> store = PreferenceStore(folder)
        >>> len(store), store[[2, 0]]["tokens"].shape
        (3, torch.Size([2, 8, 4, 16]))
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.provenance = Provenance.from_folder(self.folder)
        self._chunks = [_open_chunk(path) for path in chunk_folders(self.folder)]
        sizes = [len(chunk["scene"]) for chunk in self._chunks]
        self._first = np.cumsum([0, *sizes])
        self._agent_first = [np.cumsum([0, *chunk["num_agents"].tolist()]) for chunk in self._chunks]

    def __len__(self) -> int:
        return int(self._first[-1])

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> TensorDict:
        """Some groups, agents padded to the largest of them (see :meth:`read`)."""
        if isinstance(index, slice):
            index = range(len(self))[index]
        return self.read([index] if isinstance(index, int) else index)

    @cached_property
    def scenes(self) -> Tensor:
        """``[S]`` int64: the scene of each group."""
        return self._column("scene")

    @cached_property
    def num_agents(self) -> Tensor:
        """``[S]`` int64: rows of agents of each group."""
        return self._column("num_agents")

    @cached_property
    def distance(self) -> Tensor:
        """``[S, K]`` of all groups."""
        return self._column("distance")

    @cached_property
    def ade(self) -> Tensor:
        """``[S, K]`` of all groups [m]."""
        return self._column("ade")

    def ranked_agents(self) -> Tensor:
        """``[S]`` int64: agents of each group that took part in its ranking."""
        counts = [
            torch.tensor([int(chunk["agent_ranked"][a:b].sum()) for a, b in pairwise(first)])
            for chunk, first in zip(self._chunks, self._agent_first, strict=True)
        ]
        return torch.cat([torch.empty(0, dtype=torch.int64), *counts])

    def read(self, index: Iterable[int] | Tensor, num_agents: int | None = None) -> TensorDict:
        """Copy groups into memory.

        Args:
            index: ``[S]`` positions in the store.
            num_agents: A to pad to; by default the largest group asked for. Rows at the end that neither act nor are
                ranked were not kept, so A can be smaller than in the environment.

        Returns:
            batch size ``[S]``, keys ``SCENE`` and those of :mod:`envs.keys` from ``TOKENS`` to ``RANK``.

        Raises:
            IndexError: a position outside the store.
            ValueError: ``num_agents`` is below the number of agents of a group.
        """
        groups = [self._group(int(i)) for i in index]
        sizes = [len(group["tokens"]) for group in groups]
        num_agents = max(sizes, default=0) if num_agents is None else num_agents
        if max(sizes, default=0) > num_agents:
            raise ValueError(
                f"num_agents must be at least {max(sizes)}, the largest group asked for; got {num_agents}."
            )
        k, t = self.provenance.num_rollouts, self.provenance.horizon
        out = {
            "tokens": torch.zeros(len(groups), num_agents, k, t, dtype=torch.int64),
            "token_valid": torch.zeros(len(groups), num_agents, t, dtype=torch.bool),
            "agent_distance": torch.zeros(len(groups), num_agents, k),
            "agent_ranked": torch.zeros(len(groups), num_agents, dtype=torch.bool),
            "scene": torch.zeros(len(groups), dtype=torch.int64),
            "distance": torch.zeros(len(groups), k),
            "ade": torch.zeros(len(groups), k),
        }
        for row, (group, size) in enumerate(zip(groups, sizes, strict=True)):
            for name in AGENT_ARRAYS:
                out[name][row, :size] = torch.from_numpy(np.array(group[name]))
            for name in ("scene", "distance", "ade"):
                out[name][row] = torch.from_numpy(np.array(group[name]))
        return TensorDict(
            {
                keys.SCENE: out["scene"],
                keys.TOKENS: out["tokens"].transpose(1, 2).contiguous(),
                keys.TOKEN_VALID: out["token_valid"],
                keys.DISTANCE: out["distance"],
                keys.AGENT_DISTANCE: out["agent_distance"].transpose(1, 2).contiguous(),
                keys.ADE: out["ade"],
                keys.AGENT_RANKED: out["agent_ranked"],
                keys.RANK: rank_of(out["distance"]),
            },
            batch_size=[len(groups)],
        )

    def _group(self, index: int) -> dict[str, np.ndarray]:
        """Views of the arrays of one group, one row per agent where a row is an agent."""
        if not -len(self) <= index < len(self):
            raise IndexError(f"group {index} is outside {self.folder}, which holds {len(self)}.")
        index %= len(self)
        number = int(np.searchsorted(self._first, index, side="right")) - 1
        chunk, row = self._chunks[number], index - self._first[number]
        agents = slice(*self._agent_first[number][row : row + 2])
        return {name: chunk[name][row] for name in SCENE_ARRAYS} | {name: chunk[name][agents] for name in AGENT_ARRAYS}

    def _column(self, name: str) -> Tensor:
        shape = (0,) if name in ("scene", "num_agents") else (0, self.provenance.num_rollouts)
        dtype = torch.int64 if len(shape) == 1 else torch.float32
        return torch.cat(
            [torch.empty(shape, dtype=dtype), *(torch.from_numpy(np.array(c[name])) for c in self._chunks)]
        )


def chunk_folders(folder: Path) -> list[Path]:
    """The complete chunks of a store, in order of writing."""
    return sorted(path for path in folder.iterdir() if path.name.startswith(CHUNK_PREFIX))


def verify(folder: str | Path) -> list[str]:
    """Read every byte of a store and compare it with its checksums.

    Returns:
        one line for each problem; empty when the store is sound.
    """
    folder = Path(folder)
    Provenance.from_folder(folder)
    problems: list[str] = []
    seen: dict[int, str] = {}
    for chunk in chunk_folders(folder):
        found = _damage(chunk)
        problems += found
        if found:
            continue
        for scene in np.load(chunk / "scene.npy", allow_pickle=False).tolist():
            if scene in seen:
                problems.append(f"{chunk.name}: scene {scene} is in {seen[scene]} too; delete one of the two chunks.")
            seen.setdefault(scene, chunk.name)
    return problems


def checksum(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _damage(chunk: Path) -> list[str]:
    """What is wrong with the files of one chunk."""
    fix = "delete the chunk and generate its scenes again."
    try:
        wanted = json.loads((chunk / CHECKSUM_FILE).read_text())
    except (OSError, ValueError) as error:
        return [f"{chunk.name}: no readable {CHECKSUM_FILE} ({error}); {fix}"]
    problems = []
    for name in (f"{array}.npy" for array in (*SCENE_ARRAYS, *AGENT_ARRAYS)):
        if not (chunk / name).is_file():
            problems.append(f"{chunk.name}: {name} is missing; {fix}")
        elif checksum(chunk / name) != wanted.get(name):
            problems.append(f"{chunk.name}: {name} does not match its checksum; {fix}")
    return problems


def _open_chunk(chunk: Path) -> dict[str, np.ndarray]:
    try:
        # Read-only maps: nothing that is done to what a store returns can reach the disk.
        return {
            name: np.load(chunk / f"{name}.npy", mmap_mode="r", allow_pickle=False)
            for name in (*SCENE_ARRAYS, *AGENT_ARRAYS)
        }
    except (OSError, ValueError) as error:
        raise StoreError(
            f"{chunk} is damaged ({error}); delete it and generate its scenes again. To find other damage: "
            f"python -m dpa.preferences verify {chunk.parent}"
        ) from None
