"""Scenes on disk: a folder of shards and one manifest, read-only and open to a random look-up.

:mod:`envs.convert` writes stores. In memory a store is a sequence of scenes like any other
(:class:`~envs.scene.SceneSource`), with the ids and sizes of all of them known before any is loaded.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from envs.scene import Scene, SceneError
from envs.shards import (
    FORMAT_VERSION,
    RECORD_FILE,
    Shard,
    file_digest,
    read_record,
    read_versioned,
    write_json,
)

MANIFEST_FILE = "manifest.json"
"""In the folder of a store: its :class:`Manifest`."""


@dataclass(frozen=True)
class Manifest:
    """What a store is made of.

    Attributes:
        source: name of the source that the scenes came from.
        options: how they were converted.
        plan: digest of the inputs and their order; a conversion goes on only with its own plan.
        complete: every shard is there.
        shards: ``name``, number of ``scenes`` and ``sha256`` of the record of each shard, in order.
        skipped: inputs that gave no scene: ``input``, ``record`` and ``error``.
    """

    source: str
    options: dict[str, Any]
    plan: str
    complete: bool = False
    shards: list[dict[str, Any]] = field(default_factory=list)
    skipped: list[dict[str, Any]] = field(default_factory=list)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write or replace the manifest of a store."""
    write_json(folder / MANIFEST_FILE, {"version": FORMAT_VERSION, **asdict(manifest)})


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a store.

    Raises:
        SceneError: there is none, it is damaged or of another version.
    """
    return read_versioned(folder / MANIFEST_FILE, Manifest)


class SceneStore:
    """Read-only scenes of a folder that ``python -m envs.convert`` has written.

    Every scene that is handed out is a copy: it may be changed in place, the files stay as they are. Files are mapped
    on first use and never written, so that any number of processes may read one store; a pickled store is its
    folder's name and opens again where it arrives.

    Args:
        folder: of the store.

    Attributes:
        folder: of the store, absolute.
        manifest: what the store is made of.

    Raises:
        SceneError: no store, another version, an unfinished conversion, or a shard that is missing; on loading, an
            array that is missing or has the wrong size.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from envs.shards import write_shard
        >>> from envs.sources.synthetic import straight_road
        >>> folder = TemporaryDirectory()
        >>> path = Path(folder.name)
        >>> record = write_shard(path / "00000", [straight_road(2), straight_road(3)], [("none", 0), ("none", 1)])
        >>> shards = [{"name": "00000", "scenes": 2, "sha256": file_digest(path / "00000" / "shard.json")}]
        >>> write_manifest(path, Manifest("synthetic", {}, plan="", complete=True, shards=shards))
        >>> store = SceneStore(path)
        >>> len(store), store.num_agents, store[1].agents.position.shape
        (2, array([2, 3]), torch.Size([3, 91, 3]))
        >>> store.subset([1]).scene_ids
        ['straight_road_3_None']
        >>> folder.cleanup()
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder).absolute()
        self.manifest = read_manifest(self.folder)
        if not self.manifest.complete:
            raise SceneError(f"{self.folder}: the conversion has not finished; run it again, it goes on where it was.")
        self._shards = [self._open(entry["name"], entry["scenes"]) for entry in self.manifest.shards]
        self._starts = [0, *accumulate(len(shard.record.scene_ids) for shard in self._shards)]
        self._rows = np.arange(self._starts[-1])

    def _open(self, name: str, num_scenes: int) -> Shard:
        shard = Shard(self.folder / name, read_record(self.folder / name))
        if len(shard.record.scene_ids) != num_scenes:
            raise SceneError(
                f"{shard.folder}: {len(shard.record.scene_ids)} scenes where the manifest has {num_scenes}; "
                "convert the scenes again."
            )
        return shard

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int, /) -> Scene:
        """The scene at an index, uncollated, as a copy of its own."""
        shard, row = self._find(index)
        return shard.scene(row)

    def __repr__(self) -> str:
        return f"SceneStore({str(self.folder)!r}, {len(self)} scenes)"

    def __reduce__(self) -> tuple:
        return _reopen, (self.folder, self._rows)

    @cached_property
    def scene_ids(self) -> list[str]:
        """The recordings' ids, in order."""
        ids = [scene_id for shard in self._shards for scene_id in shard.record.scene_ids]
        return [ids[row] for row in self._rows]

    @cached_property
    def num_agents(self) -> np.ndarray:
        """``[len]`` int64: agents of each scene that are present at the current step."""
        counts = [count for shard in self._shards for count in shard.record.num_agents]
        return np.array(counts, dtype=np.int64)[self._rows]

    def index_of(self, scene_id: str) -> int:
        """Index of a scene.

        Raises:
            SceneError: the store has no scene of that id.
        """
        if scene_id not in self._index:
            raise SceneError(f"{self.folder}: no scene {scene_id!r} among its {len(self)}; see scene_ids.")
        return self._index[scene_id]

    def find(self, name: str) -> int:
        """Index of a scene that is given by its id or by its index as text; ids come first, as they may be all digits.

        Raises:
            SceneError: the store has no such scene.
        """
        if name not in self._index and name.isdecimal() and int(name) < len(self):
            return int(name)
        return self.index_of(name)

    def subset(self, indices: Sequence[int]) -> SceneStore:
        """A view of some scenes, in the order given, that shares this store's files.

        Raises:
            IndexError: an index out of range.
        """
        view = object.__new__(SceneStore)
        view.folder, view.manifest = self.folder, self.manifest
        view._shards, view._starts = self._shards, self._starts
        view._rows = self._rows[np.asarray(indices, dtype=np.int64)]
        return view

    def provenance(self, index: int) -> tuple[str, int]:
        """The input (a file) that a scene came from, and its record there."""
        shard, row = self._find(index)
        name, record = shard.record.units[row]
        return name, record

    def verify(self, tick: Callable[[], None] = lambda: None) -> None:
        """Compare every file with its checksum and validate every scene, of the whole store.

        Args:
            tick: called after each scene.

        Raises:
            SceneError: naming the first file or scene that is not as it was written.
        """
        for entry, shard in zip(self.manifest.shards, self._shards, strict=True):
            if file_digest(shard.folder / RECORD_FILE) != entry["sha256"]:
                raise SceneError(
                    f"{shard.folder / RECORD_FILE}: changed since it was written; convert the scenes again."
                )
            shard.verify()
            for row, (name, record) in enumerate(shard.record.units):
                shard.scene(row).validate(f"{name}, record {record}")
                tick()

    @cached_property
    def _index(self) -> dict[str, int]:
        return {scene_id: index for index, scene_id in enumerate(self.scene_ids)}

    def _find(self, index: int) -> tuple[Shard, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"scene {index} of {len(self)}")
        row = int(self._rows[index])
        number = bisect.bisect_right(self._starts, row) - 1
        return self._shards[number], row - self._starts[number]


def _reopen(folder: Path, rows: np.ndarray) -> SceneStore:
    return SceneStore(folder).subset(rows)
