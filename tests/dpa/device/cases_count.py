"""What is counted on a device, by hand; and a device that forgives nothing."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from recipes.benchmark import device as part
from recipes.benchmark.counting import DeviceCount
from recipes.benchmark.pretended import DEVICE, Pretended


def test_kernels_read_backs_and_uploads_are_those_counted_by_hand(there: Pretended) -> None:
    numbers = torch.tensor([[3.0, 1.0], [2.0, 4.0]], device=DEVICE)  # uploaded
    doubled = numbers.T * 2  # one kernel; the view is none
    doubled[0, 0].fill_(7.0)  # one kernel
    total = doubled.sum()  # one kernel
    assert total.item() == 21.0  # read back
    assert doubled.tolist() == [[7.0, 4.0], [2.0, 8.0]]  # read back, at once
    large = doubled[doubled > 3]  # two kernels, and the host asks how many
    assert len(large) == 3
    assert sum(there.kernels.values()) == 5 and there.kernels["mul"] == there.kernels["gt"] == 1
    assert there.read_backs == {"_local_scalar_dense": 1, "_to_copy": 1, "index": 1}
    assert there.uploads == 1


READS: dict[str, Callable[[Tensor], object]] = {
    "number": lambda value: value.sum().item(),
    "truth": lambda value: bool(value.any()),
    "nonzero": lambda value: value.nonzero(),
    "mask": lambda value: value[value > 0],
    "mask written": lambda value: value.clone().__setitem__(value > 0, 0.0),
    "masked_select": lambda value: value.masked_select(value > 0),
    "unique": lambda value: value.unique(),
    "bincount": lambda value: value.long().bincount(),
    "equal": lambda value: torch.equal(value, value),
    "allclose": lambda value: torch.allclose(value, value),
    "copy": lambda value: value.cpu(),
    "copy_": lambda value: torch.zeros(3).copy_(value),
    "synchronize": lambda value: torch.get_device_module(value.device).synchronize(),
}


@pytest.mark.parametrize("read", READS.values(), ids=READS)
def test_every_way_to_ask_a_device_is_counted_once(read: Callable[[Tensor], object], there: Pretended) -> None:
    value = torch.ones(3, device=DEVICE)
    there.reset()
    read(value)
    assert sum(there.read_backs.values()) == 1


def test_what_a_device_can_do_by_itself_waits_for_nobody(there: Pretended) -> None:
    value = torch.arange(3.0, device=DEVICE)
    there.reset()
    kept = torch.where(value > 1, value, 0)[torch.arange(2, device=DEVICE)].cumsum(0)
    value.index_put_((torch.arange(2, device=DEVICE),), kept)
    assert not there.read_backs and there.uploads == 0


def test_a_nested_tensordict_that_has_no_device_makes_the_host_wait(there: Pretended) -> None:
    value = torch.ones(3, device=DEVICE)
    there.reset()
    for device, waits in ((None, 1), (value.device, 0)):
        inner = TensorDict({"value": value}, batch_size=[3], device=device)
        there.reset()
        TensorDict({"inner": inner}, batch_size=[3], device=value.device)
        assert there.read_backs["synchronize"] == waits


def test_a_tensor_of_the_host_is_refused_and_a_number_is_not(there: Pretended) -> None:
    value, here = torch.ones(3, device=DEVICE), torch.ones(3)
    with pytest.raises(RuntimeError, match="on the CPU"):
        value + here
    with pytest.raises(RuntimeError, match="on the CPU"):
        value[torch.tensor([0])]
    assert (value + torch.tensor(1.0)).tolist() == [2.0, 2.0, 2.0]


def test_an_operator_that_only_gpus_have_is_named(there: Pretended) -> None:
    cell, value = torch.nn.GRUCell(3, 3).to(DEVICE), torch.ones(1, 3, device=DEVICE)
    with pytest.raises(RuntimeError, match=r"_thnn_fused_gru_cell.* is of GPUs alone"):
        cell(value, value)


def test_values_are_those_of_the_cpu_and_changes_in_place_are_seen_by_views(there: Pretended) -> None:
    value = torch.zeros(2, 3, device=DEVICE)
    row = value[1]
    assert row.add_(2.0) is row
    value[0].copy_(torch.tensor([1.0, 2.0, 3.0]))
    assert value.tolist() == [[1.0, 2.0, 3.0], [2.0, 2.0, 2.0]]


def test_the_same_operators_are_counted_on_a_cpu() -> None:
    with DeviceCount("cpu") as count:
        found = (torch.arange(4) % 2).nonzero()
    assert len(found) == 2
    assert count.kernels == {"arange": 1, "remainder": 1, "nonzero": 1} and count.read_backs == {"nonzero": 1}


def test_the_benchmark_tells_each_part_of_a_decision() -> None:
    options = {"model": "nano", "agents": 3, "rollouts": 2, "scenes": 2, "signals": ["collision"], "device": DEVICE}
    rows = {row["part"]: row for row in part.run(options)}
    assert rows["policy"]["waits"] == {"_to_copy": 1} and rows["policy"]["uploads"] == 0
    assert rows["env step"]["kernels"] > 100 and rows["env step"]["synchronisations"] == 0
    assert rows["ranking of a scene, exact"]["kernels"] == 0
    assert rows["ranking of a scene, sinkhorn"]["kernels"] > 500


if __name__ == "__main__":
    pytest.main([__file__])
