"""SMART has the parameters that its sizes are named for."""

from __future__ import annotations

import pytest
import torch

from dpa.models.context import collate_contexts, make_context
from dpa.models.smart import SMART
from dpa.tokens import KDisksTokenizer, VerletTokenizer
from envs.sources.synthetic import straight_road


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


@pytest.mark.parametrize("size", ["1m", "7m", "102m"])
def test_sizes_that_are_not_trained_here_pass_forward(size: str) -> None:
    motions = torch.rand(5, 1024, 5, 3, generator=torch.Generator().manual_seed(0))
    model = SMART(size, KDisksTokenizer.of(motions)).eval()
    context = collate_contexts([make_context(straight_road(2), model.featurize)])
    tokens = torch.randint(1024, (1, 1, 2, 16), generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        logits = model(context, tokens, torch.ones(1, 1, 2, 16, dtype=torch.bool))
    assert logits.shape == (1, 1, 2, 16, 1024)
    assert logits.isfinite().all()
    assert logits.std(-1).amin() > 0, "some tokens are likelier than others"
