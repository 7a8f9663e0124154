"""How a model is run where it only drives: number format and compilation, behind one option."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn


@dataclass(frozen=True)
class Execution:
    """What may make rollouts faster at the cost of exactness or of a start.

    Attributes:
        precision: ``"bfloat16"`` runs linear layers in bfloat16 (autocast); attention, which holds places relative to
            each other as differences of large numbers, stays in float32. ``"float32"`` is exact.
        compile: let ``torch.compile`` fuse the decoder. The first rollouts then take minutes; worth it on a GPU and for
            large collections.

    Raises:
        ValueError: an unknown precision.

    Examples:
        >>> Execution("bfloat16")
        Execution(precision='bfloat16', compile=False)
    """

    precision: Literal["float32", "bfloat16"] = "float32"
    compile: bool = False

    def __post_init__(self) -> None:
        if self.precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision must be float32 or bfloat16, got {self.precision!r}.")

    def autocast(self, device: torch.device) -> AbstractContextManager:
        """The context in which to call the model."""
        return torch.autocast(device.type, torch.bfloat16, enabled=self.precision == "bfloat16")

    def prepare(self, decoder: nn.Module) -> nn.Module:
        """The decoder to call; it has the weights of the one given."""
        # Lengths grow with each decision, so one program for all of them.
        return torch.compile(decoder, dynamic=True) if self.compile else decoder
