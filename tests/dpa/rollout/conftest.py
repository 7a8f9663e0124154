"""A tiny model and roads of different sizes."""

from __future__ import annotations

import pytest
import torch

from dpa.models.motionlm import MotionLM, MotionLMConfig
from dpa.tokens import VerletTokenizer
from envs.scene import Scene
from envs.sources.synthetic import straight_road

TINY = MotionLMConfig(width=16, heads=2, feed=16, encoder_layers=1, decoder_layers=1)
SIZES = (2, 1, 3, 2)
"""Agents of the roads."""


@pytest.fixture
def model() -> MotionLM:
    torch.manual_seed(0)
    return MotionLM(TINY, VerletTokenizer())


@pytest.fixture
def scenes() -> list[Scene]:
    return [straight_road(size, seed=index) for index, size in enumerate(SIZES)]
