"""Tables and pictures of a run, checked and in the one form that all loggers take."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

SUFFIXES = {"PNG": "png", "JPEG": "jpg"}
"""Formats of picture files, and how the copies are called."""


class Table(NamedTuple):
    """Attributes:
    name: ``"<group>/<table>"``.
    header: names of the columns.
    rows: each as long as the header; cells are str, bool, int, float or None.
    """

    name: str
    header: list[str]
    rows: list[list[str | float | None]]


class Picture(NamedTuple):
    """Attributes:
    name: ``"<group>/<picture>"``.
    content: of the file.
    suffix: of the file.
    pixels: ``[H, W, 3]`` uint8.
    """

    name: str
    content: bytes
    suffix: str
    pixels: np.ndarray


def as_table(name: str, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> Table:
    """Check a table; tensors and NumPy numbers of one element become plain numbers.

    Raises:
        ValueError: a name that is no path below a folder, columns without a name of their own, a row that does not fit
            the header, or a cell that is neither text nor number nor None.

    Examples:
        >>> as_table("eval/methods", ["method", "realism"], [["reference", np.float32(0.5)]]).rows
        [['reference', 0.5]]
    """
    _check_name("table", name)
    if isinstance(header, str) or not header or not all(isinstance(column, str) for column in header):
        raise ValueError(f"table {name!r} needs a header of column names, got {header!r}.")
    if len(set(header)) < len(header):
        raise ValueError(f"table {name!r} has a column twice: {list(header)}; rename one.")
    checked = []
    for row in rows:
        if isinstance(row, str) or not isinstance(row, Sequence) or len(row) != len(header):
            raise ValueError(f"table {name!r} has the columns {list(header)}, which the row {row!r} does not fit.")
        checked.append([_as_cell(name, column, cell) for column, cell in zip(header, row, strict=True)])
    return Table(name, list(header), checked)


def as_markdown(table: Table) -> str:
    r"""A table as Markdown; what is not known is a dash.

    Examples:
        >>> print(as_markdown(Table("t", ["a", "b"], [["x|y", None]])))
        | a | b |
        | --- | --- |
        | x\|y | – |
    """
    lines = [table.header, ["---"] * len(table.header), *table.rows]
    return "\n".join(f"| {' | '.join(map(_markdown_cell, line))} |" for line in lines)


def read_picture(name: str, path: str | os.PathLike[str]) -> Picture:
    """Read a picture file, which is kept to the byte.

    Args:
        name: of the picture.
        path: of a PNG or JPEG file.

    Raises:
        ValueError: a name that is no path below a folder, or what is no picture.
    """
    _check_name("picture", name)
    try:
        content = Path(path).read_bytes()
        with Image.open(io.BytesIO(content), formats=list(SUFFIXES)) as image:
            return Picture(name, content, SUFFIXES[image.format], np.asarray(image.convert("RGB")))
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"picture {name!r}: {path} is no PNG or JPEG file that can be read ({error}).") from None


def _check_name(kind: str, name: str) -> None:
    path = PurePosixPath(name)
    if not path.parts or path.is_absolute() or ".." in path.parts:
        raise ValueError(f"the name of a {kind} must be like group/name, got {name!r}.")


def _as_cell(name: str, column: str, cell: Any) -> str | float | None:
    with contextlib.suppress(AttributeError, RuntimeError, ValueError):  # no array, or one of several elements
        cell = cell.item()
    if cell is None or isinstance(cell, str | bool | int | float):
        return cell
    raise ValueError(
        f"table {name!r} has a cell in the column {column!r} that is neither text nor number: {type(cell).__name__}."
    )


def _markdown_cell(cell: str | float | None) -> str:
    return "–" if cell is None else str(cell).replace("|", "\\|").replace("\n", " ")
