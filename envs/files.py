"""Files that appear whole or not at all, whatever ends the process."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PARTIAL_PREFIX = ".partial-"
"""Of files that are being written; one is left over only by a process that was killed, until it is written again."""


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A new file beside ``path`` to write to: it takes its place when the block ends well, and is removed otherwise.

    Readers see the old file or the new one, also after a power cut. One process writes a file at a time.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.TemporaryDirectory()
        >>> path = Path(folder.name, "numbers.txt")
        >>> with whole(path) as part:
        ...     size = part.write_text("1 2 3")
        ...     path.exists()
        False
        >>> path.read_text(), [file.name for file in path.parent.iterdir()]
        ('1 2 3', ['numbers.txt'])
        >>> folder.cleanup()
    """
    part = path.with_name(f"{PARTIAL_PREFIX}{path.name}")
    try:
        yield part
        sync(part)
        os.replace(part, path)
        sync(path.parent)
    finally:
        part.unlink(missing_ok=True)


def sync(path: Path) -> None:
    """Make what was written last: the content of a file, or the names in a folder."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file like :func:`whole`."""
    with whole(path) as part:
        part.write_bytes(content)


def write_json(path: str | Path, content: Any, indent: int | None = 1) -> None:
    """Write JSON like :func:`whole`; its folder is made where it lacks.

    Raises:
        ValueError: a NaN or an infinity, which JSON does not have.
    """
    text, path = json.dumps(content, indent=indent, allow_nan=False) + "\n", Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, text.encode())
