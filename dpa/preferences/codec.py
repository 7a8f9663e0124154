"""One ranked group <-> one block of bytes, exact to the last bit.

A block is one Zstandard frame of two parts with statistics of their own:

* what resembles itself: the header, masks, classes, tokens, and of every number the byte with its sign and exponent,
* the other bytes of the numbers, by weight: the last bits of a distance are noise, which packs to its own size.

Tokens take most of a group, and those of agents that stand or drive evenly are nearly the same in all its rollouts. A
block has a checksum of its own and is read alone.
"""

from __future__ import annotations

import math
import struct

import numpy as np
import zstandard

from dpa.preferences.group import NUMBERS, Group, group_shapes
from dpa.preferences.provenance import SMALL, StoreError, TokenLayout

LEVEL = 12
"""Of Zstandard: 1 ms for 64 rollouts of 32 agents, made in a second; unpacking costs the same at any level."""
MAX_BYTES = 1 << 28
"""No group is larger when unpacked; a damaged header must not claim the memory of the machine."""

_FLAGS = ("token_valid", "agent_ranked")
_HEADER = struct.Struct("<q4I")


def encode(group: Group, layout: TokenLayout = SMALL) -> bytes:
    """Pack one group.

    Args:
        group: checked (:func:`~dpa.preferences.group.check_group`).
        layout: of the store's tokens.

    Raises:
        StoreError: it is larger than any that is read back.

    Examples:
        >>> from dpa.preferences.examples import example_groups, example_provenance
        >>> from dpa.preferences.group import take_groups
        >>> (group,) = take_groups(example_groups(num_scenes=1), example_provenance())
        >>> bool((decode(encode(group)).tokens == group.tokens).all())
        True
    """
    a, k, t = group.tokens.shape[:3]
    planes = _planes(_joined(group, NUMBERS).astype("<f4"))
    alike = b"".join(
        (
            _HEADER.pack(group.scene, a, k, t, group.feature_share.shape[-1]),
            np.packbits(_joined(group, _FLAGS)).tobytes(),
            group.agent_kind.astype(np.uint8).tobytes(),
            _planes(group.tokens.astype(np.dtype(layout.dtype).newbyteorder("<"))).tobytes(),
            planes[3].tobytes(),
        )
    )
    noise = planes[:3].tobytes()
    size = len(alike) + len(noise)
    if size > MAX_BYTES:
        raise StoreError(
            f"scene {group.scene}: {a} agents x {k} rollouts take more than {MAX_BYTES} bytes; roll out fewer."
        )
    packer = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compressobj(size=size)
    first = packer.compress(alike) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    return first + packer.compress(noise) + packer.flush()


def decode(block: bytes, layout: TokenLayout = SMALL) -> Group:
    """Unpack one group; its arrays are new and may be changed.

    Args:
        block: from :func:`encode`.
        layout: of the store's tokens.

    Raises:
        StoreError: the bytes are damaged.
    """
    data = np.frombuffer(_unpacked(block), np.uint8)
    if len(data) < _HEADER.size:
        raise StoreError("its block is shorter than a header")
    scene, a, k, t, d = _HEADER.unpack_from(data)
    shapes, token = group_shapes(a, k, t, d, layout.shape), np.dtype(layout.dtype).newbyteorder("<")
    flags, numbers = (sum(math.prod(shapes[name]) for name in names) for names in (_FLAGS, NUMBERS))
    sizes = (_HEADER.size, -(-flags // 8), a, math.prod(shapes["tokens"]) * token.itemsize, 4 * numbers)
    if sum(sizes) != len(data):
        raise StoreError(f"its block has {len(data)} bytes where the header asks for {sum(sizes)}")
    _, bits, kind, tokens, planes = np.split(data, np.cumsum(sizes)[:-1])
    planes = np.roll(planes.reshape(4, numbers), -1, axis=0)
    arrays = {
        "tokens": _values(tokens.reshape(token.itemsize, -1), token).astype(layout.dtype),
        "agent_kind": kind.copy(),
    }
    arrays |= _parted(np.unpackbits(bits, count=flags).astype(bool), _FLAGS, shapes)
    arrays |= _parted(_values(planes, np.dtype("<f4")).astype(np.float32), NUMBERS, shapes)
    return Group(scene, **{name: array.reshape(shapes[name]) for name, array in arrays.items()})


def _planes(values: np.ndarray) -> np.ndarray:
    """The bytes of little-endian values by weight, ``[n]`` -> ``[bytes, n]``."""
    return np.ascontiguousarray(values).view(np.uint8).reshape(-1, values.itemsize).T


def _values(planes: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Inverse of :func:`_planes`."""
    return np.ascontiguousarray(planes.T).view(dtype)[:, 0]


def _joined(group: Group, names: tuple[str, ...]) -> np.ndarray:
    return np.concatenate([getattr(group, name).ravel() for name in names])


def _parted(values: np.ndarray, names: tuple[str, ...], shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Inverse of :func:`_joined`, still flat."""
    ends = np.cumsum([math.prod(shapes[name]) for name in names])
    return dict(zip(names, np.split(values, ends[:-1]), strict=True))


def _unpacked(block: bytes) -> bytes:
    try:
        size = zstandard.frame_content_size(block)
        if not 0 <= size <= MAX_BYTES:
            raise StoreError(f"its block claims {size} bytes, and at most {MAX_BYTES} are read")
        return zstandard.ZstdDecompressor().decompress(block, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise StoreError(f"its block does not fit its checksum ({error})") from error
