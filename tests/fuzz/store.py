"""Our own store: shards, records and manifests that are damaged, with and without the checksums that fit."""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import zstandard

from envs.scene import Scene
from envs.shards import FORMAT_VERSION
from envs.sources.synthetic import red_light, straight_road, two_cars_head_on
from envs.store import MANIFEST_FILE, SceneStore
from tests.envs.made import write_store
from tests.fuzz.case import Files, Format, Maker
from tests.fuzz.edits import edit_bytes, flip_bits, overwrite
from tests.fuzz.trees import edit_json

MAGIC = b"SCENES\x00" + bytes([FORMAT_VERSION])
_FOOTER = struct.Struct("<Q8s")
_COUNTS = (0, 1, 2, 90, 91, 2**16, 2**20, 2**22, 2**31, 2**32 - 1)


def seeds() -> list[Files]:
    with TemporaryDirectory() as parent:
        shards = [straight_road(3), red_light()], [two_cars_head_on()]
        return [load(write_store(Path(parent, "store"), *shards))]


def load(folder: Path) -> Files:
    """The files of a store."""
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def read(path: Path) -> Iterator[Maker]:
    """Every scene of the store, after all that is known without loading one; then its own check."""
    store = SceneStore(path.parent)
    store.select(min_agents=1, has_lights=True)
    _ = store.scene_ids, store.blocks, store.lacks, [store.provenance(index) for index in range(len(store))]
    yield from (partial(_validated, store, index) for index in range(len(store)))
    store.verify()


def _validated(store: SceneStore, index: int) -> Scene:
    shard, row = store._find(index)
    return store[index].validate(f"{shard.path}, scene {row}")


def _pick_shard(files: Files, r: Random) -> str:
    return r.choice([name for name in files if name.endswith(".scenes")])


def _parts(data: bytes) -> tuple[list[bytes], dict]:
    """Blocks and record of a shard; nothing of one that is broken already."""
    try:
        length, _ = _FOOTER.unpack(data[-_FOOTER.size :])
        end = len(data) - _FOOTER.size
        record = json.loads(zstandard.decompress(data[end - length : end]))
        blocks, at = [], len(MAGIC)
        for size in record["sizes"]:
            blocks.append(data[at : at + size])
            at += size
        return blocks, record
    except (ArithmeticError, KeyError, RecursionError, TypeError, ValueError, struct.error, zstandard.ZstdError):
        return [], {}


def _join(blocks: list[bytes], record: bytes) -> bytes:
    packed = zstandard.compress(record)
    return b"".join([MAGIC, *blocks, packed, _FOOTER.pack(len(packed), MAGIC)])


def _with_checksums(files: Files) -> Files:
    """The manifest with the checksums that the shards have now."""
    try:
        manifest = json.loads(files[MANIFEST_FILE])
        for entry in manifest["shards"]:
            entry["sha256"] = hashlib.sha256(files[entry["name"]]).hexdigest()
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError):
        return files
    return files | {MANIFEST_FILE: json.dumps(manifest).encode()}


def edit_file(files: Files, r: Random) -> Files:
    """Bytes of one of the files."""
    name = r.choice([*files])
    return files | {name: edit_bytes(files[name], r)}


def edit_manifest(files: Files, r: Random) -> Files:
    return files | {MANIFEST_FILE: edit_json(files[MANIFEST_FILE], r)}


def edit_record(files: Files, r: Random) -> Files:
    """The record of a shard, with the checksums that fit."""
    name = _pick_shard(files, r)
    blocks, record = _parts(files[name])
    return _with_checksums(files | {name: _join(blocks, edit_json(json.dumps(record).encode(), r))})


def edit_block(files: Files, r: Random) -> Files:
    """What a scene is packed from, with the checksums that fit."""
    return _edit_block(files, r, r.choice((flip_bits, overwrite, edit_bytes)))


def edit_counts(files: Files, r: Random) -> Files:
    """Counts in the header of a scene."""
    return _edit_block(files, r, _other_count)


def _other_count(data: bytes, r: Random) -> bytes:
    at = 4 * r.randrange(9)
    return data[:at] + struct.pack("<I", r.choice(_COUNTS)) + data[at + 4 :]


def fitting_counts(files: Files, r: Random) -> Files:
    """A scene of millions of agents, polylines or lights, all bits zero: a few bytes when packed."""
    return _edit_block(files, r, _zeros)


def _zeros(data: bytes, r: Random) -> bytes:
    from envs import codec

    count = r.choice((1, 91, 2**12, 2**20, 2**22, 6 * 2**20))
    tables = dict.fromkeys(codec._TABLES, 0) | {"scene": 1, r.choice(codec._TABLES[1:]): count}
    size = sum(codec._num_bytes(tables[column.table], column) for column in codec._COLUMNS) + tables["letters"]
    return codec._HEADER.pack(*tables.values()) + bytes(min(size, 2**29))


def huge_record(files: Files, r: Random) -> Files:
    """A record of many small lists, or of nothing but zeros."""
    name = _pick_shard(files, r)
    size = r.choice((2**20, 2**23 - 2**10, 2**28))
    text = r.choice((b"[[]],", b"[],", b'{"":0},', b"\x00"))
    record = b'{"version": 3, "scene_ids": [' + text * (size // len(text)) + b"0]}"
    return _with_checksums(files | {name: _join(_parts(files[name])[0], record)})


def _edit_block(files: Files, r: Random, edit) -> Files:
    name = _pick_shard(files, r)
    blocks, record = _parts(files[name])
    if not blocks:
        return files
    index = r.randrange(len(blocks))
    try:
        data = zstandard.decompress(blocks[index])
    except zstandard.ZstdError:
        return files
    blocks[index] = zstandard.compress(edit(data, r), level=1)
    record = record | {"sizes": [*map(len, blocks)]}
    return _with_checksums(files | {name: _join(blocks, json.dumps(record).encode())})


def swap_blocks(files: Files, r: Random) -> Files:
    """Scenes in another order than the record says, or files under each other's names."""
    name = _pick_shard(files, r)
    blocks, record = _parts(files[name])
    if len(blocks) > 1:
        return _with_checksums(files | {name: _join(blocks[::-1], json.dumps(record).encode())})
    names = [*files]
    r.shuffle(names)
    return dict(zip(files, (files[other] for other in names), strict=True))


def drop_file(files: Files, r: Random) -> Files:
    """A file that is not there (the manifest stays as an empty one, since it is what is opened)."""
    name = r.choice([*files])
    return files | {name: b""} if name == MANIFEST_FILE else {n: data for n, data in files.items() if n != name}


def _guarded(mutate):
    """Mutators after one that dropped all the shards have nothing to do."""

    def guarded(files: Files, r: Random) -> Files:
        return mutate(files, r) if any(name.endswith(".scenes") for name in files) else files

    guarded.__name__ = mutate.__name__
    return guarded


STORE = Format(
    name="store",
    seeds=seeds,
    load=load,
    mutators={
        edit_file: 3,
        edit_manifest: 4,
        _guarded(edit_record): 5,
        _guarded(edit_block): 4,
        _guarded(edit_counts): 2,
        _guarded(swap_blocks): 0.3,
        drop_file: 0.3,
    },
    bombs={_guarded(fitting_counts): 0.2, _guarded(huge_record): 0.05},
    read=read,
    also_named=(".scenes: ", "the conversion has not finished"),
)
