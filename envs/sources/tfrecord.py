"""TFRecord files: frames of ``length (u64), crc(length), payload, crc(payload)``, little endian (realism.md 9)."""

from __future__ import annotations

import gzip
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import BinaryIO

import google_crc32c

from envs.scene import SceneError

_HEADER = struct.Struct("<QI")
_FOOTER = struct.Struct("<I")
_CRC_MASK = 0xA282EAD8
_GZIP_MAGIC = b"\x1f\x8b\x08"
MAX_PAYLOAD = 1 << 25
"""No record is larger [bytes]; a scene of WOMD has about a million. Decoded, two bytes can take a hundred."""


def masked_crc(data: bytes) -> int:
    """The checksum of TFRecord: CRC32C, rotated right by 15 bits, plus a constant.

    It is masked so that data which contain their own checksums still get a useful one.

    Examples:
        >>> hex(masked_crc(b""))
        '0xa282ead8'
    """
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + _CRC_MASK) & 0xFFFFFFFF


def frame(payload: bytes) -> bytes:
    """One record as it lies in the file.

    Examples:
        >>> len(frame(b"four"))
        20
    """
    length = struct.pack("<Q", len(payload))
    return length + _FOOTER.pack(masked_crc(length)) + payload + _FOOTER.pack(masked_crc(payload))


def read_frames(file: BinaryIO, name: str) -> Iterator[Callable[[], bytes]]:
    """Go through the frames of an open file once; payloads that nobody reads are skipped.

    Args:
        file: of :func:`unpacked`.
        name: what errors call the file.

    Yields:
        For each frame a function that reads and checks its payload; it works until the next frame is asked for.

    Raises:
        SceneError: naming the file and the first record whose frame is broken; the rest of the file is lost.
    """
    position = record = 0
    while head := read_bytes(file, _HEADER.size, f"{name}, record {record}"):
        length = _length(head)
        if len(head) < _HEADER.size:
            raise SceneError(f"{name}, record {record}: the file ends within the record; fetch the file again.")
        if length is None:
            raise SceneError(
                f"{name}, record {record}: the checksum of the record's length is wrong at byte {position}; "
                "this is no TFRecord file, or it is damaged: fetch it again."
            )
        if length > MAX_PAYLOAD:
            raise SceneError(f"{name}, record {record}: claims {length} bytes; at most {MAX_PAYLOAD} are read.")
        yield partial(_read_payload, file, length, f"{name}, record {record}")
        position, record = position + _frame_size(length), record + 1
        _seek(file, position, f"{name}, record {record}")
    if record == 0:
        raise SceneError(f"{name}: the file is empty; fetch it again.")


def count_frames(file: BinaryIO) -> int:
    """Frames of a file that is not packed, from the headers alone; a broken one counts and is the last."""
    size = file.seek(0, os.SEEK_END)
    position = count = 0
    while position < size:
        file.seek(position)
        length = _length(file.read(_HEADER.size))
        count += 1
        if length is None:
            break
        position += _frame_size(length)
    return max(count, 1)


@contextmanager
def unpacked(file: BinaryIO) -> Iterator[BinaryIO]:
    """The content of a file that may be packed by gzip, which is recognised by its first bytes."""
    if is_packed(file):
        with gzip.open(file, "rb") as content:
            yield content
    else:
        yield file


def is_packed(file: BinaryIO) -> bool:
    """Whether gzip has packed a file, which is left at its beginning."""
    head = file.read(_HEADER.size)
    file.seek(0)
    return head.startswith(_GZIP_MAGIC) and _length(head) is None


def read_bytes(file: BinaryIO, size: int, name: str) -> bytes:
    """Bytes of a file that may be packed, fewer than asked for where it ends.

    Args:
        file: of :func:`unpacked`.
        size: how many.
        name: what errors call the file and record.

    Raises:
        SceneError: it cannot be unpacked.
    """
    try:
        return file.read(size)
    except (EOFError, OSError, zlib.error) as error:
        raise SceneError(f"{name}: cannot be unpacked or read ({error}); fetch the file again.") from error


def _read_payload(file: BinaryIO, length: int, name: str) -> bytes:
    body = read_bytes(file, length + _FOOTER.size, name)
    if len(body) != length + _FOOTER.size:
        raise SceneError(f"{name}: the file ends within the record; fetch the file again.")
    payload = body[:length]
    if _FOOTER.unpack(body[length:])[0] != masked_crc(payload):
        raise SceneError(f"{name}: the checksum of the record is wrong; the file is damaged: fetch it again.")
    return payload


def _seek(file: BinaryIO, position: int, name: str) -> None:
    try:
        file.seek(position)
    except (EOFError, OSError, ValueError, zlib.error) as error:
        raise SceneError(f"{name}: cannot be unpacked or read ({error}); fetch the file again.") from error


def _length(head: bytes) -> int | None:
    """Payload length of a frame header, or nothing where the header does not fit its checksum."""
    if len(head) < _HEADER.size:
        return None
    length, crc = _HEADER.unpack(head)
    return length if crc == masked_crc(head[:8]) else None


def _frame_size(length: int) -> int:
    return _HEADER.size + length + _FOOTER.size
