"""WOMD: frames whose checksums are right around payloads that are not, and counts that a few bytes can claim."""

from __future__ import annotations

import gzip
import struct
from random import Random

from envs.sources.tfrecord import MAX_PAYLOAD, frame, masked_crc
from tests.envs.made import make_rich_scenario, make_scenario
from tests.fuzz.case import Files, Format, load_file, on_first, read_source
from tests.fuzz.edits import edit_bytes, pack
from tests.fuzz.wire import DEEP, END, LENGTH, START, VARINT, edit_message, field, varint

LENGTHS = (0, 1, 2**28, 2**28 + 1, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1)
COUNTS = (2**12, 2**16, 2**20, 2**24 - 2**16)
_GZIP_MAGIC = b"\x1f\x8b"


def seeds() -> list[Files]:
    rich, plain = make_rich_scenario().SerializeToString(), make_scenario().SerializeToString()
    frames = frame(rich) + frame(plain)
    return [
        {"plain.tfrecord": frames},
        {"one.tfrecord": frame(rich)},
        {"packed.tfrecord.gz": pack(frames)},
        {"bare.pb": rich},
        {"packed.pb.gz": pack(rich)},
    ]


def _payloads(files: Files) -> tuple[list[bytes], bool, bool]:
    """The payloads of the file as far as its frames are whole, and whether it is packed and bare."""
    name, data = next(iter(files.items()))
    packed, bare = data.startswith(_GZIP_MAGIC), ".pb" in name
    if packed:
        try:
            data = gzip.decompress(data)
        except (EOFError, OSError, ValueError, gzip.zlib.error):
            packed, data = False, b""
    if bare:
        return [data], packed, True
    payloads, at = [], 0
    while at + 12 <= len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        if at + 16 + length > len(data):
            break
        payloads.append(data[at + 12 : at + 12 + length])
        at += 16 + length
    return payloads, packed, False


def _file(files: Files, content: bytes, packed: bool) -> Files:
    return {next(iter(files)): pack(content) if packed else content}


def edit_payload(files: Files, r: Random, edit=edit_message) -> Files:
    """One record broken, with the checksum that fits."""
    payloads, packed, bare = _payloads(files)
    if payloads:
        index = r.randrange(len(payloads))
        payloads[index] = edit(payloads[index], r)
    return _file(files, b"".join(payloads if bare else map(frame, payloads)), packed)


def edit_payload_bytes(files: Files, r: Random) -> Files:
    return edit_payload(files, r, edit_bytes)


def wrong_length(files: Files, r: Random) -> Files:
    """A frame that claims another length, with the checksum that fits."""
    payloads, packed, _ = _payloads(files)
    frames = [*map(frame, payloads)] or [frame(b"")]
    index = r.randrange(len(frames))
    length = struct.pack("<Q", r.choice((*LENGTHS, max(0, len(frames[index]) - 16 + r.choice((-1, 1, 16))))))
    frames[index] = length + struct.pack("<I", masked_crc(length)) + frames[index][12:]
    return _file(files, b"".join(frames), packed)


def other_frames(files: Files, r: Random) -> Files:
    """Records dropped, repeated, empty."""
    payloads, packed, _ = _payloads(files)
    payloads = r.choice((payloads[1:], payloads * 3, [*payloads, b""], [b""] * 3, payloads[::-1]))
    return _file(files, b"".join(map(frame, payloads)), packed)


def pack_or_unpack(files: Files, r: Random) -> Files:
    data = next(iter(files.values()))
    return _file(files, data, packed=True)


def _nested(*numbers: int, content: bytes) -> bytes:
    for number in reversed(numbers):
        content = field(number, LENGTH, content)
    return content


_EMPTY = {
    "tracks": ((), b"\x12\x00"),
    "states": ((2,), b"\x1a\x00"),
    "lights": ((7,), b"\x0a\x00"),
    "steps of lights": ((), b"\x3a\x00"),
    "features": ((), b"\x42\x00"),
    "lane points": ((8, 3), b"\x42\x00"),
    "edge points": ((8, 5), b"\x12\x00"),
    "neighbours": ((8, 3), b"\x5a\x00"),
    "predictions": ((), b"\x5a\x00"),
    "unknown": ((), field(99, VARINT, b"\x01")),
    "unknown in a lane": ((8, 3), field(99, VARINT, b"\x01")),
}
"""What -> numbers of the fields around it, and the two or three bytes of an empty one."""


def huge_count(files: Files, r: Random) -> Files:
    """Millions of empty messages: two bytes of a file each, and far more in memory; packed, a thousandth of that."""
    payloads, _, bare = _payloads(files)
    payload = payloads[0] if payloads else b""
    around, one = _EMPTY[r.choice([*_EMPTY])]
    count = r.choice(COUNTS)
    content = one * count
    if r.random() < 0.15:  # a packed list of lanes that follow
        around, content = (8, 3), field(10, LENGTH, b"\x01" * count)
    elif r.random() < 0.15:  # unknown fields that all differ
        around, content = (), b"".join(varint(1000 + n << 3) + b"\x01" for n in range(min(count, 2**20)))
    payload += _nested(*around, content=content)
    return _file(files, payload if bare else frame(payload), packed=r.random() < 0.5)


def gzip_bomb(files: Files, r: Random) -> Files:
    size = r.choice((2**20, MAX_PAYLOAD, MAX_PAYLOAD + 1, 2**29))
    head = struct.pack("<Q", min(size, MAX_PAYLOAD))
    head += struct.pack("<I", masked_crc(head))
    return _file(files, r.choice((b"", head)) + bytes(size), packed=True)


def deep_nesting(files: Files, r: Random) -> Files:
    payloads, packed, bare = _payloads(files)
    groups = varint(99 << 3 | START) * DEEP
    inner = r.choice((groups, groups + varint(99 << 3 | END) * DEEP))
    payload = (payloads[0] if payloads else b"") + _nested(*r.choice(((), (8,), (8, 3), (2, 3))), content=inner)
    return _file(files, payload if bare else frame(payload), packed)


WOMD = Format(
    name="womd",
    seeds=seeds,
    load=load_file,
    mutators={
        edit_payload: 8,
        on_first(edit_bytes): 3,
        edit_payload_bytes: 2,
        wrong_length: 1,
        other_frames: 0.2,
        pack_or_unpack: 0.2,
        deep_nesting: 0.2,
    },
    bombs={
        huge_count: 0.12,
        gzip_bomb: 0.02,
    },
    read=read_source("womd"),
    source="womd",
)
