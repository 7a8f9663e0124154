"""TFRecord files: frames of ``length (u64), crc(length), payload, crc(payload)``, little endian (SPEC section 9)."""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import google_crc32c

from envs.scene import SceneError

_HEADER = struct.Struct("<QI")
_FOOTER = struct.Struct("<I")
_CRC_MASK = 0xA282EAD8
_GZIP_MAGIC = b"\x1f\x8b\x08"


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


def open_binary(path: str) -> BinaryIO:
    """Open a file for reading; gzip is recognised by its first bytes and unpacked on the way."""
    with Path(path).open("rb") as file:
        head = file.read(_HEADER.size)
    packed = head.startswith(_GZIP_MAGIC) and _length(head) is None
    return gzip.open(path, "rb") if packed else Path(path).open("rb")


def offsets(path: str) -> Iterator[int]:
    """Byte offset of every frame (in the unpacked file), from the headers alone: payloads are skipped, not checked.

    Raises:
        SceneError: naming the file and the first record whose frame is broken; frames before it have been given.
    """
    with open_binary(path) as file:
        # Seeking beyond the end is no error, so a cut last payload shows only against the size of the file.
        size = _size(file, path)
        if size == 0:
            raise SceneError(f"{path}: the file is empty; fetch it again.")
        position, record = 0, 0
        while position < size:
            file.seek(position)
            head = file.read(_HEADER.size)
            length = _length(head)
            if len(head) < _HEADER.size or (length is not None and position + _frame_size(length) > size):
                raise SceneError(f"{path}, record {record}: the file ends within the record; fetch the file again.")
            if length is None:
                raise SceneError(
                    f"{path}, record {record}: the checksum of the record's length is wrong at byte {position}; "
                    "this is no TFRecord file, or it is damaged: fetch it again."
                )
            yield position
            position, record = position + _frame_size(length), record + 1


def read_frame(file: BinaryIO, offset: int, name: str) -> bytes:
    """The payload of the frame at an offset, checked.

    Args:
        file: from :func:`open_binary`.
        offset: from :func:`offsets`.
        name: what errors call the record.

    Raises:
        SceneError: the payload is cut or does not fit its checksum.
    """
    file.seek(offset)
    length = _length(file.read(_HEADER.size))
    body = b"" if length is None else file.read(length + _FOOTER.size)
    if length is None or len(body) != length + _FOOTER.size:
        raise SceneError(f"{name}: the file ends within the record; fetch the file again.")
    payload = body[:length]
    if _FOOTER.unpack(body[length:])[0] != masked_crc(payload):
        raise SceneError(f"{name}: the checksum of the record is wrong; the file is damaged: fetch it again.")
    return payload


def _length(head: bytes) -> int | None:
    """Payload length of a frame header, or nothing where the header does not fit its checksum."""
    if len(head) < _HEADER.size:
        return None
    length, crc = _HEADER.unpack(head)
    return length if crc == masked_crc(head[:8]) else None


def _frame_size(length: int) -> int:
    return _HEADER.size + length + _FOOTER.size


def _size(file: BinaryIO, path: str) -> int:
    try:
        if not isinstance(file, gzip.GzipFile):
            return file.seek(0, 2)
        size = 0
        while chunk := file.read(1 << 20):
            size += len(chunk)
        return size
    except (EOFError, OSError, zlib.error) as error:
        raise SceneError(f"{path}: cannot be unpacked ({error}); fetch the file again.") from error
