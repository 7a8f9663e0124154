"""One scene <-> one block of bytes, exact to the last bit, about a tenth of the raw recording.

Every array is taken apart so that neighbouring bytes resemble each other, and the whole is packed by Zstandard:

* columns lie behind each other (all x, then all y),
* values become differences to the value before them: differences of their bit patterns as whole numbers, modulo 2^32 or
  2^64, so that floating-point rounding never enters and decoding is a cumulative sum,
* the bytes of equal weight lie behind each other: signs and exponents hardly change, so those planes pack to nothing.

States of agents are kept only where they are valid (they are zero elsewhere). A block has a checksum of its own.
"""

from __future__ import annotations

import math
import struct
from typing import NamedTuple

import numpy as np
import torch
import zstandard

from envs.scene import LOG_STEPS, Agents, Lights, RoadMap, Scene, SceneError

LEVEL = 6
"""Of Zstandard: higher ones take far longer to pack and save little; unpacking costs the same at any level."""
MAX_BYTES = 1 << 28
"""No scene is larger when unpacked; a damaged header must not claim the memory of the machine."""

MOST_AGENTS = 100_000
"""Of one scene: an agent that is never valid takes some bytes when packed and 2 KB in memory."""

_PARTS = {"agents": Agents, "road": RoadMap, "lights": Lights}
_TABLES = ("scene", "agents", "states", "points", "polylines", "links", "lights", "listings", "letters")
_HEADER = struct.Struct(f"<{len(_TABLES)}I")


class _Column(NamedTuple):
    """How one field is stored.

    Attributes:
        name: of the field, ``part.field``.
        table: what one row of it is; the header holds the rows of each table.
        dtype: in memory.
        shape: of one row.
        order: how many times differences are taken along the rows.
    """

    name: str
    table: str
    dtype: str
    shape: tuple[int, ...] = ()
    order: int = 0

    @property
    def per_row(self) -> int:
        """Values of one row."""
        return math.prod(self.shape)


_FLOAT, _DOUBLE, _WHOLE, _FLAG = "<f4", "<f8", "<i8", "?"
# A sampled curve is nearly straight, so second differences of its points are small; tracks pause and start too often.
# Headings and velocities come with sensor noise in their last bits: differences would only add to it.
_COLUMNS = (
    _Column("origin", "scene", _DOUBLE, (3,)),
    _Column("lacks", "scene", _WHOLE),
    _Column("agents.position", "states", _FLOAT, (3,), order=1),
    _Column("agents.heading", "states", _FLOAT),
    _Column("agents.velocity", "states", _FLOAT, (2,)),
    _Column("agents.extent", "agents", _FLOAT, (3,)),
    _Column("agents.kind", "agents", _WHOLE),
    _Column("agents.track_id", "agents", _WHOLE, order=1),
    _Column("agents.valid", "agents", _FLAG, (LOG_STEPS,)),
    _Column("agents.predict", "agents", _FLAG),
    _Column("agents.sdc", "agents", _FLAG),
    _Column("road.points", "points", _FLOAT, (3,), order=2),
    _Column("road.count", "polylines", _WHOLE),
    _Column("road.kind", "polylines", _WHOLE),
    _Column("road.feature_id", "polylines", _WHOLE, order=1),
    _Column("road.speed_limit", "polylines", _FLOAT),
    _Column("road.links", "links", _WHOLE, (3,), order=1),
    _Column("lights.lane_id", "lights", _WHOLE, order=1),
    _Column("lights.state", "listings", _WHOLE, order=1),
    _Column("lights.stop_point", "listings", _FLOAT, (3,), order=1),
)
_AT_VALID_STATES = tuple(column.name for column in _COLUMNS if column.table == "states")


def encode(scene: Scene) -> bytes:
    """Pack one uncollated scene.

    Raises:
        SceneError: a scene that would not come back as it is: a type other than that of :class:`~envs.scene.Scene`,
            states that are not zero where they are invalid, polylines whose points do not lie behind each other.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(num_vehicles=3)
        >>> bool((decode(encode(scene)).agents.position == scene.agents.position).all())
        True
    """
    road, valid = scene.road, scene.agents.valid
    if not torch.equal(road.start, road.count.cumsum(0) - road.count) or int(road.count.sum()) != len(road.points):
        raise SceneError(f"scene {scene.scene_id}: the polylines' points do not lie behind each other in their order.")
    rows = {column.name: _rows(scene, column) for column in _COLUMNS}
    for name in _AT_VALID_STATES:
        if rows[name][~valid.numpy()].any():
            raise SceneError(f"scene {scene.scene_id}: {name} is not zero at an invalid step; set it to zero there.")
        rows[name] = rows[name][valid.numpy()]
    letters = scene.scene_id.encode()
    num_rows = {column.table: len(rows[column.name]) for column in _COLUMNS} | {"letters": len(letters)}
    parts = [_HEADER.pack(*(num_rows[table] for table in _TABLES))]
    parts += [_pack(rows[column.name], column) for column in _COLUMNS]
    return zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compress(b"".join(parts) + letters)


def checksum(block: bytes) -> int:
    """The checksum of a scene's content (XXH64, its lower 32 bits), which Zstandard puts at the end of a block.

    It is that of the unpacked bytes, so it says the same of a scene whichever version of the library packed it.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> before = checksum(encode(scene))
        >>> scene.agents.predict[0] ^= True
        >>> before == checksum(encode(straight_road(2))), before == checksum(encode(scene))
        (True, False)
    """
    return int.from_bytes(block[-4:], "little")


def decode(block: bytes) -> Scene:
    """Unpack one scene; its tensors are new and may be changed.

    Raises:
        SceneError: the bytes are damaged.
    """
    data = _unpacked(block)
    if len(data) < _HEADER.size:
        raise SceneError("the block of the scene is shorter than its header.")
    num_rows = dict(zip(_TABLES, _HEADER.unpack_from(data), strict=True))
    expected = _HEADER.size + num_rows["letters"] + sum(_num_bytes(num_rows[c.table], c) for c in _COLUMNS)
    if len(data) != expected or num_rows["scene"] != 1:
        raise SceneError(f"the block of the scene has {len(data)} bytes where its header asks for {expected}.")
    if num_rows["agents"] > MOST_AGENTS:
        raise SceneError(f"the block of the scene claims {num_rows['agents']} agents; at most {MOST_AGENTS} are read.")
    if num_rows["listings"] != num_rows["lights"] * LOG_STEPS:
        raise SceneError(f"the block of the scene has {num_rows['listings']} listings of {num_rows['lights']} lights.")
    arrays, offset = {}, _HEADER.size
    for column in _COLUMNS:
        size = _num_bytes(num_rows[column.table], column)
        arrays[column.name] = _unpack(data[offset : offset + size], num_rows[column.table], column)
        offset += size
    try:
        scene_id = bytes(data[offset:]).decode()
    except UnicodeDecodeError as error:
        raise SceneError(f"the block of the scene has an id that is no text ({error}).") from error
    return _scene(arrays, scene_id)


def _rows(scene: Scene, column: _Column) -> np.ndarray:
    """The values of one field by rows of its table (of states: one for each agent and step, valid or not)."""
    part, _, field = column.name.rpartition(".")
    values = getattr(getattr(scene, part) if part else scene, field).numpy()
    if values.dtype != np.dtype(column.dtype):
        raise SceneError(f"scene {scene.scene_id}: {column.name} is {values.dtype}; see envs.scene for its type.")
    if column.table == "scene":
        return values[None]
    return values.reshape(-1, *column.shape) if column.table == "listings" else values


def _num_bytes(num_rows: int, column: _Column) -> int:
    values = num_rows * column.per_row
    return -(-values // 8) if column.dtype == _FLAG else values * np.dtype(column.dtype).itemsize


def _pack(rows: np.ndarray, column: _Column) -> bytes:
    if column.dtype == _FLAG:
        return np.packbits(rows).tobytes()
    width = rows.dtype.itemsize
    bits = np.ascontiguousarray(rows.reshape(len(rows), column.per_row).T).view(f"<u{width}")
    for _ in range(column.order):
        bits = np.diff(bits, axis=-1, prepend=bits.dtype.type(0))
    return bits.reshape(-1).view(np.uint8).reshape(-1, width).T.tobytes()


def _unpack(data: memoryview, num_rows: int, column: _Column) -> np.ndarray:
    """Inverse of :func:`_pack`."""
    shape = (num_rows, *column.shape)
    if column.dtype == _FLAG:
        flags = np.unpackbits(np.frombuffer(data, np.uint8), count=num_rows * column.per_row)
        return flags.astype(bool).reshape(shape)
    width = np.dtype(column.dtype).itemsize
    planes = np.frombuffer(data, np.uint8).reshape(width, -1)
    whole = np.empty((planes.shape[1], width), np.uint8)
    for place, plane in enumerate(planes):  # four times as fast as a copy of planes.T
        whole[:, place] = plane
    bits = whole.view(f"<u{width}").reshape(column.per_row, num_rows)
    for _ in range(column.order):
        bits = np.cumsum(bits, axis=-1, dtype=bits.dtype)
    return np.ascontiguousarray(bits.T).view(column.dtype).reshape(shape)


def _unpacked(block: bytes) -> memoryview:
    try:
        size = zstandard.frame_content_size(block)
        if not 0 <= size <= MAX_BYTES:
            raise SceneError(f"the block of the scene claims {size} bytes; at most {MAX_BYTES} are read.")
        return memoryview(zstandard.ZstdDecompressor().decompress(block))
    except zstandard.ZstdError as error:
        raise SceneError(f"the block of the scene does not fit its checksum ({error}).") from error


def _scene(arrays: dict[str, np.ndarray], scene_id: str) -> Scene:
    valid, count = arrays["agents.valid"], arrays["road.count"]
    for name in _AT_VALID_STATES:
        if len(arrays[name]) != np.count_nonzero(valid):
            raise SceneError(f"the block of the scene has {len(arrays[name])} states of {valid.sum()}.")
        arrays[name] = _spread(arrays[name], valid)
    for name in ("lights.state", "lights.stop_point"):
        arrays[name] = arrays[name].reshape(-1, LOG_STEPS, *arrays[name].shape[1:])
    arrays["road.start"] = np.cumsum(count) - count
    tensors = {name: torch.from_numpy(values) for name, values in arrays.items()}
    parts = {
        part: cls(**{field: tensors[f"{part}.{field}"] for field in cls.__dataclass_fields__}, batch_size=[])
        for part, cls in _PARTS.items()
    }
    return Scene(**parts, origin=tensors["origin"][0], lacks=tensors["lacks"][0], scene_id=scene_id, batch_size=[])


def _spread(states: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """States at their places, zero elsewhere; a state is moved as one item, which is far faster than by its numbers."""
    width = math.prod(states.shape[1:])
    item = np.dtype((np.void, states.dtype.itemsize * width))
    filled = np.zeros(valid.size, item)
    filled[np.flatnonzero(valid)] = np.ascontiguousarray(states).reshape(len(states), width).view(item)[:, 0]
    return filled.view(states.dtype).reshape(valid.shape + states.shape[1:])
