"""Run independent tasks, here or in several processes, and hear of each scene as it is made."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
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
        SceneError: a worker was killed, or could not start.

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
    pool, counted = ProcessPoolExecutor(workers, context, _start_worker, (made,)), 0
    try:
        for lot in lots_done(lambda task: pool.submit(_work_and_count, work, task), tasks, workers, _POLL_SECONDS):
            tick(made.value - counted)
            counted = made.value
            for task, future in lot:
                future.result()
                yield task
    except BrokenProcessPool as error:
        raise SceneError(
            "a worker ended: what it said stands above; if nothing, it was killed, perhaps for want of memory: run it "
            "again with fewer workers or smaller shards."
        ) from error
    finally:
        pool.shutdown()


def require_guarded_main() -> None:
    """Refuse to go on in a worker that runs its parent's script again, since the script starts workers unguarded.

    Python refuses only the start of a process there. What comes before it, such as the wait for a lock that the parent
    holds, would never end.

    Raises:
        RuntimeError: this is such a worker.

    Examples:
        >>> require_guarded_main()
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # what multiprocessing.spawn itself looks at
        raise RuntimeError(
            "a worker runs the script that started it from the top; put what starts workers under "
            '`if __name__ == "__main__":`, or use workers=1.'
        )


def lots_done(
    submit: Callable[[Task], Future], tasks: Iterable[Task], workers: int, seconds: float | None = None
) -> Iterator[list[tuple[Task, Future]]]:
    """Keep every worker of a pool at work, and give back what is done, in any order.

    A pool starts whatever it has been handed, even when it is told to stop; so it is handed no more than it has hands.

    Args:
        submit: hands a task to the pool.
        tasks: taken one at a time, when a worker is free; once they end, what is under way is waited for.
        workers: of the pool.
        seconds: to wait at most until the next lot, which may then be empty; None waits until a task is done.

    Examples:
        >>> from concurrent.futures import ThreadPoolExecutor
        >>> with ThreadPoolExecutor(2) as pool:
        ...     lots = list(lots_done(lambda task: pool.submit(abs, task), [-1, -2, -3], workers=2))
        >>> sorted((task, future.result()) for lot in lots for task, future in lot)
        [(-3, 3), (-2, 2), (-1, 1)]
    """
    waiting, running = iter(tasks), dict[Future, Task]()
    while True:
        for task in islice(waiting, workers - len(running)):
            running[submit(task)] = task
        if not running:
            return
        done = wait(running, seconds, FIRST_COMPLETED).done
        yield [(running.pop(future), future) for future in done]


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
