"""Argoverse 2: parquet files of any bytes, columns of any type, and maps of any shape."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from random import Random
from typing import Any

from tests.envs.made import argoverse_columns, argoverse_map, line
from tests.fuzz.case import Files, Format, on_first, read_source
from tests.fuzz.edits import edit_bytes
from tests.fuzz.trees import edit_json

OPTIONS: tuple[dict[str, Any], ...] = (
    {},
    {"compression": "none"},
    {"compression": "zstd", "use_dictionary": False},
    {"compression": "gzip", "data_page_version": "2.0"},
    {"compression": "none", "use_dictionary": False, "data_page_size": 400},
)
VALUES = (None, 0, -1, 110, 2**31, 2**62, 0.5, math.nan, math.inf, 1e7, 1.1e7, 1e308, -1e308, "", "x", "AV", "٣", "7",
          "\u202e", "\x00", "x" * 100_000, b"\xff", True, [], [1.0], {"x": 1})  # fmt: skip


def write_table(columns: dict[str, Any], **options: Any) -> bytes:
    """A parquet file of columns."""
    import pyarrow
    from pyarrow import parquet

    file = io.BytesIO()
    parquet.write_table(pyarrow.table(columns), file, **options)
    return file.getvalue()


def seeds() -> list[Files]:
    text, columns = json.dumps(argoverse_map()).encode(), argoverse_columns()
    return [
        {"scenario_made.parquet": write_table(columns, **options), "log_map_archive_made.json": text}
        for options in OPTIONS
    ]


def load(path: Path) -> Files:
    """``scenario_<id>.parquet`` and its map."""
    name = f"log_map_archive_{path.stem.removeprefix('scenario_')}.json"
    return {path.name: path.read_bytes(), name: path.with_name(name).read_bytes()}


def _names(files: Files) -> tuple[str, str]:
    table, text = files
    return table, text


def edit_map(files: Files, r: Random) -> Files:
    _, name = _names(files)
    return files | {name: edit_json(files[name], r)}


def edit_map_bytes(files: Files, r: Random) -> Files:
    _, name = _names(files)
    return files | {name: edit_bytes(files[name], r)}


def edit_columns(files: Files, r: Random) -> Files:
    """Columns dropped, renamed, cut, with other values or of another type."""
    name, _ = _names(files)
    columns: dict[str, Any] = argoverse_columns()
    for _ in range(r.choice((1, 1, 2))):
        field = r.choice([*columns])
        values = columns[field]
        choice = r.randrange(6)
        if choice == 0:
            columns[r.choice(("other", "heading"))] = columns.pop(field)
        elif choice == 1:
            columns[field] = [r.choice(VALUES)] * len(values)
        elif choice == 2:
            columns = {
                other: r.choice((rows[:-1], rows[:1], [], rows * 2, rows[::-1])) for other, rows in columns.items()
            }
            shortest = min(map(len, columns.values()))
            columns = {other: rows[:shortest] for other, rows in columns.items()}
        else:
            values[r.randrange(len(values))] = r.choice(VALUES) if values else None
        if not columns[next(iter(columns))]:
            break
    return files | {name: _written(columns, r)}


def _written(columns: dict[str, Any], r: Random) -> bytes:
    import pyarrow

    arrays = {}
    for field, values in columns.items():
        try:
            arrays[field] = pyarrow.array(values)
        except (OverflowError, pyarrow.ArrowException):  # values of several types have no column: one of the last type
            arrays[field] = pyarrow.array([values[-1]] * len(values))
        if r.random() < 0.1:
            arrays[field] = _retyped(arrays[field], r)
    return write_table(arrays, **r.choice(OPTIONS))


def _retyped(array: Any, r: Random) -> Any:
    import pyarrow

    kinds = ("float32", "float16", "int8", "uint64", "string", "large_string", "binary", "bool", "timestamp", "null")
    kind = r.choice((*kinds, "decimal", "string_view", "dictionary"))
    try:
        if kind == "dictionary":
            return array.dictionary_encode()
        if kind == "null":
            return pyarrow.nulls(len(array))
        types = {"timestamp": pyarrow.timestamp("us"), "decimal": pyarrow.decimal128(30, 5), "bool": pyarrow.bool_()}
        return array.cast(types[kind] if kind in types else getattr(pyarrow, kind)(), safe=False)
    except (pyarrow.ArrowException, NotImplementedError):
        return array


def huge_table(files: Files, r: Random) -> Files:
    """Many rows, tracks or texts out of few bytes."""
    import pyarrow

    name, _ = _names(files)
    columns: dict[str, Any] = argoverse_columns()
    choice = r.randrange(4)
    if choice == 0:
        count = r.choice((10**5, 10**6, 10**6 + 1, 10**7))
        table = {field: pyarrow.repeat(values[0], count) for field, values in columns.items()}
        return files | {name: write_table(table)}
    if choice == 1:
        count = r.choice((9_999, 20_000))
        table = {field: pyarrow.array([*values, *[values[109]] * count]) for field, values in columns.items()}
        table["track_id"] = pyarrow.array([*columns["track_id"], *map(str, range(100, 100 + count))])
        return files | {name: write_table(table)}
    field = r.choice(("track_id", "object_type", "scenario_id"))
    if choice == 2:
        long = [value + "x" * r.choice((10**5, 10**6)) for value in columns[field]]
        return files | {name: write_table(columns | {field: long})}
    count, long = r.choice((10**3, 10**4, 10**5)), "x" * 10**4
    table = {other: pyarrow.repeat(values[0], count) for other, values in columns.items()}
    table[field] = pyarrow.DictionaryArray.from_arrays(pyarrow.array([0] * min(count, 10**5)), [long]).cast(
        pyarrow.large_string()
    )
    data = write_table(table, use_dictionary=False, column_encoding={field: "DELTA_BYTE_ARRAY"})
    return files | {name: data}


def page_header(files: Files, r: Random) -> Files:
    """Bytes where the headers of pages lie: near the marks of compressed pages and the ends of their statistics."""
    name, _ = _names(files)
    data = bytearray(files[name])
    starts = [at for at in range(4, len(data) - 8) if data[at] == 0x15 and data[at + 2] == 0x15]
    for at in r.sample(starts, min(len(starts), r.choice((1, 2, 4)))):
        data[at + 1 + 2 * r.randrange(3)] = r.randrange(256)
    return files | {name: bytes(data)}


def huge_map(files: Files, r: Random) -> Files:
    """Areas of many corners, that cross themselves or each other, and objects of many entries."""
    _, name = _names(files)
    data = argoverse_map()
    count, areas = r.choice((1_000, 20_000)), data["drivable_areas"]
    choice = r.randrange(5)
    if choice == 0:
        around = [(1000 + 90 * r.random(), 200 + 90 * r.random()) for _ in range(count)]
        areas["1"]["area_boundary"] = line(*around)
    elif choice == 1:
        comb = [(1000 + 0.01 * k, 212 if k % 2 else 211) for k in range(count)]
        areas["1"]["area_boundary"] = line(*comb, (1000 + 0.01 * count, 197), (1000, 197))
    elif choice == 2:
        tiles = {str(k): {"id": k, **_tile(k, r)} for k in range(count // 10)}
        areas.update(tiles)
    elif choice == 3:
        one = data["lane_segments"]["10"]
        data["lane_segments"] = {str(k): one | {"id": k} for k in range(count)}
    else:
        text = ",".join(["[[]]"] * (r.choice((2**20, 2**25 - 100)) // 5))
        return files | {name: f'{{"lane_segments": [{text}]}}'.encode()}
    return files | {name: json.dumps(data).encode()}


def _tile(number: int, r: Random) -> dict[str, Any]:
    x, y = 1000 + 100 * r.random(), 197 + 100 * r.random()
    return {"area_boundary": line((x, y), (x + 9 * r.random(), y + 9), (x + 9, y + 9 * r.random()))}


ARGOVERSE = Format(
    name="argoverse",
    seeds=seeds,
    load=load,
    mutators={
        edit_map: 6,
        edit_columns: 5,
        on_first(edit_bytes): 4,
        page_header: 2,
        edit_map_bytes: 1,
    },
    bombs={
        huge_table: 0.15,
        huge_map: 0.15,
    },
    read=read_source("argoverse"),
    source="argoverse",
)
