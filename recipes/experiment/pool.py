"""Jobs in worker processes, with one progress bar for all of them."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import takewhile
from typing import Any, NamedTuple

import torch

from envs.allocator import keep_freed_memory
from envs.progress import message, progress, stage, use_line
from envs.workers import end_with_parent, lots_done


class Job(NamedTuple):
    """A call to make in a worker.

    Attributes:
        function: of a module, so that a worker can import it.
        arguments: what it is called with.
        name: shown with its bars.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    name: str


class Workers:
    """Worker processes that live as long as the block, so that each imports torch once for many lots of jobs.

    Args:
        count: processes; with 1 the jobs run in this one.
        threads: of torch in each worker.
        spread: give each worker one of the GPUs, in turn.

    Raises:
        ValueError: no worker.
    """

    def __init__(self, count: int, threads: int, *, spread: bool = False) -> None:
        if count < 1:
            raise ValueError(f"workers must be 1 or more, got {count}.")
        self.count, self.threads, self.spread = count, threads, spread
        self._pool: ProcessPoolExecutor | None = None

    def __enter__(self) -> Workers:
        if self.count > 1:
            # Forking a process that has run torch threads can hang, so workers start fresh.
            context = multiprocessing.get_context("spawn")
            started, lock = context.Value("i", 0), context.RLock()
            use_line(0, lock)
            gpus = _gpus() if self.spread else []
            self._pool = ProcessPoolExecutor(self.count, context, _start, (lock, started, gpus))
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def run(self, jobs: list[Job], name: str) -> Iterator[tuple[str, float, Any]]:
        """Run jobs, as many at a time as there are workers; gives name, seconds and result of each as it ends.

        Args:
            jobs: in the order in which they start.
            name: of the progress bar.

        Raises:
            ChildProcessError: a worker was killed.
            Exception: the first error of a job. It is told at once; jobs that have not started are dropped, and those
                under way end first, so that what they did is not lost.
        """
        if self._pool is None:
            for job in progress(jobs, name, unit="job"):
                yield job.name, *_work(job, self.threads)
            return
        pool, failed = self._pool, None
        wanted = takewhile(lambda _: failed is None, jobs)
        with progress(total=len(jobs), description=name, unit="job") as bar:
            for lot in lots_done(lambda job: pool.submit(_work, job, self.threads), wanted, self.count):
                for job, future in lot:
                    error = future.exception()
                    if error is None:
                        yield job.name, *future.result()
                    elif isinstance(error, BrokenProcessPool):
                        raise ChildProcessError(
                            f"a worker of {name!r} was killed, perhaps for want of memory; run it again with workers=1."
                        ) from error
                    elif failed is None:
                        failed = error
                        message(f"{job.name}: {failed} (jobs under way end first)")
                    bar.update()
        if failed is not None:
            raise failed


def _gpus() -> list[str]:
    """Names of the GPUs that this process may use."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    return named.split(",") if named else [str(number) for number in range(torch.cuda.device_count())]


def _start(lock: Any, started: Any, gpus: list[str]) -> None:
    """End with the parent, draw on a line of the terminal of one's own below the bar of all jobs, and see one GPU."""
    end_with_parent()
    keep_freed_memory()
    with started.get_lock():
        started.value += 1
        use_line(started.value, lock)
        if gpus:  # read when CUDA is first used, which it has not been here
            os.environ["CUDA_VISIBLE_DEVICES"] = gpus[(started.value - 1) % len(gpus)]


def _work(job: Job, threads: int) -> tuple[float, Any]:
    torch.set_num_threads(threads)
    start = time.perf_counter()
    with stage(job.name):
        result = job.function(*job.arguments)
    return time.perf_counter() - start, result
