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


def as_picture(name: str, source: str | os.PathLike[str] | Any) -> Picture:
    """Read a picture file, or make one of pixels.

    Args:
        name: of the picture.
        source: path of a PNG or JPEG file, kept to the byte; or an array or tensor ``[H, W]`` or ``[H, W, 3]``, uint8
            or floating point from 0 to 1, kept as PNG.

    Raises:
        ValueError: a name that is no path below a folder, or what is no picture.

    Examples:
        >>> picture = as_picture("eval/grey", np.full((4, 6), 0.5))
        >>> picture.suffix, picture.pixels.shape, int(picture.pixels[0, 0, 0])
        ('png', (4, 6, 3), 128)
    """
    _check_name("picture", name)
    if isinstance(source, str | os.PathLike):
        return _from_file(name, Path(source))
    pixels = _as_pixels(name, source)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return Picture(name, buffer.getvalue(), "png", pixels)


def _from_file(name: str, path: Path) -> Picture:
    try:
        content = path.read_bytes()
        with Image.open(io.BytesIO(content), formats=list(SUFFIXES)) as image:
            return Picture(name, content, SUFFIXES[image.format], np.asarray(image.convert("RGB")))
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"picture {name!r}: {path} is no PNG or JPEG file that can be read ({error}).") from None


def _as_pixels(name: str, source: Any) -> np.ndarray:
    source = source.detach().cpu().numpy() if hasattr(source, "detach") else np.asarray(source)
    if source.ndim not in (2, 3) or source.shape[2:] not in ((), (3,)) or not source.size:
        raise ValueError(f"picture {name!r} must be [H, W] or [H, W, 3], got the shape {list(source.shape)}.")
    if np.issubdtype(source.dtype, np.floating):
        if not ((source >= 0) & (source <= 1)).all():
            raise ValueError(f"picture {name!r} is floating point and must be from 0 to 1; scale it, or give uint8.")
        source = np.rint(source * 255).astype(np.uint8)
    if source.dtype != np.uint8:
        raise ValueError(f"picture {name!r} must be uint8, or floating point from 0 to 1, got {source.dtype}.")
    return np.repeat(source[..., None], 3, -1) if source.ndim == 2 else source


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
