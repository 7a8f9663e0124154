"""Kernels that a piece of code starts on a device, and how often it makes the device and the host wait for each other.

What is counted are operators as PyTorch dispatches them. One of them may start several kernels (a sort does), so their
number is a lower bound of that of kernels; it does not depend on the machine.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Self

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

aten = torch.ops.aten

SIZE_READ = {
    aten.nonzero, aten.masked_select, aten.bincount, aten.equal, aten.allclose, aten.is_nonzero, aten._unique2,
    aten.unique_dim, aten.unique_consecutive, aten._local_scalar_dense,
}  # fmt: skip
"""Operators whose result, or the size of it, the host has to know."""
INDEXED = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
"""Operators that ask how many entries of a mask are set, where they are given a mask."""
COPIES = {aten._to_copy, aten.copy_, aten._copy_from}
NO_WORK = {
    aten.empty, aten.empty_like, aten.empty_strided, aten.new_empty, aten.new_empty_strided, aten.detach,
    aten.lift_fresh, aten._local_scalar_dense, aten.is_same_size, aten.resize_, aten.set_,
}  # fmt: skip
"""Operators that compute nothing; those that give a view are told by their schema."""


class DeviceCount(TorchDispatchMode):
    """Counts, while it is entered, what happens on devices of one type.

    Args:
        device: a type of device, ``"cuda"`` for instance; with ``"cpu"``, which waits for nobody, ``read_backs`` are
            those of a device that would run the same operators, as far as they are operators: ``tolist`` is none there.

    Attributes:
        kernels: operators that compute there, by name; copies between device and host are none.
        read_backs: what the host waits for by name: operators of which it knows a value or a size, ``synchronize``.
        uploads: copies from the host to the device.

    Examples:
        >>> with DeviceCount("cpu") as count:
        ...     found = (torch.ones(3) + 1).view(3, 1).nonzero()
        >>> sorted(count.kernels.elements()), sum(count.read_backs.values())
        (['add', 'nonzero', 'ones'], 1)
    """

    def __init__(self, device: str) -> None:
        super().__init__()
        self.device, self._lift, self._plain = device, [], []
        module = torch.get_device_module(device)
        # TensorDict waits for an event of CUDA, and for all of a device that has none.
        self._waiting = [one for one in (module, getattr(module, "Event", None)) if hasattr(one, "synchronize")]
        self.reset()

    def reset(self) -> None:
        """Begin at 0."""
        self.kernels: Counter[str] = Counter()
        self.read_backs: Counter[str] = Counter()
        self.uploads = 0

    def __enter__(self) -> Self:
        """Count from here on."""
        # torch.tensor(..., device=...) would copy to the device unseen; so it makes a tensor here and copies it.
        self._lift.append(torch._C._only_lift_cpu_tensors())
        torch._C._set_only_lift_cpu_tensors(True)
        for owner in self._waiting:
            self._plain.append((owner, owner.synchronize))
            owner.synchronize = self._counted(owner.synchronize)
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        """Count no more."""
        torch._C._set_only_lift_cpu_tensors(self._lift.pop())
        for _ in self._waiting:
            owner, plain = self._plain.pop()
            owner.synchronize = plain
        super().__exit__(*error)

    def _counted(self, synchronize: Callable) -> Callable:
        def wait(*args: Any, **kwargs: Any) -> Any:
            self.read_backs["synchronize"] += 1
            return synchronize(*args, **kwargs)

        return wait

    def __torch_dispatch__(
        self, func: Any, types: Iterable[type], args: tuple = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Run the operator, and count it."""
        out = self.run(func, args, dict(kwargs or {}))
        self._count(func, args, kwargs or {}, out)
        return out

    def run(self, func: Callable, args: tuple, kwargs: dict[str, Any]) -> Any:
        """Run the operator."""
        return func(*args, **kwargs)

    def _count(self, func: Any, args: tuple, kwargs: Mapping[str, Any], out: Any) -> None:
        name = func.overloadpacket.__name__
        given, made = (self._there(value) for value in ((args, kwargs), out))
        if not given and not made:
            return
        if func.overloadpacket in COPIES:
            # copy_(to, from) is given both sides; _to_copy makes the other one.
            source = args[1] if func.overloadpacket is not aten._to_copy else args[0]
            target = args[0] if func.overloadpacket is not aten._to_copy else out
            if self._is_there(source) != self._is_there(target):
                if self._is_there(target):
                    self.uploads += 1
                else:
                    self.read_backs[name] += 1
                return
        masked = func.overloadpacket in INDEXED and any(index.dtype is torch.bool for index in _tensors(args[1]))
        if masked or func.overloadpacket in SIZE_READ:
            self.read_backs[name] += 1
        if func.overloadpacket not in NO_WORK and not _gives_view(func):
            self.kernels[name] += 1

    def _is_there(self, value: Tensor) -> bool:
        return value.device.type == self.device

    def _there(self, values: Any) -> bool:
        return any(self._is_there(value) for value in _tensors(values))


def _tensors(values: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(values) if isinstance(leaf, Tensor)]


def _gives_view(func: Any) -> bool:
    """It gives another look at what it is given, and writes nothing."""
    aliases = [result.alias_info for result in func._schema.returns]
    return any(alias is not None and not alias.is_write for alias in aliases)
