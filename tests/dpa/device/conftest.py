"""Scenes, and a device that is pretended. Cases run in a process of their own, for the device stays registered."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch

from envs.scene import Scene
from recipes.benchmark.pretended import Pretended
from tests.dpa.models.conftest import lively_scene


@pytest.fixture
def scene() -> Callable[..., Scene]:
    """Makes scenes with agents of all classes, lanes, a light and holes in their logs."""
    return lively_scene


@pytest.fixture
def there() -> Iterator[Pretended]:
    """The pretended device, which computes and counts."""
    with torch.no_grad(), Pretended() as count:
        yield count
