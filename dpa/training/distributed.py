"""Several processes that share each batch, started by ``torchrun``; one process alone is the plain case.

The gradient of a global batch is the sum over ranks of what each adds with its part, so nothing but rounding depends on
the number of ranks: batches are pure functions of (seed, place), shares are of the global batch, and rank 0's files are
the run. ``DistributedDataParallel`` averages gradients; :func:`~dpa.training.optim.accumulate_gradients` makes that a
sum.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from envs.seeding import make_generator

T = TypeVar("T")
VARIABLES = ("RANK", "WORLD_SIZE", "LOCAL_RANK")
"""What torchrun tells each process that it starts."""


@dataclass(frozen=True)
class Ranks:
    """This process among those that train together; alone by default, and then every method does nothing.

    Attributes:
        rank: of this process.
        world_size: number of processes on all machines.
        local_rank: of this process on its machine: the GPU that it takes.

    Examples:
        >>> second = Ranks(rank=1, world_size=2)
        >>> second.main, second.mine(["a", "b", "c"]), second.share_of(8, "batch_size")
        (False, ['b'], 4)
        >>> Ranks().mine(["a", "b", "c"]), Ranks().place("cuda")
        (['a', 'b', 'c'], 'cuda')
    """

    rank: int = 0
    world_size: int = 1
    local_rank: int = 0

    @property
    def main(self) -> bool:
        """Whether this is the process that writes files and talks."""
        return self.rank == 0

    @property
    def alone(self) -> bool:
        """Whether there is no other process."""
        return self.world_size == 1

    def place(self, device: str) -> str:
        """The device of this rank: ``cuda`` becomes the GPU of its local rank.

        Raises:
            ValueError: one GPU for several ranks, or more ranks on this machine than GPUs.
        """
        if self.alone or torch.device(device).type != "cuda":
            return device
        if torch.device(device).index is not None:
            raise ValueError(f"device={device} is one GPU and {self.world_size} ranks need one each; say device=cuda.")
        if self.local_rank >= torch.cuda.device_count():
            raise ValueError(
                f"rank {self.rank} is process {self.local_rank + 1} of its machine, which has "
                f"{torch.cuda.device_count()} GPUs; start torchrun with --nproc-per-node {torch.cuda.device_count()}."
            )
        return f"cuda:{self.local_rank}"

    def share_of(self, batch_size: int, name: str) -> int:
        """Items of each rank in a batch of all ranks.

        Args:
            batch_size: items of all ranks together.
            name: of the option, for the error.

        Raises:
            ValueError: the ranks cannot share it equally.
        """
        if batch_size % self.world_size:
            fitting = -(-batch_size // self.world_size) * self.world_size
            raise ValueError(
                f"{name}={batch_size} is the batch of all {self.world_size} ranks together and must be a multiple of "
                f"their number; say {name}={fitting}, or start another number of processes."
            )
        return batch_size // self.world_size

    def mine(self, items: Sequence[T]) -> Sequence[T]:
        """This rank's part of what all ranks know: every ``world_size``-th item."""
        return items[self.rank :: self.world_size]

    def wrap(self, loss: nn.Module) -> nn.Module:
        """The loss module as one whose backward pass averages the gradients of all ranks.

        Every parameter must take part in every pass: ranks exchange them all, and would wait for one that has none.
        """
        if self.alone:
            return loss
        shared = DistributedDataParallel(loss)
        shared.broadcast_buffers = False  # bins, frequencies and the frozen reference are constants
        return shared

    def sum(self, values: Tensor) -> Tensor:
        """Sum over ranks, element by element, as float64 on the CPU; the values themselves for a process alone.

        Args:
            values: ``[...]``, of one shape on all ranks.
        """
        if self.alone:
            return values
        total = values.detach().to("cpu", torch.float64, copy=True)
        distributed.all_reduce(total)
        return total

    def sum_figures(self, figures: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Sum over ranks of named numbers, which have the same names on all ranks."""
        if self.alone:
            return dict(figures)
        names = sorted(figures)
        total = self.sum(torch.stack([figures[name].double() for name in names]))
        return {name: value.to(figures[name].dtype) for name, value in zip(names, total, strict=True)}

    def agree(self, value: int, what: str, where: object) -> int:
        """A number that each rank has read from a folder, which must be one folder for all of them.

        Raises:
            ValueError: this rank has read another number than rank 0.
        """
        seen = torch.zeros(self.world_size, dtype=torch.float64)
        seen[self.rank] = value
        first = int(self.sum(seen)[0])
        if value != first:
            raise ValueError(
                f"rank {self.rank} finds {what} {int(value)} in {where} and rank 0 finds {first}; give a folder that "
                "all machines share."
            )
        return value

    def wait(self) -> None:
        """Until all ranks have come here."""
        self.sum(torch.zeros(1))

    def seed_dropout(self, seed: int, step: int) -> None:
        """Seed the global generator of torch for one step, so that dropout differs between ranks and steps.

        It depends on nothing but the seed, the step and the rank, so a run that is resumed draws what it would have
        drawn. A process alone is left alone: its generators lie in the checkpoint.
        """
        if not self.alone:
            torch.manual_seed(make_generator(seed, "dropout", step, self.rank).initial_seed())


ALONE = Ranks()
"""The only process."""


def started_ranks() -> Ranks:
    """This process among those that torchrun has started, as its environment says.

    Raises:
        ValueError: the environment says only a part of it.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return ALONE
    missing = [name for name in VARIABLES if name not in os.environ]
    if missing:
        raise ValueError(
            f"WORLD_SIZE={os.environ['WORLD_SIZE']} but {missing[0]} is not set; start the processes with torchrun, or "
            "unset WORLD_SIZE."
        )
    return Ranks(*(int(os.environ[name]) for name in VARIABLES))


@contextmanager
def join_ranks(device: str) -> Iterator[Ranks]:
    """Meet the other processes that torchrun has started, and part when all have done.

    Counts and figures go through gloo on the CPU, so they never wait for a GPU; gradients on a GPU go through NCCL.
    After an error nothing is waited for: this process ends, and torchrun ends the others.

    Args:
        device: ``cpu`` or ``cuda``, as for :meth:`Ranks.place`.

    Raises:
        ValueError: this rank has no device.

    Examples:
        >>> with join_ranks("cpu") as ranks:  # not started by torchrun
        ...     ranks.world_size
        1
    """
    ranks = started_ranks()
    if ranks.alone:
        yield ranks
        return
    placed = torch.device(ranks.place(device))
    if placed.type == "cuda":
        torch.cuda.set_device(placed)
    distributed.init_process_group("cpu:gloo,cuda:nccl" if placed.type == "cuda" else "gloo")
    yield ranks
    ranks.wait()
    distributed.destroy_process_group()


def without_sync(loss: Any, last: bool) -> AbstractContextManager:
    """Around a pass over a part of a batch: only the last part's backward pass exchanges gradients between ranks."""
    return loss.no_sync() if isinstance(loss, DistributedDataParallel) and not last else nullcontext()
