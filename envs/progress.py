"""Progress bars with rate and remaining time, readable in a terminal and in a log file."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TextIO

from tqdm import tqdm

LOG_INTERVAL = 10.0
"""Seconds between two lines of a bar that does not go to a terminal."""

_line: int | None = None
"""Terminal line of this process's bars, below that of the process that started it; None lets tqdm choose."""

_stages: ContextVar[tuple[str, ...]] = ContextVar("stages", default=())


class _Lines:
    """A stream that ends each redraw of a bar with a new line instead of going back to the start of the line."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> None:
        line = text.replace("\r", "").strip()
        if line:
            self.stream.write(line + "\n")

    def flush(self) -> None:
        self.stream.flush()


def use_line(line: int, lock: object) -> None:
    """Give the bars of this process a terminal line of their own, for processes that draw at the same time.

    Args:
        line: 0 for the process that starts the others; its bars stay when they end, those below it are erased.
        lock: shared by all the processes that draw.
    """
    global _line
    _line = line
    tqdm.set_lock(lock)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Name a part of a run; the bars opened inside carry the names of all stages around them.

    Args:
        name: a short name, for instance ``"pretrain"``.

    Examples:
        >>> with stage("compare"), stage("pretrain"):
        ...     progress(range(3), "batches").desc
        'compare > pretrain > batches'
    """
    token = _stages.set((*_stages.get(), name))
    try:
        yield
    finally:
        _stages.reset(token)


def full_name(description: str) -> str:
    """What a bar is called here: the names of the surrounding :func:`stage`, then its own.

    Args:
        description: what is counted.

    Examples:
        >>> with stage("align 0 dpo"):
        ...     full_name("ipo")
        'align 0 dpo > ipo'
    """
    return " > ".join((*_stages.get(), description))


def progress(
    iterable: Iterable | None = None,
    description: str = "",
    *,
    total: int | None = None,
    initial: int = 0,
    unit: str = "it",
    disable: bool = False,
    stream: TextIO | None = None,
) -> tqdm:
    """A progress bar with count, rate and remaining time.

    Bars inside bars are erased when they end; the outermost stays. Where the stream is not a terminal, each bar prints
    one plain line every :data:`LOG_INTERVAL` seconds at most, and one when it ends.

    Args:
        iterable: what to go through; ``None`` for a bar that is moved with ``update(n)``.
        description: what is counted; the names of the surrounding :func:`stage` come before it.
        total: number of items; by default the length of ``iterable``.
        initial: items done before a resume; they do not count for the rate.
        unit: name of one item.
        disable: show nothing.
        stream: where the bar goes; standard error by default.

    Returns:
        The bar: iterate over it, or use it as a context manager and call ``update``; ``set_postfix`` shows values.

    Examples:
        >>> import io
        >>> log = io.StringIO()
        >>> list(progress([1, 2], "scenes", unit="scene", stream=log))
        [1, 2]
        >>> log.getvalue().splitlines()[-1].startswith("scenes: 100%")
        True
    """
    stream = stream or sys.stderr
    terminal = stream.isatty()
    return tqdm(
        iterable,
        desc=full_name(description),
        total=total,
        initial=initial,
        unit=unit,
        disable=disable,
        file=stream if terminal else _Lines(stream),
        mininterval=0.2 if terminal else LOG_INTERVAL,
        # Plain lines have no cursor to move: every bar writes at position 0.
        position=_line if terminal else 0,
        leave=not _line if terminal else True,
        ascii=not terminal,
        ncols=None if terminal else 100,
        dynamic_ncols=terminal,
    )


def message(text: str, stream: TextIO | None = None) -> None:
    """Say one thing above the bars, without tearing them.

    Args:
        text: one line or several.
        stream: where the bars go; standard error by default.

    Examples:
        >>> import io
        >>> log = io.StringIO()
        >>> message("lower the learning rate", log)
        >>> log.getvalue().splitlines()
        ['lower the learning rate']
    """
    tqdm.write(text, file=stream or sys.stderr)
