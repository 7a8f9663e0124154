"""Inputs on this machine or behind an address: ``data/*.json``, ``gs://bucket/folder``, ``s3://``, ``https://``.

Addresses are read by fsspec, which needs a package of its own for some of them (gcsfs for ``gs://``, s3fs for ``s3://``).
"""

from __future__ import annotations

import glob
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import fsspec

from envs.scene import SceneError


def is_remote(path: str) -> bool:
    """Whether a path is an address.

    Examples:
        >>> is_remote("gs://bucket/training.tfrecord"), is_remote("data/training.tfrecord")
        (True, False)
    """
    return "://" in path


def find_files(paths: Sequence[str], *patterns: str) -> list[str]:
    """Expand files, folders and patterns to files, in the order given and sorted within each.

    Args:
        paths: a file is taken whatever its name; a folder gives the files below it whose name fits one of ``patterns``;
            anything else must be a pattern that matches something, files or folders. Local paths or addresses.
        patterns: shell patterns of file names.

    Raises:
        SceneError: for a path that gives no file, or an address that cannot be read.
    """
    files: list[str] = []
    for path in map(str, paths):
        found, is_folder = (_find_remote if is_remote(path) else _find_local)(path, patterns)
        if not found:
            fix = "give files, folders or patterns that exist"
            if is_folder:
                fix = f"a folder must hold files named {' or '.join(patterns)}"
            raise SceneError(f"{path}: no input there; {fix}.")
        files += found
    return files


def _find_local(path: str, patterns: Sequence[str]) -> tuple[list[str], bool]:
    """Files, and whether the path is a folder."""
    if Path(path).is_dir():
        return sorted({str(f) for pattern in patterns for f in Path(path).rglob(pattern) if f.is_file()}), True
    if Path(path).is_file():
        return [path], False
    matches = sorted(glob.glob(path, recursive=True))
    # Of a recursive pattern a folder matches beside the files in it.
    return list(dict.fromkeys(file for match in matches for file in _find_local(match, patterns)[0])), False


def _find_remote(path: str, patterns: Sequence[str]) -> tuple[list[str], bool]:
    with _named_errors(path):
        system, inner = fsspec.core.url_to_fs(path)
        if system.isfile(inner):
            return [path], False
        is_folder = system.isdir(inner)
        names = []
        for match in [inner] if is_folder else sorted(system.glob(inner)):
            if system.isdir(match):
                below = system.find(match)
                names += sorted(n for n in below if any(fnmatch(PurePosixPath(n).name, each) for each in patterns))
            else:
                names.append(match)
        return list(dict.fromkeys(map(system.unstrip_protocol, names))), is_folder


def file_size(path: str) -> int:
    """Bytes of a file; 0 where a server does not tell.

    Raises:
        SceneError: it cannot be read.
    """
    with _named_errors(path):
        if is_remote(path):
            system, inner = fsspec.core.url_to_fs(path)
            return system.size(inner) or 0
        return Path(path).stat().st_size


@contextmanager
def open_file(path: str) -> Iterator[BinaryIO]:
    """Open a file for reading, as bytes.

    Raises:
        SceneError: it cannot be opened.
    """
    with _named_errors(path):
        file: Any = fsspec.open(path, "rb").open()
    with file:
        yield file


def read_file(path: str, limit: int) -> bytes:
    """All bytes of a file.

    Args:
        path: local or an address.
        limit: most bytes that a sound file has.

    Raises:
        SceneError: it cannot be read, or is larger.
    """
    with open_file(path) as file, _named_errors(path):
        data = file.read(limit + 1)
    if len(data) > limit:
        raise SceneError(f"{path}: has more than {limit} bytes; that is no file of one scene.")
    return data


@contextmanager
def _named_errors(path: str) -> Iterator[None]:
    """Say which file it was, whatever a file system raises."""
    try:
        yield
    except (OSError, ValueError, ImportError) as error:
        raise SceneError(f"{path}: cannot be read ({str(error) or type(error).__name__}).") from error
