"""A device that a machine without one pretends to have: it computes on the CPU, and forgives nothing.

Tensors there say that they are on :data:`DEVICE`, so code takes the ways that it takes on a GPU. One that meets a
tensor elsewhere is refused, as CUDA would (a number, a tensor without dimensions, may meet any); an index on the host
is refused as well, which CUDA would copy over and wait for. Values are those of the CPU, to the bit.

A process that has pretended is no good for anything else: the name of the device is registered for good.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils import backend_registration
from torch.utils._pytree import tree_leaves, tree_map_only

from recipes.benchmark.counting import COPIES, DeviceCount

DEVICE = "nowhere"
"""Name of the type of device."""


class Nowhere(backend_registration._DummyBackendModule):
    """What PyTorch asks the module of a device."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        """What autocast may compute in."""
        return [torch.bfloat16, torch.float16]

    def synchronize(self, device: object = None) -> None:
        """Nothing is under way."""


def register() -> None:
    """Make the name of the device known to this process; once more does nothing."""
    if torch._C._get_privateuse1_backend_name() != DEVICE:
        backend_registration._setup_privateuseone_for_python_backend(DEVICE, Nowhere())


class There(Tensor):
    """A tensor on :data:`DEVICE`, and the one on the CPU that holds its values."""

    held: Tensor

    @staticmethod
    def __new__(cls, held: Tensor) -> There:
        """Wrap a tensor of the CPU, whose memory is shared."""
        made = Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=torch.device(DEVICE, 0),
        )
        made.held = held
        return made

    def tolist(self) -> Any:
        """As of any tensor on a device: it comes over as a whole."""
        return self.cpu().tolist()

    def __repr__(self, **_: Any) -> str:
        return f"There({self.held!r})"

    @classmethod
    def __torch_dispatch__(
        cls, func: Any, types: Iterable[type], args: tuple = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Outside the mode, which sees operators first, nothing is done."""
        raise RuntimeError(f"{func} on the pretended device, outside of Pretended().")


class Pretended(DeviceCount):
    """While it is entered, :data:`DEVICE` is there, and what happens on it is counted.

    ``with Pretended() as count: (torch.ones(3, device=DEVICE) + 1).sum().item()`` is 6, and has started three kernels
    and waited once.
    """

    def __init__(self) -> None:
        register()
        super().__init__(DEVICE)

    def run(self, func: Callable, args: tuple, kwargs: dict[str, Any]) -> Any:
        """Refuse what does not meet on a device, and what the CPU lacks; compute on the CPU."""
        given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        place = kwargs.get("device")
        there = any(isinstance(value, There) for value in given)
        if func.overloadpacket in COPIES:
            there = isinstance(args[0], There) if place is None else torch.device(place).type == DEVICE
        elif there and (strangers := [v for v in given if not isinstance(v, There) and v.dim()]):
            raise RuntimeError(f"{func} meets a tensor {list(strangers[0].shape)} that is on the CPU.")
        elif place is not None:
            there = torch.device(place).type == DEVICE
        if place is not None and torch.device(place).type == DEVICE:
            kwargs = kwargs | {"device": torch.device("cpu")}
        wrapped = {id(value.held): value for value in given if isinstance(value, There)}
        try:
            out = func(*tree_map_only(There, _held, args), **tree_map_only(There, _held, kwargs))
        except NotImplementedError:
            raise RuntimeError(f"{func} is of GPUs alone, and nobody here knows its values.") from None
        if not there:
            return out
        return tree_map_only(Tensor, lambda value: wrapped[id(value)] if id(value) in wrapped else There(value), out)


def _held(value: Tensor) -> Tensor:
    return value.held if isinstance(value, There) else value
