"""Ranked groups on disk: packed, append-only, checked, read one by one.

A store is a folder with ``metadata.json`` (what the groups came from) and files of some scenes each
(:mod:`dpa.preferences.chunk`). A chunk appears by one rename, complete with its checksums: whatever ends a writer, the
store holds whole chunks only. :mod:`dpa.preferences.writer` writes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from dpa.preferences.chunk import MENDING, ChunkRecord, chunk_files, intact, read_group, read_record
from dpa.preferences.group import Group, check_group, pad_groups
from dpa.preferences.provenance import Provenance, StoreError
from envs.positions import positions


class PreferenceStore:
    """Read-only view of a store as it is now, groups in the order of their scenes; nothing is kept open.

    Indexing gives a padded tensordict of batch size ``[S]``. What others append later is seen by a new view.

    Args:
        folder: of the store.

    Raises:
        StoreError: the folder is no store, or the record of a chunk is damaged.

    Examples:
        >>> import tempfile
        >>> from dpa.preferences import PreferenceWriter
        >>> from dpa.preferences.examples import example_groups, example_provenance
        >>> folder = tempfile.mkdtemp()
        >>> with PreferenceWriter(folder, example_provenance()) as writer:
        ...     writer.append(example_groups(num_scenes=3))
        3
        >>> store = PreferenceStore(folder)
        >>> len(store), store[[2, 0]]["tokens"].shape
        (3, torch.Size([2, 8, 4, 16]))
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.provenance = Provenance.from_folder(self.folder)
        self._files = chunk_files(self.folder)
        self._records = [read_record(path, self.provenance) for path in self._files]
        scenes, agents = (
            torch.tensor([value for record in self._records for value in getattr(record, name)], dtype=torch.int64)
            for name in ("scenes", "num_agents")
        )
        order = scenes.argsort(stable=True)
        places = [(chunk, row) for chunk, record in enumerate(self._records) for row in range(len(record.scenes))]
        self._places = np.array(places, np.int64).reshape(-1, 2)[order.numpy()]
        self.scenes, self.num_agents = scenes[order], agents[order]
        """``[S]`` int64: the scene of each group, and its rows of agents."""
        self._check()

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int | slice | Sequence[int] | Tensor) -> TensorDict:
        """Some groups, agents padded to the largest of them (see :meth:`read`)."""
        if isinstance(index, slice):
            index = range(len(self))[index]
        return self.read(index)

    @property
    def distance(self) -> Tensor:
        """``[S, K]`` of all groups; looking at it the first time unpacks every group."""
        return self._scene_values[0].clone()

    @property
    def ade(self) -> Tensor:
        """``[S, K]`` of all groups [m]; like :attr:`distance`."""
        return self._scene_values[1].clone()

    @property
    def num_bytes(self) -> int:
        """Of all files of the chunks."""
        return sum(path.stat().st_size for path in self._files)

    def read(self, index: int | Iterable[int] | Tensor, num_agents: int | None = None) -> TensorDict:
        """Copy groups into memory; only their own blocks are read.

        Args:
            index: ``[S]`` positions in the store, one alone, or a mask over all groups.
            num_agents: A to pad to; by default the largest group asked for. Rows at the end that neither act, nor are
                ranked, nor are of a class were not kept, so A can be smaller than in the environment.

        Returns:
            batch size ``[S]``, keys ``SCENE`` and those of a ranked group of :mod:`envs.keys`.

        Raises:
            IndexError: a position outside the store, or a mask of another length.
            StoreError: a group is damaged.
            ValueError: ``num_agents`` is below the number of agents of a group.
        """
        groups = [self.group(place) for place in positions(index, len(self)).tolist()]
        largest = max((len(group.tokens) for group in groups), default=0)
        if num_agents is not None and largest > num_agents:
            raise ValueError(f"num_agents must be at least {largest}, the largest group asked for; got {num_agents}.")
        num_features = self._records[0].num_features if self._records else 0
        return pad_groups(groups, self.provenance, num_features, largest if num_agents is None else num_agents)

    def group(self, index: int) -> Group:
        """One group without padding.

        Raises:
            IndexError: a position outside the store.
            StoreError: it is damaged.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"group {index} is outside {self.folder}, which holds {len(self)}.")
        chunk, row = self._places[index].tolist()
        return read_group(self._files[chunk], self._records[chunk], row, self.provenance)

    def __iter__(self) -> Iterator[Group]:
        return (self.group(index) for index in range(len(self)))

    @cached_property
    def _scene_values(self) -> Tensor:
        """Distance and ADE ``[2, S, K]``."""
        values = np.empty((2, len(self), self.provenance.num_rollouts), np.float32)
        for row, group in enumerate(self):
            values[:, row] = group.distance, group.ade
        return torch.from_numpy(values)

    def _check(self) -> None:
        if len({record.num_features for record in self._records}) > 1:
            raise StoreError(f"{self.folder}: chunks have shares of different numbers of features; collect anew.")
        again = (self.scenes[1:] == self.scenes[:-1]).nonzero()
        if len(again):
            row = int(again[0])
            first, second = (self._files[chunk].name for chunk in self._places[row : row + 2, 0])
            raise StoreError(
                f"{self.folder}: scene {int(self.scenes[row])} is in {first} and in {second}; delete one of the two "
                "and collect again what is then missing."
            )


def verify(folder: str | Path) -> list[str]:
    """Read every byte of a store, compare it with its checksums, and check what must hold for every group.

    Returns:
        one line for each problem; empty when the store is sound.

    Raises:
        StoreError: the folder is no store.
    """
    folder = Path(folder)
    origin = Provenance.from_folder(folder)
    problems: list[str] = []
    for path in chunk_files(folder):
        try:
            if not intact(path):
                raise StoreError(f"{path} is not what its name says; {MENDING}.")
            record = read_record(path, origin)
            for row in range(len(record.scenes)):
                _check_stored(path, record, row, origin)
        except (OSError, StoreError) as error:
            problems.append(str(error))
    if not problems:
        try:
            PreferenceStore(folder)
        except StoreError as error:
            problems.append(str(error))
    return problems


def _check_stored(path: Path, record: ChunkRecord, row: int, origin: Provenance) -> None:
    group = read_group(path, record, row, origin)
    try:
        check_group(group, origin)
    except StoreError as error:
        raise StoreError(f"{path}, {error}") from None
