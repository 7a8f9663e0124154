"""Fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.envs import made

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

    return made.write_store


@pytest.fixture
def make_scenario() -> Callable[..., Any]:
    """Makes a valid Scenario proto that tests then break: cars that drive along x, a lane, a road edge, a light."""
    return made.make_scenario
