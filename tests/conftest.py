"""Fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from envs.scene import Scene
from envs.shards import ShardWriter, file_digest
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
def write_store() -> Callable[..., Path]:
    """Writes a store by hand to a folder, one shard for each list of scenes."""

    def write(folder: Path, *shards: list[Scene], source: str = "made", split: str = "") -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        entries = []
        for number, scenes in enumerate(shards):
            writer, path = ShardWriter(), folder / f"{number:05d}.scenes"
            for row, scene in enumerate(scenes):
                writer.add(scene, ("made", row))
            writer.write(path)
            entries.append({"name": path.name, "scenes": len(scenes), "sha256": file_digest(path)})
        write_manifest(folder, Manifest(source, {"split": split}, "", complete=True, shards=entries))
        return folder

    return write
