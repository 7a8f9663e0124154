"""Files of blocks behind each other with a record of them at the end: what scene and preference stores are made of.

    magic | block | block | ... | record (JSON, packed) | length of the record | magic

A block is read alone, by one seek, and the record without touching a block. Who writes the file says what is in both.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import zstandard

LEVEL = 6
"""Of Zstandard, for a record: kilobytes beside megabytes of blocks."""
MAX_RECORD = 1 << 23
"""Bytes of an unpacked record: that of 256 scenes has about 50,000, and decoded JSON can take forty times its size."""


@dataclass(frozen=True)
class Framing:
    """The frame of one kind of file.

    Attributes:
        kind: what such a file is called in an error.
        magic: its first and last bytes, which tell kind and version.

    Examples:
        >>> import tempfile
        >>> framing = Framing("pair", b"PAIRS" + bytes([1]))
        >>> path = Path(tempfile.mkdtemp(), "a.pairs")
        >>> _ = path.write_bytes(framing.pack([b"one", b"three"], {"sizes": [3, 5]}))
        >>> record, end = framing.read_record(path)
        >>> framing.offsets(record["sizes"]), end
        ([6, 9], 14)
    """

    kind: str
    magic: bytes

    @property
    def _footer(self) -> struct.Struct:
        return struct.Struct(f"<Q{len(self.magic)}s")

    def pack(self, blocks: Sequence[bytes], record: Any) -> bytes:
        """All bytes of a file.

        Args:
            blocks: in order.
            record: of them, as JSON can hold it.

        Raises:
            ValueError: the record is larger than any that is read back.
        """
        text = json.dumps(record).encode()
        if len(text) > MAX_RECORD:
            raise ValueError(f"a {self.kind} of {len(blocks)} blocks is too large to be read back; put fewer into one.")
        packed = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True).compress(text)
        return b"".join([self.magic, *blocks, packed, self._footer.pack(len(packed), self.magic)])

    def offsets(self, sizes: Sequence[int]) -> list[int]:
        """Where each block begins, from the sizes of all."""
        return list(accumulate(sizes[:-1], initial=len(self.magic)))

    def read_record(self, path: Path) -> tuple[Any, int]:
        """The record of a file, and where its last block ends.

        Args:
            path: of the file.

        Raises:
            OSError: it cannot be read.
            ValueError: it is of another kind or version, cut, or its record is damaged.
        """
        with path.open("rb") as file:
            size, footer = file.seek(0, os.SEEK_END), self._footer
            file.seek(max(0, size - footer.size))
            last = file.read(footer.size)
            length, magic = footer.unpack(last) if len(last) == footer.size else (0, b"")
            if magic != self.magic or not 0 < length <= size - footer.size:
                raise ValueError(f"no {self.kind} of version {self.magic[-1]}, or a cut one")
            end = size - footer.size - length
            file.seek(end)
            return json.loads(_unpacked(file.read(length))), end

    def check_sizes(self, sizes: Sequence[int], end: int) -> None:
        """Refuse sizes that do not fill the file up to its record.

        Raises:
            ValueError: they do not.
        """
        if len(self.magic) + sum(sizes) != end:
            raise ValueError("sizes are not those of its blocks")


def _unpacked(packed: bytes) -> bytes:
    try:
        if not 0 <= zstandard.frame_content_size(packed) <= MAX_RECORD:
            raise ValueError("a record of that size is none of ours")
        return zstandard.ZstdDecompressor().decompress(packed, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise ValueError(str(error)) from None
