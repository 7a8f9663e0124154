"""Files that appear whole or not at all, whatever ends the process."""

from __future__ import annotations

import io
import json
import math
import os
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

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


def check_file(path: str | Path | None, told: str) -> None:
    """Refuse a result that cannot be written because a folder has its name, before any work; None asks for none.

    Args:
        path: where it is to be.
        told: what stands before it on the command line, ``"json="`` or ``"--json "``.

    Raises:
        ValueError: it is a folder.

    Examples:
        >>> check_file(".", "--json ")
        Traceback (most recent call last):
            ...
        ValueError: --json . is a folder; name a file.
    """
    if path is not None and Path(path).is_dir():
        raise ValueError(f"{told}{path} is a folder; name a file.")


def sync(path: Path) -> None:
    """Make what was written last: the content of a file, or the names in a folder."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


BROKEN_ARRAYS = (
    *(OSError, ValueError, EOFError, KeyError, RuntimeError, OverflowError, SyntaxError, TypeError),
    *(UserWarning, struct.error, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
"""What numpy and zipfile raise over files of arrays that are damaged."""
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
MOST_BYTES = 1 << 31
"""Of one array: a few bytes of an archive may say that they are more than any memory has."""


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an ``.npz``; nothing is unpickled.

    Raises:
        ValueError: it cannot be read; the message names it.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "a.npz")
        ...     np.savez(path, x=np.zeros(2))
        ...     read_arrays(path)
        {'x': array([0., 0.])}
    """
    try:
        with zipfile.ZipFile(path) as archive, warnings.catch_warnings():
            warnings.simplefilter("error")  # of headers that are mended by guessing
            if max((info.file_size for info in archive.infolist()), default=0) > MOST_BYTES:
                raise ValueError("an array of more than 2 GiB")
            return {name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()}
    except BROKEN_ARRAYS as error:
        reason = "".join(letter for letter in str(error)[:200] if letter.isascii() and letter.isprintable())
        raise ValueError(
            f"{path} cannot be read as .npz ({reason or type(error).__name__}); write it again with numpy.savez."
        ) from None


def _array(data: bytes) -> np.ndarray:
    """The array of an ``.npy``; as large as its header says, or none."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(f"version {version} of the format")
    shape, fortran, dtype = HEADERS[version](stream)
    content = bytearray(data[stream.tell() :])
    if dtype.hasobject:
        raise ValueError("an array of objects")
    if math.prod(shape) * dtype.itemsize != len(content) or min(shape, default=0) < 0:
        raise ValueError(f"{len(content)} bytes of an array of shape {shape} and type {dtype}")
    if not content:
        return np.empty(shape, dtype)
    return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")


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
