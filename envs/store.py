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

from envs.card import Card
from envs.files import write_json
from envs.positions import positions
from envs.scene import Lacks, Scene, SceneError
from envs.shards import FORMAT_VERSION, SUFFIX, Shard, file_digest, read_versioned
from envs.sources.fields import shown

MANIFEST_FILE = "manifest.json"
"""In the folder of a store: its :class:`Manifest`."""


@dataclass(frozen=True)
class Manifest:
    """What a store is made of.

    Attributes:
        source: name of the source that the scenes came from.
        options: how they were converted.
        named: what the user named as inputs.
        plan: digest of the inputs' paths, sizes and order; a conversion goes on only with its own.
        complete: every shard is there.
        shards: ``name``, number of ``scenes`` and ``sha256`` of the file of each shard, in order.
        skipped: records that gave no scene: ``input``, ``record`` and ``error``.
        notes: what readers could not take over as it was -> how often.
    """

    source: str
    options: dict[str, Any]
    plan: str
    named: list[str] = field(default_factory=list)
    complete: bool = False
    shards: list[dict[str, Any]] = field(default_factory=list)
    skipped: list[dict[str, Any]] = field(default_factory=list)
    notes: dict[str, int] = field(default_factory=dict)


_MANIFEST_SHAPE = {
    "source": str,
    "options": {str: object},
    "plan": str,
    "named": [str],
    "complete": bool,
    "shards": [{"name": str, "scenes": int, "sha256": str}],
    "skipped": [{"input": str, "record": int, "error": str}],
    "notes": {str: int},
}


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write or replace the manifest of a store."""
    write_json(folder / MANIFEST_FILE, {"version": FORMAT_VERSION, **asdict(manifest)}, indent=None)


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of a store.

    Raises:
        SceneError: there is none, it is damaged or of another version.
    """
    return read_versioned(folder / MANIFEST_FILE, Manifest, _MANIFEST_SHAPE)


class SceneStore:
    """Read-only scenes of one or more folders that ``python -m envs.convert`` has written.

    Every scene that is handed out is a copy: it may be changed in place, the files stay as they are. No file stays open
    between two scenes, so that any number of processes may read one store; a pickled store is its folders' names and
    opens again where it arrives.

    Args:
        folders: of the stores; their scenes follow one another.

    Attributes:
        folders: of the stores, absolute.
        manifests: what each is made of.

    Raises:
        SceneError: no store, another version, an unfinished conversion, a shard that is missing, or two scenes of one
            id; on loading, a scene that is damaged.

    Examples:
        >>> from tempfile import TemporaryDirectory
        >>> from envs.shards import ShardWriter
        >>> from envs.sources.synthetic import straight_road
        >>> folder = TemporaryDirectory()
        >>> path, writer = Path(folder.name), ShardWriter()
        >>> writer.add(straight_road(2), ("none", 0))
        >>> writer.add(straight_road(3), ("none", 1))
        >>> record = writer.write(path / "00000.scenes")
        >>> shards = [{"name": "00000.scenes", "scenes": 2, "sha256": file_digest(path / "00000.scenes")}]
        >>> write_manifest(path, Manifest("synthetic", {"split": "train"}, plan="", complete=True, shards=shards))
        >>> store = SceneStore(path)
        >>> len(store), store.num_agents, store[1].agents.position.shape
        (2, array([2, 3]), torch.Size([3, 91, 3]))
        >>> store.subset([1]).scene_ids, store.select(max_agents=2).scene_ids
        (['straight_road_3_None'], ['straight_road_2_None'])
        >>> folder.cleanup()
    """

    def __init__(self, *folders: str | Path) -> None:
        if not folders:
            raise SceneError("a store needs a folder; give one that `python -m envs.convert` has written.")
        self.folders = tuple(Path(folder).absolute() for folder in folders)
        for folder in self.folders:
            if not (folder / MANIFEST_FILE).is_file():
                what = "has no manifest.json, so it is no store of scenes" if folder.exists() else "does not exist"
                raise SceneError(f"{folder} {what}; name a folder that `python -m envs.convert` has written.")
        self.manifests = tuple(read_manifest(folder) for folder in self.folders)
        self._shards: list[Shard] = []
        self._owner: list[int] = []
        for number, (folder, manifest) in enumerate(zip(self.folders, self.manifests, strict=True)):
            if not manifest.complete:
                raise SceneError(f"{folder}: the conversion has not finished; run it again, it goes on where it was.")
            self._shards += [_open(folder, entry) for entry in manifest.shards]
            self._owner += [number] * len(manifest.shards)
        self._starts = [0, *accumulate(len(shard.record.scene_ids) for shard in self._shards)]
        self._rows = np.arange(self._starts[-1])
        if len(self.folders) > 1 and len(self._index) < len(self):
            twice = next(scene_id for i, scene_id in enumerate(self.scene_ids) if self._index[scene_id] != i)
            raise SceneError(f"{', '.join(map(str, self.folders))}: share scene {twice}; leave one folder out.")

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int, /) -> Scene:
        """The scene at an index, uncollated, as a copy of its own."""
        shard, row = self._find(index)
        return shard.scene(row)

    def __repr__(self) -> str:
        return f"SceneStore({', '.join(repr(str(folder)) for folder in self.folders)}: {len(self)} scenes)"

    def __reduce__(self) -> tuple:
        return _reopen, (self.folders, self._rows)

    @cached_property
    def scene_ids(self) -> list[str]:
        """The recordings' ids, in order."""
        ids = [scene_id for shard in self._shards for scene_id in shard.record.scene_ids]
        return [ids[row] for row in self._rows]

    @property
    def num_agents(self) -> np.ndarray:
        """``[len]`` int64: agents of each scene that are present at the current step."""
        return self._gather("num_agents", np.int64)

    @property
    def checksums(self) -> np.ndarray:
        """``[len]`` int64: of each scene's content, see :func:`~envs.codec.checksum`."""
        return self._gather("checksums", np.int64)

    @property
    def has_lights(self) -> np.ndarray:
        """``[len]`` bool: whether each scene has a traffic light."""
        return self._gather("has_lights", np.bool_)

    @property
    def lacks(self) -> np.ndarray:
        """``[len]`` int64: flags of :class:`~envs.scene.Lacks` of each scene."""
        return self._gather("lacks", np.int64)

    @property
    def blocks(self) -> list[int]:
        """Numbers of consecutive indices whose scenes lie in one file: reading them together is cheap."""
        shards = np.searchsorted(self._starts, self._rows, side="right")
        borders = np.flatnonzero(np.diff(shards)) + 1
        return np.diff(np.concatenate(([0], borders, [len(shards)]))).tolist() if len(shards) else []

    def index_of(self, scene_id: str) -> int:
        """Index of a scene.

        Raises:
            SceneError: the store has no scene of that id.
        """
        if scene_id not in self._index:
            raise SceneError(f"{self!r}: no scene {scene_id!r} among its {len(self)}; see scene_ids.")
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

        Args:
            indices: of scenes, or a mask over all of them.

        Raises:
            IndexError: an index out of range, or a mask of another length.
        """
        view = object.__new__(SceneStore)
        view.folders, view.manifests = self.folders, self.manifests
        view._shards, view._starts, view._owner = self._shards, self._starts, self._owner
        view._rows = self._rows[positions(indices, len(self))]
        return view

    def select(
        self,
        *,
        min_agents: int = 0,
        max_agents: int | None = None,
        has_lights: bool | None = None,
        source: str | None = None,
        split: str | None = None,
        complete_in: Sequence[str] = (),
    ) -> SceneStore:
        """A view of the scenes that fit, in their order; nothing is unpacked to tell.

        Args:
            min_agents: fewest agents at the current step.
            max_agents: most agents at the current step.
            has_lights: with traffic lights, or without.
            source: name of the source that they came from.
            split: name that their conversion was given.
            complete_in: what no recording may lack, by the names of :class:`~envs.scene.Lacks`: ``["lights"]``.

        Raises:
            ValueError: no folder has that source or split, or there is no such name; the message says which there are.
        """
        needed = 0
        for name in complete_in:
            if name.upper() not in Lacks.__members__:
                raise ValueError(f"nothing is called {name!r}; a recording may lack {', '.join(Lacks.__members__)}.")
            needed |= Lacks[name.upper()]
        fits = (self.num_agents >= min_agents) & (self.lacks & needed == 0)
        if max_agents is not None:
            fits &= self.num_agents <= max_agents
        if has_lights is not None:
            fits &= self.has_lights == has_lights
        for what, wanted, names in (
            ("source", source, [manifest.source for manifest in self.manifests]),
            ("split", split, [manifest.options.get("split", "") for manifest in self.manifests]),
        ):
            if wanted is not None:
                if wanted not in names:
                    raise ValueError(f"{self!r}: no {what} {wanted!r}; there is {', '.join(map(repr, names))}.")
                fits &= np.array([name == wanted for name in names])[self._folder_of_rows]
        return self.subset(np.flatnonzero(fits))

    def provenance(self, index: int) -> tuple[str, int]:
        """The input (a file) that a scene came from, and its record there."""
        shard, row = self._find(index)
        return shard.record.units[row]

    def origins(self) -> list[dict[str, Any]]:
        """Where the scenes came from.

        Returns:
            For each folder that has some of them ``source``, ``split``, ``named`` (the inputs, as the user named them)
            and ``scenes``, their number.
        """
        numbers, counts = np.unique(self._folder_of_rows, return_counts=True)
        return [
            {
                "source": manifest.source,
                "split": manifest.options.get("split", ""),
                "named": list(manifest.named),
                "scenes": count,
            }
            for manifest, count in zip([self.manifests[i] for i in numbers], counts.tolist(), strict=True)
        ]

    def card(self) -> Card:
        """What the scenes hold, as counts.

        Every shard was counted as a whole when it was written. Of one that is in the view in part, the scenes that are
        in it or those that are not are read, whichever are fewer.
        """
        card, left_out = Card(), Card()
        numbers = np.searchsorted(self._starts, self._rows, side="right") - 1
        for number in np.unique(numbers).tolist():
            shard, rows = self._shards[number], self._rows[numbers == number] - self._starts[number]
            every = len(shard.record.scene_ids)
            others = np.setdiff1d(np.arange(every), rows)
            part, read = card, rows
            if len(others) < len(rows) == every - len(others):  # no scene stands in the view twice
                card.merge(shard.record.card)
                part, read = left_out, others
            for row in read.tolist():
                part.add(shard.scene(row))
        card.remove(left_out.counts)
        return card

    def verify(self, tick: Callable[[], None] = lambda: None) -> None:
        """Compare every file with its checksum, unpack and validate every scene, of the whole store.

        Args:
            tick: called after each scene.

        Raises:
            SceneError: naming the first file or scene that is not as it was written.
        """
        entries = [entry for manifest in self.manifests for entry in manifest.shards]
        for entry, shard in zip(entries, self._shards, strict=True):
            if file_digest(shard.path) != entry["sha256"]:
                raise SceneError(
                    f"{shard.path}: changed since it was written; remove it, then convert the scenes again."
                )
            for row in range(len(shard.record.units)):
                shard.scene(row).validate(f"{shard.path}, scene {row}")
                tick()

    @cached_property
    def _index(self) -> dict[str, int]:
        return {scene_id: index for index, scene_id in enumerate(self.scene_ids)}

    @property
    def _folder_of_rows(self) -> np.ndarray:
        return np.array(self._owner, dtype=np.int64)[np.searchsorted(self._starts, self._rows, side="right") - 1]

    def _gather(self, field: str, dtype: type) -> np.ndarray:
        values = [value for shard in self._shards for value in getattr(shard.record, field)]
        return np.array(values, dtype=dtype)[self._rows]

    def _find(self, index: int) -> tuple[Shard, int]:
        if not -len(self) <= index < len(self):
            raise IndexError(f"scene {index} of {len(self)}")
        row = int(self._rows[index])
        number = bisect.bisect_right(self._starts, row) - 1
        return self._shards[number], row - self._starts[number]


def _open(folder: Path, entry: dict[str, Any]) -> Shard:
    name = entry["name"]
    if not name.endswith(SUFFIX) or not name.isprintable() or "/" in name:
        raise SceneError(f"{folder / MANIFEST_FILE}: no shard can be named {shown(name)}; convert the scenes again.")
    shard = Shard(folder / name)
    if len(shard.record.scene_ids) != entry["scenes"]:
        raise SceneError(
            f"{shard.path}: {len(shard.record.scene_ids)} scenes where the manifest has {entry['scenes']}; "
            "convert the scenes again."
        )
    return shard


def _reopen(folders: tuple[Path, ...], rows: np.ndarray) -> SceneStore:
    return SceneStore(*folders).subset(rows)
