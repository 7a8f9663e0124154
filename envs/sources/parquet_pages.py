"""What the pages of a parquet file say of themselves, asked before a decoder believes it.

The footer of a file says how large its columns are once unpacked, and a decoder goes by the headers of the pages, which
may say anything: a damaged or malicious file of some kilobytes takes gigabytes. The headers are Thrift structs in the
compact protocol (parquet-format, ``parquet.thrift``).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

ENCODINGS = {0: "PLAIN", 2: "PLAIN_DICTIONARY", 3: "RLE", 4: "BIT_PACKED", 8: "RLE_DICTIONARY"}
"""In which every text takes its own length. In the delta encodings a byte can stand for a copy of the text before."""

_UNPACKED, _PACKED, _DATA, _DICTIONARY, _DATA_V2 = 2, 3, 5, 7, 8
_VALUES, _ENCODING, _ENCODING_V2 = 1, 2, 4
_TRUE, _FALSE, _BYTE, _DOUBLE, _BINARY, _STRUCT = 1, 2, 3, 7, 8, 12
_WHOLE = (4, 5, 6)
_DEEPEST = 8
"""Structs within structs; a page has two."""


class Page(NamedTuple):
    """Header of a page.

    Attributes:
        unpacked: bytes of the page once unpacked.
        encoding: number of it; None of a page without values.
        values: that are not in the dictionary.
    """

    unpacked: int
    encoding: int | None
    values: int


def read_pages(data: bytes, column: Any) -> Iterator[Page]:
    """The pages of one column chunk.

    Args:
        data: the file.
        column: metadata of the chunk (``pyarrow.parquet.ColumnChunkMetaData``).

    Raises:
        ValueError: they are damaged.
    """
    start = column.data_page_offset
    if column.has_dictionary_page and 0 < (column.dictionary_page_offset or 0) < start:
        start = column.dictionary_page_offset
    end, seen = start + column.total_compressed_size, 0
    if not 0 <= start <= end <= len(data):
        raise ValueError("a column lies beyond the end of the file")
    while start < end and seen < column.num_values:
        fields, start = _read_struct(data, start)
        unpacked, packed = (_int32(fields.get(key)) for key in (_UNPACKED, _PACKED))
        if unpacked < 0 or packed < 0:
            raise ValueError("a page of negative size")
        start += packed
        page = _page(fields, unpacked)
        seen += page.values
        yield page


def _page(fields: dict[int, Any], unpacked: int) -> Page:
    for key, encoding in ((_DATA, _ENCODING), (_DATA_V2, _ENCODING_V2), (_DICTIONARY, _ENCODING)):
        if isinstance(inner := fields.get(key), dict):
            values = 0 if key == _DICTIONARY else max(0, _int32(inner.get(_VALUES)))
            return Page(unpacked, _int32(inner.get(encoding)), values)
    return Page(unpacked, None, 0)


def _int32(value: Any) -> int:
    """As decoders take it, which drop what is beyond 32 bits."""
    if not isinstance(value, int):
        raise ValueError("a page header lacks a number")
    return (value + 2**31) % 2**32 - 2**31


def _read_struct(data: bytes, at: int, depth: int = 0) -> tuple[dict[int, Any], int]:
    """Numbers and structs of a struct by field id, and the place behind it."""
    fields: dict[int, Any] = {}
    number = 0
    while (head := _byte(data, at)) != 0:
        at += 1
        if head >> 4:
            number += head >> 4
        else:
            number, at = _zigzag(data, at)
        fields[number], at = _read_value(data, at, head & 15, depth)
    return fields, at + 1


def _read_value(data: bytes, at: int, kind: int, depth: int) -> tuple[Any, int]:
    """A number or a struct, or None for what is only gone past."""
    if kind in (_TRUE, _FALSE):
        return None, at
    if kind in _WHOLE:
        return _zigzag(data, at)
    if kind == _STRUCT and depth < _DEEPEST:
        return _read_struct(data, at, depth + 1)
    if kind in (_BYTE, _DOUBLE):
        return None, at + (1 if kind == _BYTE else 8)
    if kind == _BINARY:
        size, at = _varint(data, at)
        return None, at + size
    raise ValueError("a page header with a field that none has")  # lists, sets and maps


def _zigzag(data: bytes, at: int) -> tuple[int, int]:
    value, at = _varint(data, at)
    return (value >> 1) ^ -(value & 1), at


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        byte = _byte(data, at)
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
    raise ValueError("a number without an end")


def _byte(data: bytes, at: int) -> int:
    if at >= len(data):
        raise ValueError("the file ends within a page header")
    return data[at]
