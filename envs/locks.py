"""One command at a time in a folder."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from envs.progress import message


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other commands out of a folder as long as the block runs; a file system without locks is told.

    Raises:
        ValueError: another one is at work there.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, alone_in(Path(folder)):
        ...     try:
        ...         alone_in(Path(folder)).__enter__()
        ...     except ValueError as error:
        ...         "at work" in str(error)
        True
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(
                f"another command is at work in {folder}; wait for it, or name another output folder."
            ) from None
        except OSError as error:  # Lustre without -o flock, NFS without its lock daemon
            message(f"{folder} cannot be locked ({error.strerror}); see that no other command writes there.")
        yield
