"""Who does the tasks: this process, several processes, or actors on a Ray cluster. All give the same rollouts."""

from __future__ import annotations

import copy
import multiprocessing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from multiprocessing import connection
from multiprocessing.reduction import ForkingPickler
from typing import Any, Literal, NamedTuple, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from dpa.rollout.job import RolloutJob, RolloutWorker
from dpa.rollout.plan import RolloutTask
from envs.allocator import keep_freed_memory
from envs.workers import end_with_parent

GRACE = 5.0
"""Seconds in which a worker whose pipe is closed may end by itself."""


@dataclass(frozen=True)
class Workers:
    """How many do the tasks, and where.

    Attributes:
        count: workers.
        backend: ``"local"`` is this process (``count`` is 1), ``"process"`` starts processes on this machine, ``"ray"``
            actors on a Ray cluster (extra ``ray``).
        threads: of torch in each worker.
        address: of a running Ray cluster, for instance ``"auto"``; None starts one on this machine.

    Raises:
        ValueError: no worker, several in one process, or an unknown backend.
        ImportError: Ray is not installed.

    Examples:
        >>> Workers(2, "process")
        Workers(count=2, backend='process', threads=1, address=None)
    """

    count: int = 1
    backend: Literal["local", "process", "ray"] = "local"
    threads: int = 1
    address: str | None = None

    def __post_init__(self) -> None:
        if self.backend not in ("local", "process", "ray"):
            raise ValueError(f"backend must be local, process or ray, got {self.backend!r}.")
        if self.count < 1 or self.threads < 1:
            raise ValueError(
                f"count and threads of workers must be 1 or more, got count={self.count} and threads={self.threads}."
            )
        if self.backend == "local" and self.count > 1:
            raise ValueError(f"{self.count} workers need backend=process or backend=ray, got backend=local.")
        if self.backend == "ray" and find_spec("ray") is None:
            raise ImportError("workers on Ray need the extra `ray`: pip install 'dpa-omf[ray]'.")


class Outcome(NamedTuple):
    """What became of a worker's task: rollouts, an error that it raised, or neither when the worker was lost."""

    batch: TensorDictBase | None = None
    error: Exception | None = None


class Crew(Protocol):
    """Workers that each do one task at a time."""

    size: int

    def submit(self, worker: int, task: RolloutTask) -> None:
        """Give a task to a worker that has none."""

    def wait(self) -> tuple[int, Outcome]:
        """The next worker that is through with its task; a lost one has been replaced."""

    def update(self, weights: Mapping[str, Tensor] | None, seed: int) -> None:
        """Weights and seed of all tasks that are submitted from now on."""

    def close(self) -> None:
        """End the workers."""


def hire(job: RolloutJob, workers: Workers) -> Crew:
    """The crew that some :class:`Workers` stand for."""
    if workers.backend == "local":
        return LocalCrew(job)
    if workers.backend == "process":
        return ProcessCrew(job, workers)
    from dpa.rollout.ray_crew import RayCrew

    return RayCrew(job, workers)


class LocalCrew:
    """This process."""

    size = 1

    def __init__(self, job: RolloutJob) -> None:
        self._worker = RolloutWorker(job)

    def submit(self, worker: int, task: RolloutTask) -> None:
        """See :class:`Crew`."""
        self._task = task

    def wait(self) -> tuple[int, Outcome]:
        """See :class:`Crew`; an error is raised where it happens."""
        return 0, Outcome(self._worker.run(self._task))

    def update(self, weights: Mapping[str, Tensor] | None, seed: int) -> None:
        """See :class:`Crew`."""
        self._worker.update(weights, seed)

    def close(self) -> None:
        """See :class:`Crew`."""


class ProcessCrew:
    """Processes on this machine; on a machine with several GPUs each takes one in turn.

    Args:
        job: what they do.
        workers: how many.
    """

    def __init__(self, job: RolloutJob, workers: Workers) -> None:
        self.size = workers.count
        # A model on a GPU would be shared with the workers, each of which moves its own to its GPU.
        self._job, self._threads = replace(job, model=copy.deepcopy(job.model).cpu()), workers.threads
        self._latest: tuple[dict[str, Any] | None, int] = (None, job.seed)
        self._behind: set[int] = set()
        self._busy: set[int] = set()
        self._hands = [self._start(worker) for worker in range(self.size)]

    def submit(self, worker: int, task: RolloutTask) -> None:
        """See :class:`Crew`."""
        self._busy.add(worker)
        pipe = self._hands[worker].pipe
        try:
            if worker in self._behind:
                pipe.send(self._latest)
            pipe.send(task)
        except OSError:  # it is gone, which `wait` finds out
            pass
        self._behind.discard(worker)

    def wait(self) -> tuple[int, Outcome]:
        """See :class:`Crew`."""
        waited_for = {self._hands[worker].pipe: worker for worker in self._busy}
        ready = connection.wait(list(waited_for))
        worker = waited_for[ready[0]]
        self._busy.discard(worker)
        try:
            arrays, error = self._hands[worker].pipe.recv()
        except (EOFError, OSError):  # the other end is gone
            return worker, self._replace(worker)
        return worker, Outcome(None if arrays is None else _from_arrays(*arrays), error)

    def update(self, weights: Mapping[str, Tensor] | None, seed: int) -> None:
        """See :class:`Crew`."""
        arrays = self._latest[0] if weights is None else {name: value.cpu().numpy() for name, value in weights.items()}
        self._latest = (arrays, seed)
        # A worker that sends rollouts does not read, so it hears of this with its next task.
        self._behind = set(range(self.size))

    def close(self) -> None:
        """See :class:`Crew`."""
        for worker in range(self.size):
            self._end(worker)

    def _replace(self, worker: int) -> Outcome:
        """What became of a worker that is gone: killed, it has a successor; one that ended by itself is an error."""
        process = self._hands[worker].process
        process.join(GRACE)
        status = process.exitcode
        self._end(worker)
        if status is not None and status > 0:
            return Outcome(
                error=ChildProcessError(
                    f"a worker ended with exit status {status} before it could answer; what it wrote says why. A "
                    'script that starts workers needs `if __name__ == "__main__":` around what it does.'
                )
            )
        self._hands[worker] = self._start(worker)
        return Outcome()

    def _start(self, worker: int) -> _Hand:
        context = multiprocessing.get_context("spawn")  # a forked process would inherit the locks of torch's threads
        pipe, theirs = context.Pipe()
        job = replace(self._job, device=_device_of(worker, self._job.device))
        process = context.Process(target=_serve, args=(theirs, job, self._threads), daemon=True)
        process.start()
        theirs.close()
        self._behind.add(worker)
        return _Hand(process, pipe)

    def _end(self, worker: int) -> None:
        process, pipe = self._hands[worker]
        pipe.close()
        process.kill()
        process.join()


class _Hand(NamedTuple):
    process: Any
    pipe: connection.Connection


def _device_of(worker: int, device: torch.device | str) -> str:
    """``cuda`` is one GPU after the other."""
    if str(device) == "cuda" and torch.cuda.is_available():
        return f"cuda:{worker % torch.cuda.device_count()}"
    return str(device)


def _serve(pipe: connection.Connection, job: RolloutJob, threads: int) -> None:
    """Life of a worker process: tasks in, rollouts out, until the other end closes."""
    end_with_parent()
    torch.set_num_threads(threads)
    keep_freed_memory()
    worker, failed = _attempt(RolloutWorker, job)
    try:
        while True:
            message = pipe.recv()
            if isinstance(message, RolloutTask):
                pipe.send((None, failed) if failed else _attempt(lambda task: _to_arrays(worker.run(task)), message))
            elif not failed:
                weights, seed = message
                arrays = weights and {name: torch.from_numpy(value) for name, value in weights.items()}
                _, failed = _attempt(worker.update, arrays, seed)
    except (EOFError, KeyboardInterrupt):
        return


def _attempt(act: Callable[..., Any], *given: Any) -> tuple[Any, Exception | None]:
    """What comes of it, or the error, which is raised again by whoever asked."""
    try:
        return act(*given), None
    except Exception as error:
        return None, _as_sent(error)


def _as_sent(error: Exception) -> Exception:
    """An error whose constructor takes other arguments than it keeps cannot be read back."""
    try:
        ForkingPickler.dumps(copy.copy(error))  # as a pipe sends it; it is read back as it is copied
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _to_arrays(batch: TensorDictBase) -> tuple[dict[str, Any], list[int]]:
    """By value: shared memory would be lost with a worker, and would have to be cleared away after it."""
    return batch.cpu().to_dict(convert_tensors=True), list(batch.batch_size)


def _from_arrays(arrays: dict[str, Any], batch_size: list[int]) -> TensorDict:
    return TensorDict.from_dict(arrays, batch_size=batch_size)
