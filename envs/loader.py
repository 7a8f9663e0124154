"""Training batches of scenes: shuffled with locality, prepared, split over ranks and resumable to the batch.

What a batch holds is a pure function of the seed, the epoch and its place in the epoch. Neither ranks, workers nor
interruptions change it.
"""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import resource
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from envs.scene import Scene, SceneSource, collate
from envs.seeding import make_generator

Key = tuple[int, list[int]]
"""What makes a batch: the epoch and the indices of its scenes."""
Prepare = Callable[[Scene, torch.Generator], Any]
OPEN_FILES = 1 << 16


def as_it_is(scene: Scene, _generator: torch.Generator) -> Scene:
    """The scene itself."""
    return scene


class SceneLoader:
    """Batches of scenes for training, one epoch with each ``for`` loop over it.

    An epoch shows the blocks of scenes (the shards of a store) in random order, and the scenes in random order within
    each ``block_window`` consecutive blocks of that order: reads stay within a few files at a time. A global batch is
    the next ``world_size * batch_size`` scenes of that order, and rank r takes the r-th slice of it. So a global batch
    of one size has the same scenes however many ranks share it, and all ranks see the same number of batches.

    A loop that was left early goes on where it stopped, and so does a loader that :meth:`load_state_dict` has put
    there, on any number of ranks. A newer loop ends an older one.

    Args:
        scenes: a store or a list. ``blocks``, the number of scenes of each consecutive block of indices, and
            ``scene_ids`` are used where it has them; otherwise it is one block, and only its size is checked on resume.
        batch_size: scenes of a batch of this rank.
        seed: of the order and of the generators.
        prepare: called with each scene and a generator made from the seed, the epoch and the index of the scene:
            whatever turns a scene into a training item.
        collate: called with what was prepared for a batch.
        rank: of this process.
        world_size: number of ranks.
        block_window: blocks whose scenes are shuffled among each other; more mix better and touch more files.
        workers: processes that load ahead; 0 loads in this one. They are spawned, so ``scenes`` must travel by pickle
            (a store does, as its folder's name), and a script needs its ``if __name__ == "__main__"``.
        drop_last: leave out the scenes at the end of an epoch that do not fill a global batch; otherwise the last batch
            is filled up with the first scenes of the same epoch, which are then shown twice.

    Raises:
        ValueError: a number out of range, blocks that do not add up, or no batch in an epoch.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scenes = [straight_road(2, seed=seed) for seed in range(6)]
        >>> loader = SceneLoader(scenes, batch_size=2)
        >>> for epoch in range(loader.epoch, 2):
        ...     print(epoch, [batch.agents.position.shape[0] for batch in loader])
        0 [2, 2, 2]
        1 [2, 2, 2]

        An interrupted epoch goes on elsewhere:

        >>> batches = iter(loader)
        >>> first, state = next(batches), loader.state_dict()
        >>> resumed = SceneLoader(scenes, batch_size=2)
        >>> resumed.load_state_dict(state)
        >>> next(iter(resumed)).scene_id == next(batches).scene_id
        True
    """

    def __init__(
        self,
        scenes: SceneSource,
        batch_size: int = 64,
        *,
        seed: int = 0,
        prepare: Prepare = as_it_is,
        collate: Callable[[list[Any]], Any] = collate,
        rank: int = 0,
        world_size: int = 1,
        block_window: int = 4,
        workers: int = 0,
        drop_last: bool = True,
    ) -> None:
        for name, value in (("batch_size", batch_size), ("world_size", world_size), ("block_window", block_window)):
            if value < 1:
                raise ValueError(f"{name} must be positive, got {value}.")
        if not 0 <= rank < world_size:
            raise ValueError(f"rank must lie in [0, world_size), got {rank} of {world_size}.")
        self.batch_size, self.rank, self.world_size = batch_size, rank, world_size
        self.seed, self.block_window, self.drop_last = seed, block_window, drop_last
        self.num_scenes, self.blocks = len(scenes), _blocks_of(scenes)
        if not len(self):
            raise ValueError(
                f"{self.num_scenes} scenes do not fill a global batch of {self._global_batch} ({world_size} ranks of "
                f"{batch_size}), so an epoch has no batch; give more scenes, a smaller batch or drop_last=False."
            )
        self._source = scenes
        self._epoch = self._consumed = 0
        self._loop: object | None = None
        self._keys: list[Key] = []
        self._batches = _prefetched(_Batches(scenes, prepare, collate, seed), self._keys, workers)

    def __len__(self) -> int:
        """Batches of an epoch, on every rank."""
        return self._batches_after(0)

    @property
    def epoch(self) -> int:
        """Epoch of the next batch: within the body of a loop, the last batch of an epoch has ended it already."""
        return self._epoch

    def __iter__(self) -> Iterator[Any]:
        """What is left of the current epoch, as collated scenes ``[S]``.

        Raises:
            RuntimeError: in a loop that goes on after a newer one has begun, or a state was loaded.
        """
        self._loop = loop = object()
        self._keys[:] = self._keys_left()
        for batch in self._batches:
            self._move(self._epoch, self._consumed + self._global_batch)
            yield batch
            if self._loop is not loop:
                raise RuntimeError("this loop over the loader has ended: a newer one began, or a state was loaded.")

    def endless(self) -> Iterator[Any]:
        """Batches of one epoch after the other, for ever."""
        while True:
            yield from self

    def state_dict(self) -> dict[str, Any]:
        """Where the loader is, after the batches that were handed out; plain numbers and text, equal on all ranks."""
        return {"epoch": self._epoch, "consumed": self._consumed, **self._order_facts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go to where another loader was; the next loop begins there.

        Ranks, batch size, ``drop_last`` and what is done to each scene may differ and are not checked. At an equal
        global batch size exactly the scenes follow that would have come.

        Args:
            state: of :meth:`state_dict`.

        Raises:
            ValueError: the state is of other scenes, of another seed or of another block window.
        """
        for name, ours in self._order_facts.items():
            if state.get(name) != ours:
                raise ValueError(
                    f"the state has {name} = {state.get(name)!r} and the loader {ours!r}, so the order of scenes would "
                    "be another; use the scenes and settings that the state was saved with, or begin anew."
                )
        self._loop = None
        self._move(int(state["epoch"]), int(state["consumed"]))

    @property
    def _global_batch(self) -> int:
        return self.world_size * self.batch_size

    @cached_property
    def _order_facts(self) -> dict[str, Any]:
        """All that decides the order of scenes in an epoch."""
        facts = {"seed": self.seed, "block_window": self.block_window, "num_scenes": self.num_scenes}
        return {**facts, "digest": _digest(self._source, self.blocks)}

    def _batches_after(self, consumed: int) -> int:
        left = self.num_scenes - consumed
        return left // self._global_batch if self.drop_last else -(-left // self._global_batch)

    def _move(self, epoch: int, consumed: int) -> None:
        self._epoch, self._consumed = (epoch, consumed) if self._batches_after(consumed) else (epoch + 1, 0)

    def _keys_left(self) -> list[Key]:
        """This rank's part of the global batches that are left of the epoch."""
        order = epoch_order(self.blocks, self.block_window, self.seed, self._epoch)
        begin = self._consumed + self.rank * self.batch_size
        first = begin + self._global_batch * torch.arange(self._batches_after(self._consumed))
        # Places past the end exist only with drop_last=False: they go round to the start of the order.
        places = (first[:, None] + torch.arange(self.batch_size)) % self.num_scenes
        return [(self._epoch, indices) for indices in order[places].tolist()]


def epoch_order(blocks: Sequence[int], window: int, seed: int, epoch: int) -> Tensor:
    """The order in which an epoch shows scenes: blocks in random order, scenes shuffled within windows of blocks.

    Args:
        blocks: number of scenes of each consecutive block of indices.
        window: blocks whose scenes are shuffled among each other.
        seed: of the run.
        epoch: number of the epoch.

    Returns:
        ``[sum(blocks)]`` int64, each index once.

    Examples:
        >>> order = epoch_order([3, 3], window=1, seed=0, epoch=0)
        >>> sorted(order[:3].tolist()) in ([0, 1, 2], [3, 4, 5])
        True
    """
    in_blocks = make_generator(seed, "epoch", epoch, "blocks")
    in_windows = make_generator(seed, "epoch", epoch)
    scenes = torch.arange(sum(blocks)).split(list(blocks))
    shuffled = [scenes[block] for block in torch.randperm(len(blocks), generator=in_blocks).tolist()]
    windows = [torch.cat(shuffled[first : first + window]) for first in range(0, len(shuffled), window)]
    return torch.cat([part[torch.randperm(len(part), generator=in_windows)] for part in windows])


class _Batches(Dataset):
    """Loads, prepares and collates; all that a worker needs to know."""

    def __init__(self, scenes: SceneSource, prepare: Prepare, collate: Callable[[list[Any]], Any], seed: int) -> None:
        self.scenes, self.prepare, self.collate, self.seed = scenes, prepare, collate, seed

    def __getitem__(self, key: Key) -> Any:
        epoch, indices = key
        return self.collate([self._prepared(epoch, index) for index in indices])

    def _prepared(self, epoch: int, index: int) -> Any:
        return self.prepare(self.scenes[index], make_generator(self.seed, "prepare", epoch, index))


def _prefetched(batches: _Batches, keys: list[Key], workers: int) -> Iterable[Any]:
    """The batches of the keys that the list holds when an iteration begins."""
    if workers:
        _allow_open_files()
    return DataLoader(
        batches,
        sampler=keys,
        batch_size=None,
        num_workers=workers,
        collate_fn=_as_it_is,
        worker_init_fn=_start_worker,
        # A forked process would inherit the threads' locks of torch.
        multiprocessing_context="spawn" if workers else None,
        persistent_workers=workers > 0,
        # DataLoader draws a seed for its workers, by default from the global generator, which is the model's.
        generator=torch.Generator(),
    )


def _allow_open_files() -> None:
    """Each tensor of a batch that a worker sends is an open file here, and usual limits are a thousand at first."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = OPEN_FILES if hard == resource.RLIM_INFINITY else min(OPEN_FILES, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _as_it_is(batch: Any) -> Any:
    return batch


def _start_worker(_: int) -> None:
    """At its end a worker leaves at once: the thread that sends its batches may be inside torch, which then aborts."""
    atexit.register(os._exit, 0)


def _blocks_of(scenes: SceneSource) -> list[int]:
    blocks = [int(count) for count in getattr(scenes, "blocks", [len(scenes)])]
    if sum(blocks) != len(scenes) or min(blocks, default=0) < 0:
        raise ValueError(f"the blocks of the scenes add up to {sum(blocks)}, but there are {len(scenes)} scenes.")
    return blocks


def _digest(scenes: SceneSource, blocks: list[int]) -> str:
    """Of the ids of the scenes, where they are known without loading any, and of the blocks that they lie in."""
    ids = getattr(scenes, "scene_ids", None)
    if ids is None and isinstance(scenes, list | tuple):
        ids = [scene.scene_id for scene in scenes]
    return hashlib.blake2b(json.dumps([ids, blocks]).encode(), digest_size=16).hexdigest()
