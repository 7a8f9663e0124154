"""The number format that a model's linear layers run in."""

from __future__ import annotations

from typing import Literal, get_args

import torch

Precision = Literal["float32", "bfloat16"]
PRECISIONS: tuple[str, ...] = get_args(Precision)


def check_precision(precision: str) -> Precision:
    """Give the precision back.

    Raises:
        ValueError: it is none that a policy runs in.
    """
    if precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, got {precision!r}.")
    return precision


def running_in(precision: Precision, device: torch.device) -> torch.autocast:
    """Context in which linear layers run in a precision; attention that holds places stays in float32.

    Examples:
        >>> with running_in("bfloat16", torch.device("cpu")):
        ...     torch.nn.Linear(2, 1)(torch.ones(1, 2)).dtype
        torch.bfloat16
    """
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16")
