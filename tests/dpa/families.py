"""Families of policies at their smallest, and the tokens that they speak."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from dpa.models import MotionModel
from dpa.models.registry import FAMILIES, build_model, size_of
from dpa.tokens import KDisksTokenizer, MotionTokenizer, PatchTokenizer, VerletTokenizer

OF_PATCHES = ("behaviorgpt",)
"""Families that predict poses and no tokens of a vocabulary."""
TOKENIZERS: dict[str, Callable[[], MotionTokenizer]] = {
    "verlet": VerletTokenizer,
    "k_disks": lambda: KDisksTokenizer.of(torch.rand(5, 30, 5, 3, generator=torch.Generator().manual_seed(0))),
    "patches": lambda: PatchTokenizer(5),
}
NAMES = sorted(FAMILIES)
SPOKEN = [(name, spoken) for name in NAMES for spoken in TOKENIZERS if (spoken == "patches") == (name in OF_PATCHES)]

families = pytest.mark.parametrize("family", NAMES)
families_of_tokens = pytest.mark.parametrize("family", sorted(set(NAMES) - set(OF_PATCHES)))
families_and_tokens = pytest.mark.parametrize(
    ("family", "make_tokenizer"),
    [(name, TOKENIZERS[spoken]) for name, spoken in SPOKEN],
    ids=["-".join(pair) for pair in SPOKEN],
)


def tokens_of(family: str, steps: int = 5) -> MotionTokenizer:
    """What a family speaks if nothing else is said."""
    return PatchTokenizer(steps) if family in OF_PATCHES else VerletTokenizer(steps=steps)


def smallest(family: str, tokenizer: MotionTokenizer | None = None, horizon: int = 16) -> MotionModel:
    """A fresh policy of a family's first size, the same each time."""
    torch.manual_seed(0)
    size = size_of(family, next(iter(FAMILIES[family].sizes))) | {"horizon": horizon}
    return build_model({"family": family, "model": size, "context": {}}, tokenizer or tokens_of(family))
