"""SMART has the parameters that its sizes are named for."""

from __future__ import annotations

import pytest
import torch

from dpa.models.smart import SMART
from dpa.tokens import KDisksTokenizer, VerletTokenizer


def parameters(size: str, words: int) -> int:
    with torch.device("meta"):
        model = SMART(size, KDisksTokenizer(5, words, "of a test"))
    return sum(parameter.numel() for parameter in model.parameters())


@pytest.mark.parametrize(("size", "published"), [("1m", 1.2e6), ("7m", 7e6), ("102m", 102e6)])
def test_sizes_have_the_parameters_published_with_1024_motions_a_class(size: str, published: float) -> None:
    assert parameters(size, 1024) == pytest.approx(published, rel=0.1)


def test_the_smallest_is_as_large_as_the_smallest_motionlm() -> None:
    model = SMART("nano", VerletTokenizer())
    assert sum(parameter.numel() for parameter in model.parameters()) == pytest.approx(0.15e6, rel=0.1)
