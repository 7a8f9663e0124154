"""Shards as bytes: their names, their limit, and their top-level fields one by one.

A shard is one ``SimAgentsChallengeSubmission`` of some hundred megabytes. Its scenarios are length-delimited fields
behind each other, so that they are appended and read singly; no shard is ever in memory.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

from dpa.realism.submission.messages import CorruptError

MAX_SHARD_BYTES = 2_000_000_000
"""A shard must be smaller (realism.md section 9)."""
SHARD_NAME = re.compile(r"[^/\\]*\.binproto(-(\d{5})-of-(\d{5}))?")
"""What a shard may be called; the groups are the suffix, its number and the number of shards."""
ROLLOUTS_FIELD = 1
"""Number of ``scenario_rollouts``."""
_VARINT, _FIXED64, _DELIMITED, _FIXED32 = 0, 1, 2, 5
_VARINT_BYTES = 10


class Field(NamedTuple):
    """A top-level field of a message.

    Attributes:
        number: of the field.
        head: tag, and the length where there is one.
        body: the value.
    """

    number: int
    head: bytes
    body: bytes


def shard_name(number: int, total: int) -> str:
    """Name of a shard.

    Examples:
        >>> shard_name(7, 150)
        'submission.binproto-00007-of-00150'
    """
    return f"submission.binproto-{number:05d}-of-{total:05d}"


def varint(value: int) -> bytes:
    r"""A number of base 128, the lowest seven bits first.

    Examples:
        >>> varint(300)
        b'\xac\x02'
    """
    parts = []
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*parts, value])


def rollouts_head(size: int) -> bytes:
    r"""What stands before the bytes of a ``ScenarioRollouts`` in a shard.

    Examples:
        >>> rollouts_head(300)
        b'\n\xac\x02'
    """
    return varint(ROLLOUTS_FIELD << 3 | _DELIMITED) + varint(size)


def walk(file: BinaryIO, size: int, name: str) -> Iterator[Field]:
    r"""The top-level fields of a message, one at a time.

    Args:
        file: at the first byte of the message.
        size: of the message.
        name: what errors call the file.

    Raises:
        CorruptError: the bytes are no message, or end within a field.

    Examples:
        >>> import io
        >>> list(walk(io.BytesIO(rollouts_head(3) + b"abc"), 5, "shard"))
        [Field(number=1, head=b'\n\x03', body=b'abc')]
    """
    position = 0
    while position < size:
        field = _read_field(file, position, size, name)
        position += len(field.head) + len(field.body)
        yield field


def _read_field(file: BinaryIO, position: int, size: int, name: str) -> Field:
    tag, head = _read_varint(file, position, size, name)
    number, kind = tag >> 3, tag & 7
    if not number or kind not in (_VARINT, _FIXED64, _DELIMITED, _FIXED32):
        raise CorruptError(f"{name}: byte {position} starts no field of a proto message; write the file again.")
    if kind == _VARINT:
        return Field(number, head, _read_varint(file, position + len(head), size, name)[1])
    length = {_FIXED64: 8, _FIXED32: 4}.get(kind)
    if length is None:
        length, more = _read_varint(file, position + len(head), size, name)
        head += more
    if position + len(head) + length > size:
        raise CorruptError(
            f"{name}: ends within the field of {length} bytes that starts at byte {position}; write the file again."
        )
    return Field(number, head, _exactly(file, length, name))


def _read_varint(file: BinaryIO, position: int, size: int, name: str) -> tuple[int, bytes]:
    """A number and its bytes."""
    value, read = 0, b""
    while len(read) < _VARINT_BYTES and position + len(read) < size:
        byte = _exactly(file, 1, name)
        value |= (byte[0] & 0x7F) << 7 * len(read)
        read += byte
        if byte[0] < 0x80:
            return value, read
    raise CorruptError(f"{name}: a number at byte {position} does not end; write the file again.")


def _exactly(file: BinaryIO, count: int, name: str) -> bytes:
    data = file.read(count)
    if len(data) != count:
        raise CorruptError(f"{name}: ends before its time; write the file again.")
    return data
