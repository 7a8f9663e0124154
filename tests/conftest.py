"""Fixtures that all tests share."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from tests.envs import made

REPOSITORY = Path(__file__).resolve().parents[1]
settings.register_profile("any machine", deadline=None)  # how long an example takes says nothing of what it shows
settings.load_profile("any machine")


@pytest.fixture(scope="session", autouse=True)
def _no_logger_at_home(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Weights & Biases keeps its files in a folder of the tests, not in the home of whoever runs them."""
    folder = tmp_path_factory.mktemp("wandb")
    for name in ("WANDB_DATA_DIR", "WANDB_CACHE_DIR", "WANDB_CONFIG_DIR"):
        os.environ[name] = str(folder)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder with real scenes and golden values; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("DPA_SHARED", REPOSITORY.parent / "shared"))
    if not (folder / "scenes").is_dir():
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
