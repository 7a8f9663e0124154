"""Edits that fit any file: bits, bytes, slices."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from random import Random

Edit = Callable[[bytes, Random], bytes]
"""Some bytes -> the same, broken in one way."""

SIZES = (1, 2, 4, 16, 256, 4096)


def pack(data: bytes) -> bytes:
    """Gzip without the time of day, so that an input stays the same whenever it is made."""
    return gzip.compress(data, 1, mtime=0)


def flip_bits(data: bytes, r: Random) -> bytes:
    out = bytearray(data)
    for _ in range(r.choice((1, 1, 1, 4, 32))):
        if out:
            out[_place(out, r)] ^= 1 << r.randrange(8)
    return bytes(out)


def overwrite(data: bytes, r: Random) -> bytes:
    """Bytes of a pattern that lengths, counts and signs trip over."""
    if not data:
        return data
    at, size = _place(data, r), r.choice(SIZES[:4])
    pattern = r.choice((b"\x00", b"\xff", b"\x7f", b"\x80", b"\xff\xff\xff\x7f", r.randbytes(4)))
    return data[:at] + (pattern * size)[:size] + data[at + size :]


def truncate(data: bytes, r: Random) -> bytes:
    return data[: r.choice((r.randrange(len(data) + 1), max(0, len(data) - r.choice(SIZES)), r.choice(SIZES)))]


def delete_slice(data: bytes, r: Random) -> bytes:
    at, size = r.randrange(len(data) + 1), r.choice(SIZES)
    return data[:at] + data[at + size :]


def repeat_slice(data: bytes, r: Random) -> bytes:
    at, size = r.randrange(len(data) + 1), r.choice(SIZES)
    return data[: at + size] + data[at : at + size] * r.choice((1, 2, 16)) + data[at + size :]


def insert_noise(data: bytes, r: Random) -> bytes:
    at = r.randrange(len(data) + 1)
    return data[:at] + r.randbytes(r.choice(SIZES)) + data[at:]


def empty(data: bytes, r: Random) -> bytes:
    return b""


BYTE_EDITS: dict[Edit, int] = {
    flip_bits: 4, overwrite: 3, truncate: 2, delete_slice: 2, repeat_slice: 1, insert_noise: 1, empty: 0.2
}  # fmt: skip
"""Each with how often it is drawn, relative to the others."""


def edit_bytes(data: bytes, r: Random) -> bytes:
    """One of :data:`BYTE_EDITS`."""
    return r.choices([*BYTE_EDITS], [*BYTE_EDITS.values()])[0](data, r)


def _place(data: bytes | bytearray, r: Random) -> int:
    """Any place, and often one near an end: there lie headers and footers."""
    near = min(len(data), 400)
    return r.choice((r.randrange(len(data)), r.randrange(near), len(data) - 1 - r.randrange(near)))
