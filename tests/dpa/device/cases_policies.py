"""Policies and losses stay on their device: a tensor elsewhere, or a number that is read back, fails here.

There is no GPU here. PyTorch runs on a device that computes nothing (fake tensors know shapes, types and devices), a
registered one, since a build for CPUs has no CUDA to pretend. Gradients go through it; what reads anything back does
not, and is in the other cases, on a device that computes.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorDeviceMismatchError, FakeTensorMode

from dpa.losses import ContrastivePreferenceLoss, NextTokenLoss, PolicyGradientLoss, token_network
from dpa.models import MotionModel, collate_contexts, make_context
from dpa.models.base import Observation
from recipes.benchmark.pretended import DEVICE, register
from tests.dpa.families import families, families_and_tokens, smallest


@pytest.fixture(scope="module")
def elsewhere() -> FakeTensorMode:
    """A mode in which tensors are on :data:`DEVICE`."""
    register()
    return FakeTensorMode()


def moved(mode: FakeTensorMode, value: Tensor) -> Tensor:
    with mode:
        return torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device=DEVICE)


def module_there(mode: FakeTensorMode, module: nn.Module) -> nn.Module:
    """A copy whose parameters and buffers are there."""
    module = deepcopy(module)
    for part in module.modules():
        for held in (part._parameters, part._buffers):
            for name, value in held.items():
                if value is not None:
                    there = moved(mode, value.detach())
                    held[name] = nn.Parameter(there) if held is part._parameters else there
    return module


@pytest.fixture
def batch(scene: Callable, elsewhere: FakeTensorMode) -> Callable[..., TensorDict]:
    """Makes a batch of two scenes for a loss, there."""

    def make(model: MotionModel, **entries: Tensor) -> TensorDict:
        contexts = [make_context(scene(count, seed=count), model.featurize) for count in (3, 5)]
        context = collate_contexts(contexts).apply(lambda value: moved(elsewhere, value))
        content = {name: moved(elsewhere, value) for name, value in entries.items()}
        with elsewhere:
            return TensorDict({"context": context, **content}, batch_size=[2])

    return make


def test_the_device_is_one_that_tells_mistakes(elsewhere: FakeTensorMode) -> None:
    with elsewhere:
        there, here = torch.ones(3, device=DEVICE), torch.ones(3)
        with pytest.raises(FakeTensorDeviceMismatchError):
            there + here
        with pytest.raises(DataDependentOutputException):
            there.sum().item()


VALID = torch.ones(2, 1, 5, 16, dtype=torch.bool)


def tokens_for(model: MotionModel) -> Tensor:
    """``[2, 3, 5, 16, ...]``."""
    return torch.zeros(2, 3, 5, 16, *model.tokenizer.shape, dtype=model.tokenizer.dtype)


@families_and_tokens
def test_a_pass_and_its_gradients_stay_on_the_device(
    family: str, make_tokenizer: Callable, batch: Callable, elsewhere: FakeTensorMode
) -> None:
    model = smallest(family, make_tokenizer())
    given = batch(model, tokens=tokens_for(model), valid=VALID)
    there = module_there(elsewhere, model)
    with elsewhere:
        logits = there(given["context"], given["tokens"], given["valid"])
        assert logits.device.type == DEVICE and logits.shape[:4] == (2, 3, 5, 16)
        logits.sum().backward()
    assert all(parameter.grad.device.type == DEVICE for parameter in there.parameters() if parameter.grad is not None)


LOSSES: dict[str, tuple[Callable, Callable[[Tensor], dict[str, Tensor]]]] = {
    "next token": (NextTokenLoss, lambda tokens: {"tokens": tokens[:, :1], "labels": tokens[:, :1]}),
    "pairs": (ContrastivePreferenceLoss, lambda tokens: {"preferred": tokens, "unpreferred": tokens}),
    "policy gradient": (
        PolicyGradientLoss,
        lambda tokens: {
            "tokens": tokens,
            "advantage": torch.zeros(2, 3, 5, 16),
            "sample_log_prob": torch.zeros(2, 3, 5, 16),
        },
    ),
}


@families
@pytest.mark.parametrize(("make_loss", "entries"), LOSSES.values(), ids=LOSSES)
def test_losses_stay_on_the_device(
    family: str, make_loss: Callable, entries: Callable, batch: Callable, elsewhere: FakeTensorMode
) -> None:
    model = smallest(family)
    given = batch(model, token_valid=VALID, **entries(tokens_for(model)))
    there = module_there(elsewhere, model)
    with elsewhere:
        found = make_loss(token_network(there))(given)
        total = sum(value for name, value in found.items() if name.startswith("loss_"))
        assert total.device.type == DEVICE
        total.backward()


@families
def test_a_decision_of_running_rollouts_stays_on_the_device(
    family: str, batch: Callable, elsewhere: FakeTensorMode
) -> None:
    model, shape = smallest(family).eval(), (6, 5)
    given = batch(model)
    there = module_there(elsewhere, model)
    with elsewhere, torch.no_grad():
        memory = there.remember()
        memory.begin(given["context"], 3, anew=True)
        whole, tokenizer = {"dtype": torch.int64, "device": DEVICE}, model.tokenizer
        last = (*shape, *tokenizer.shape)
        for _ in range(2):
            seen = Observation(
                torch.empty(*shape, 6, 3, device=DEVICE), torch.empty(last, dtype=tokenizer.dtype, device=DEVICE),
                torch.empty(6, **whole), 1, torch.empty(shape, **whole),
                torch.empty(shape, dtype=torch.bool, device=DEVICE),
            )  # fmt: skip
            decision = memory.step(seen, lambda logits, agents=None: model.distribution.likeliest(logits))
            assert decision.logits.device.type == decision.token.device.type == DEVICE


if __name__ == "__main__":
    pytest.main([__file__])
