"""Fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from envs.scene import Scene
from envs.shards import file_digest, write_shard
from envs.store import Manifest, write_manifest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with real scenes and golden values; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("DPA_SHARED", REPOSITORY.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"needs the real scenes and golden values in {folder} (set DPA_SHARED)")
    return folder


@pytest.fixture(scope="session")
def write_store() -> Callable[[Path, list[Scene]], Path]:
    """Writes scenes to a new folder as a store of one shard."""

    def write(folder: Path, scenes: list[Scene]) -> Path:
        folder.mkdir(parents=True)
        write_shard(folder / "00000", scenes, [("made", row) for row in range(len(scenes))])
        digest = file_digest(folder / "00000" / "shard.json")
        shards = [{"name": "00000", "scenes": len(scenes), "sha256": digest}]
        write_manifest(folder, Manifest("made", {}, "", complete=True, shards=shards))
        return folder

    return write
