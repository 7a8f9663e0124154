"""Edits of protobuf messages as they lie in a file, which no protobuf library would write."""

from __future__ import annotations

import struct
from random import Random

from tests.fuzz.edits import edit_bytes

VARINT, FIXED64, LENGTH, START, END, FIXED32 = range(6)
Part = tuple[int, int, bytes] | bytes
"""Field number, wire type and content (without its length), or bytes that go out as they are."""
NUMBERS = (0, 1, 10, 91, 127, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
DOUBLES = tuple(
    map(float, ("nan", "inf", "-inf", "1e308", "-1e308", "1e39", "1e-320", "-0.0", "1e7", "1.1e7", "3e38", "0", "-1"))
)
DEEP = 100_000


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def read_varint(data: bytes, at: int) -> tuple[int, int]:
    """Value and the place behind it; ValueError where there is none."""
    value = shift = 0
    while shift < 70 and at < len(data):
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at
    raise ValueError("no varint")


def field(number: int, kind: int, content: bytes) -> bytes:
    """One field as it lies in a message."""
    size = varint(len(content)) if kind == LENGTH else b""
    return varint(number << 3 | kind) + size + content


def split(data: bytes) -> list[Part]:
    """The fields of a message; ValueError where it is none."""
    parts, at = [], 0
    while at < len(data):
        tag, at = read_varint(data, at)
        number, kind = tag >> 3, tag & 7
        if kind == VARINT:
            end = read_varint(data, at)[1]
        elif kind == LENGTH:
            size, at = read_varint(data, at)
            end = at + size
        elif kind in (FIXED64, FIXED32):
            end = at + (8 if kind == FIXED64 else 4)
        else:
            raise ValueError("a group")
        if number == 0 or end > len(data):
            raise ValueError("no message")
        parts.append((number, kind, data[at:end]))
        at = end
    return parts


def join(parts: list[Part]) -> bytes:
    return b"".join(part if isinstance(part, bytes) else field(*part) for part in parts)


def edit_message(data: bytes, r: Random) -> bytes:
    """One edit of one field, however deep; every length around it is put right again."""
    try:
        parts = split(data)
    except ValueError:
        return edit_bytes(data, r)
    if not parts:
        return _stray(r)
    wanted = r.choice(sorted({part[0] for part in parts}))
    index = r.choice([index for index, part in enumerate(parts) if part[0] == wanted])
    number, kind, content = parts[index]
    if kind == LENGTH and r.random() < 0.85:
        parts[index] = (number, kind, edit_message(content, r))
    else:
        parts[index : index + 1] = _edit_field(number, kind, content, r)
    return join(parts)


def _edit_field(number: int, kind: int, content: bytes, r: Random) -> list[Part]:
    whole = field(number, kind, content)
    choice = r.choices(range(3, 10), (16, 3, 3, 1, 0.5, 0.5, 1))[0]
    if choice == 3:
        return [(number, kind, _other_value(kind, content, r))]
    if choice == 4:
        return []
    if choice == 5:
        return [whole * r.choice((2, 2, 50, 1000))]
    if choice == 6:
        return [(r.choice((number + 1, r.randrange(1, 20), 2**29 - 1)), kind, content)]
    if choice == 7:  # the same bytes as another type
        return [varint(number << 3 | r.randrange(8)) + content]
    if choice == 8 and kind == LENGTH:
        lie = r.choice((len(content) + 1, max(0, len(content) - 1), 2**31, 2**32, 2**64 - 1, 0))
        return [varint(number << 3 | LENGTH) + varint(lie) + content]
    return [whole, _stray(r)]


def _other_value(kind: int, content: bytes, r: Random) -> bytes:
    if kind == VARINT:
        return varint(r.choice(NUMBERS)) if r.random() < 0.9 else b"\xff" * r.choice((9, 10, 11)) + b"\x01"
    if kind == FIXED64:
        return struct.pack("<d", r.choice(DOUBLES))
    if kind == FIXED32:
        value = r.choice(DOUBLES)
        return struct.pack("<f", value if not abs(value) < float("inf") or abs(value) < 3.3e38 else 3.3e38)
    return r.choice((b"", b"\xff\xfe", "\u202e\x00é".encode(), b"x" * 100_000, b"\xed\xa0\x80", edit_bytes(content, r)))


def _stray(r: Random) -> bytes:
    """A field that does not belong there."""
    return r.choice(
        (
            field(99, VARINT, b"\x01"),
            field(2**29 - 1, LENGTH, b"x" * 10),
            field(r.randrange(1, 20), LENGTH, r.randbytes(8)),
            field(r.randrange(1, 20), VARINT, varint(r.choice(NUMBERS))),
            varint(99 << 3 | START) * r.choice((1, 50, DEEP)),
            varint(99 << 3 | START) * DEEP + varint(99 << 3 | END) * DEEP,
            b"\x0c",
            b"\x00",
        )
    )
