"""Jobs in worker processes, with one progress bar for all of them."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, NamedTuple

import torch

from envs.progress import progress, stage


class Job(NamedTuple):
    """A call to make in a worker.

    Attributes:
        function: of a module, so that a worker can import it.
        arguments: what it is called with.
        name: shown with its bars.
    """

    function: Callable[..., None]
    arguments: tuple[Any, ...]
    name: str


def run_jobs(jobs: list[Job], workers: int, threads: int, name: str) -> None:
    """Run jobs, ``workers`` at a time.

    Args:
        jobs: in the order in which they start.
        workers: processes; with 1 the jobs run in this one.
        threads: of torch in each worker.
        name: of the progress bar.

    Raises:
        Exception: the first error of a job; jobs that have not started are dropped.
    """
    if workers < 1:
        raise ValueError(f"workers must be 1 or more, got {workers}.")
    with progress(total=len(jobs), description=name, unit="job") as bar:
        if workers == 1:
            for job in jobs:
                _work(job, threads)
                bar.update()
            return
        # Forking a process that has run torch threads can hang, so workers start fresh.
        with ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn")) as pool:
            futures = [pool.submit(_work, job, threads) for job in jobs]
            try:
                for future in as_completed(futures):
                    future.result()
                    bar.update()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise


def _work(job: Job, threads: int) -> None:
    torch.set_num_threads(threads)
    with stage(job.name):
        job.function(*job.arguments)
