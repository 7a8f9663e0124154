"""Run independent tasks, here or in several processes, and hear of each scene as it is made."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any, TypeVar

import torch

from envs.scene import SceneError

Task = TypeVar("Task")
Work = Callable[[Task, Callable[[int], Any]], None]

_POLL_SECONDS = 0.2
"""How often the progress of the workers is looked at."""


def run_tasks(work: Work, tasks: Sequence[Task], workers: int, tick: Callable[[int], Any]) -> Iterator[Task]:
    """Do every task and give it back when it is done, in any order.

    After a failure no further task is started; those under way are finished first.

    Args:
        work: a function that can be imported by name, called with a task and with ``tick``.
        tasks: what to do.
        workers: processes; 1 works in this one.
        tick: called with the number of scenes made since the last call.

    Raises:
        SceneError: a worker was killed.

    Examples:
        >>> counted = []
        >>> done = list(run_tasks(lambda task, tick: tick(task), [1, 2], workers=1, tick=counted.append))
        >>> done, counted
        ([1, 2], [1, 2])
    """
    if workers > 1:
        yield from _run_in_pool(work, tasks, workers, tick)
        return
    for task in tasks:
        work(task, tick)
        yield task


def _run_in_pool(work: Work, tasks: Sequence[Task], workers: int, tick: Callable[[int], Any]) -> Iterator[Task]:
    context = multiprocessing.get_context("spawn")  # a forked process would inherit the threads' locks of torch
    made = context.Value("q", 0)
    pool = ProcessPoolExecutor(workers, context, _start_worker, (made,))
    waiting, running, counted = iter(tasks), dict[Future, Task](), 0
    try:
        while True:
            # A pool starts whatever it has been handed, even when it is told to stop: so no more than it has hands.
            for task in islice(waiting, workers - len(running)):
                running[pool.submit(_work_and_count, work, task)] = task
            if not running:
                break
            done, _ = wait(running, _POLL_SECONDS, FIRST_COMPLETED)
            tick(made.value - counted)
            counted = made.value
            for future in done:
                future.result()
                yield running.pop(future)
    except BrokenProcessPool as error:
        raise SceneError(
            "a worker was killed, perhaps for want of memory; run it again with fewer workers or smaller shards."
        ) from error
    finally:
        pool.shutdown()


_made: Any = None
"""In a worker: the counter that it shares with its parent."""


def _start_worker(made: Any) -> None:
    global _made
    _made = made
    torch.set_num_threads(1)
    end_with_parent()


def end_with_parent() -> None:
    """Called in a worker: end it when its parent is killed, which could not tell it to stop."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work_and_count(work: Work, task: Task) -> None:
    work(task, _count)


def _count(scenes: int) -> None:
    with _made.get_lock():
        _made.value += scenes
