"""Which parameters decay, how the learning rate moves, and what happens to gradients that are not finite."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import nn

from dpa.training.optim import accumulate_gradients, clip_and_step, make_optimizer, make_schedule


class Net(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.tokens = nn.Embedding(5, 4)
        self.step_embedding = nn.Parameter(torch.zeros(3, 4))
        self.frequency, self.bias = nn.Parameter(torch.zeros(3, 4)), nn.Parameter(torch.zeros(3, 1, 4))
        self.body = nn.TransformerEncoderLayer(4, 2, 8, batch_first=True)
        self.frozen = nn.Linear(4, 4).requires_grad_(False)


def test_only_the_matrices_of_linear_maps_decay() -> None:
    net = Net()
    decayed, spared = make_optimizer(net, lr=1e-3, weight_decay=0.1).param_groups
    names = {id(p): n for n, p in net.named_parameters()}
    assert {names[id(p)] for p in decayed["params"]} == {
        "body.self_attn.in_proj_weight",
        "body.self_attn.out_proj.weight",
        "body.linear1.weight",
        "body.linear2.weight",
    }
    assert (decayed["weight_decay"], spared["weight_decay"]) == (0.1, 0.0)
    assert not any(names[id(p)].startswith("frozen") for p in decayed["params"] + spared["params"])
    assert len(decayed["params"]) + len(spared["params"]) == sum(p.requires_grad for p in net.parameters())


def test_a_frozen_module_is_refused() -> None:
    with pytest.raises(ValueError, match="Linear has no parameter"):
        make_optimizer(nn.Linear(2, 2).requires_grad_(False), lr=1e-3, weight_decay=0.1)


@given(total=st.integers(1, 40), data=st.data(), shape=st.sampled_from(["linear", "cosine"]))
@settings(max_examples=30, deadline=None)
def test_the_rate_rises_to_the_peak_once_and_falls_to_zero(total: int, data: st.DataObject, shape: str) -> None:
    warmup = data.draw(st.integers(0, total - 1))
    net = nn.Linear(1, 1)
    optimizer = make_optimizer(net, lr=2.0, weight_decay=0.0)
    schedule = make_schedule(optimizer, total, warmup, shape)
    rates = []
    for _ in range(total):
        rates.append(schedule.get_last_lr()[0])
        net(torch.ones(1)).sum().backward()
        clip_and_step(optimizer, 1.0, schedule)
    peak = max(warmup - 1, 0)
    assert rates[peak] == max(rates) == 2.0
    assert rates[: peak + 1] == sorted(rates[: peak + 1])
    assert rates[peak:] == sorted(rates[peak:], reverse=True)
    assert min(rates) > 0, "no update is wasted at rate 0"
    assert schedule.get_last_lr()[0] == pytest.approx(0.0)


@pytest.mark.parametrize(("warmup", "shape"), [(5, "linear"), (-1, "linear"), (0, "triangle")])
def test_an_impossible_schedule_is_refused(warmup: int, shape: str) -> None:
    optimizer = make_optimizer(nn.Linear(1, 1), lr=1.0, weight_decay=0.0)
    with pytest.raises(ValueError, match="must"):
        make_schedule(optimizer, 5, warmup, shape)


@pytest.mark.parametrize(("mean", "std"), [(0.5, 1e-4), (1.0, 5e-5), (-700.0, 0.02)])
def test_a_small_spread_around_a_large_mean_outlives_the_parts_of_a_batch(mean: float, std: float) -> None:
    weight = torch.ones((), requires_grad=True)

    def loss(batch: TensorDict) -> TensorDict:
        return TensorDict({"loss_x": weight * 0, "logit_mean": batch["mean"], "logit_std": batch["std"]})

    part = TensorDict({"mean": torch.tensor(mean), "std": torch.tensor(std)})
    found = accumulate_gradients(loss, [(part, 0.5), (part, 0.25), (part, 0.25)])
    assert found["logit_std"].item() == pytest.approx(std, rel=1e-3)
    assert found["logit_mean"].dtype == found["logit_std"].dtype == torch.float32


def test_gradients_are_clipped_and_the_norm_before_clipping_is_returned() -> None:
    weight = nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.SGD([weight], lr=1.0)
    (weight * torch.tensor([3.0, 4.0])).sum().backward()
    assert clip_and_step(optimizer, max_norm=1.0) == pytest.approx(5.0)
    assert torch.allclose(weight, torch.tensor([-0.6, -0.8]), atol=1e-5)
    assert weight.grad is None


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_gradients_that_are_not_finite_stop_the_run(bad: float) -> None:
    net = nn.Linear(1, 1)
    before = net.weight.clone()
    optimizer = make_optimizer(net, lr=1.0, weight_decay=0.1)
    schedule = make_schedule(optimizer, 4)
    (net.weight * bad).sum().backward()
    with pytest.raises(FloatingPointError, match=r"gradient norm is (nan|inf)"):
        clip_and_step(optimizer, 1.0, schedule)
    assert torch.equal(net.weight, before)
    assert schedule.last_epoch == 0


if __name__ == "__main__":
    pytest.main([__file__])
