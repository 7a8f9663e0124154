"""GPUDrive: JSON of any shape, plain or packed, and packed files that claim the memory of the machine."""

from __future__ import annotations

import gzip
import json
import lzma
import struct
import zlib
from random import Random

from envs.sources.gpudrive import MAX_BYTES
from tests.envs.made import newer_gpudrive, older_gpudrive
from tests.fuzz.case import Files, Format, load_file, on_first, read_source
from tests.fuzz.edits import edit_bytes, pack
from tests.fuzz.trees import edit_json

PACK = {".json": bytes, ".gz": pack, ".xz": lambda data: lzma.compress(data, preset=0)}
UNPACK = {".json": bytes, ".gz": gzip.decompress, ".xz": lzma.decompress}
SMALL = ("[]", "[[]]", "{}", '{"x":0}', "0", '""', "[[[]]]", "null")
HUGE = (2**20, 2**23, MAX_BYTES - 2**12, MAX_BYTES + 1)


def seeds() -> list[Files]:
    newer, older = (json.dumps(make()).encode() for make in (newer_gpudrive, older_gpudrive))
    files = {"newer.json": newer, "newer.json.gz": newer, "older.json": older, "older.json.xz": older}
    return [{name: PACK["." + name.rpartition(".")[2]](data)} for name, data in files.items()]


def _unpacked(files: Files) -> tuple[str, bytes, str]:
    name, data = next(iter(files.items()))
    suffix = "." + name.rpartition(".")[2]
    try:
        return name, UNPACK[suffix](data), suffix
    except (EOFError, OSError, lzma.LZMAError, zlib.error):
        return name, b"", suffix


def edit_text(files: Files, r: Random) -> Files:
    """The JSON changed as bytes, and packed again."""
    name, data, suffix = _unpacked(files)
    return {name: PACK[suffix](edit_bytes(data, r))}


def edit_tree(files: Files, r: Random) -> Files:
    """The JSON changed as a tree, and packed again."""
    name, data, suffix = _unpacked(files)
    return {name: PACK[suffix](edit_json(data, r))}


def huge_json(files: Files, r: Random) -> Files:
    """A list or an object of millions of things, in place of something that is read."""
    name, _, suffix = _unpacked(files)
    one, size = r.choice(SMALL), r.choice(HUGE)
    many = "[" + ",".join([one] * (size // (len(one) + 1))) + "]"
    if r.random() < 0.3:
        many = "{" + ",".join(f'"{n}":{one}' for n in range(min(size // 10, 2**20))) + "}"
    tree = newer_gpudrive()
    place = r.choice(("top", "objects", "roads", "tl_states", "metadata", "geometry", "valid", "position"))
    if place in ("valid", "position"):
        tree["objects"][0][place] = "MANY"
    elif place == "geometry":
        tree["roads"][0][place] = "MANY"
    elif place in tree:
        tree[place] = "MANY"
    text = many if place == "top" else json.dumps(tree).replace('"MANY"', many)
    return {name: PACK[suffix](text.encode())}


def zero_bomb(files: Files, r: Random) -> Files:
    name, _, suffix = _unpacked(files)
    return {name: PACK[suffix](r.choice((b"\x00", b" ", b"[", b"1")) * r.choice((2**26, 2**27)))}


def huge_dictionary(files: Files, r: Random) -> Files:
    """A packed file that asks for gigabytes to be unpacked with."""
    data = _unpacked(files)[1] or b"{}"
    if r.random() < 0.5:
        alone = lzma.compress(data, format=lzma.FORMAT_ALONE, preset=0)
        return {"x.json.xz": alone[:1] + struct.pack("<I", r.choice((2**30, 2**31, 2**32 - 1))) + alone[5:]}
    packed = bytearray(lzma.compress(data, preset=0))
    size = (packed[12] + 1) * 4  # of the block's header, which ends with its checksum
    packed[packed.index(b"\x21\x01", 13) + 2] = r.choice((36, 38, 40))  # 1, 2, 4 GiB
    packed[12 + size - 4 : 12 + size] = struct.pack("<I", zlib.crc32(packed[12 : 12 + size - 4]))
    return {"x.json.xz": bytes(packed)}


def other_suffix(files: Files, r: Random) -> Files:
    data = next(iter(files.values()))
    return {r.choice(("a.json", "a.json.gz", "a.json.xz", "a")): data}


def _safe(mutate):
    """Mutators after one that changed the suffix must still know it."""

    def safe(files: Files, r: Random) -> Files:
        name, data = next(iter(files.items()))
        return mutate(files if "." + name.rpartition(".")[2] in PACK else {"a.json": data}, r)

    safe.__name__ = mutate.__name__
    return safe


GPUDRIVE = Format(
    name="gpudrive",
    seeds=seeds,
    load=load_file,
    mutators={
        _safe(edit_tree): 8,
        _safe(edit_text): 2,
        on_first(edit_bytes): 2,
        other_suffix: 0.2,
        _safe(huge_dictionary): 0.2,
    },
    bombs={
        _safe(huge_json): 0.15,
        _safe(zero_bomb): 0.02,
    },
    read=read_source("gpudrive"),
    source="gpudrive",
)
