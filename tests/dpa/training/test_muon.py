"""Muon: matrices move in all directions alike, and all else as AdamW moves it."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from dpa.training.muon import Muon, orthogonalised
from dpa.training.optim import make_optimizer


class Net(nn.Module):
    """A wide layer, a thin one, and an embedding as wide as the first."""

    def __init__(self) -> None:
        super().__init__()
        self.embedding = nn.Embedding(40, 32)
        self.wide = nn.Linear(32, 48)
        self.thin = nn.Linear(48, 4)

    def forward(self, index: Tensor) -> Tensor:
        return self.thin(self.wide(self.embedding(index)).tanh())


def trained(net: nn.Module, optimizer: torch.optim.Optimizer, steps: range) -> nn.Module:
    for step in steps:
        generator = torch.Generator().manual_seed(step)
        net(torch.randint(40, (16,), generator=generator)).square().mean().backward()
        optimizer.step()
        optimizer.zero_grad()
    return net


@given(rows=st.integers(2, 40), columns=st.integers(2, 40), seed=st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_the_directions_are_those_of_the_polar_factor(rows: int, columns: int, seed: int) -> None:
    """Against scipy: singular vectors are kept, and singular values come near 1 but for those far below the rest."""
    matrix = torch.randn(rows, columns, generator=torch.Generator().manual_seed(seed))
    left, values, right = scipy.linalg.svd(matrix.double().numpy(), full_matrices=False)
    found = left.T @ orthogonalised(matrix).double().numpy() @ right.T
    np.testing.assert_allclose(found, np.diag(found.diagonal()), atol=2e-3)
    large = values > 0.05 * np.linalg.norm(values)
    assert ((found.diagonal()[large] > 0.6) & (found.diagonal()[large] < 1.3)).all()


def test_matrices_of_a_batch_are_made_orthogonal_each_for_itself() -> None:
    matrices = torch.randn(3, 6, 9, generator=torch.Generator().manual_seed(0))
    together = orthogonalised(matrices)
    for matrix, made in zip(matrices, together, strict=True):
        torch.testing.assert_close(made, orthogonalised(matrix))


def test_the_first_step_of_a_matrix_by_hand() -> None:
    """The momentum is a twentieth of the gradient; looked ahead and made orthogonal, its size does not matter."""
    weight = nn.Parameter(torch.randn(32, 48, generator=torch.Generator().manual_seed(0)))
    before, gradient = weight.detach().clone(), torch.randn(32, 48, generator=torch.Generator().manual_seed(1))
    optimizer = Muon([{"params": [weight], "weight_decay": 0.1, "orthogonal": True}], lr=0.01, betas=(0.9, 0.95))
    weight.grad = gradient.clone()
    optimizer.step()
    step = 0.01 * 0.6 * 48**0.5 * orthogonalised(gradient)
    torch.testing.assert_close(weight.detach(), before * (1 - 0.01 * 0.1) - step)
    size = step.square().mean().sqrt()
    assert 0.6 * 0.01 * 0.6 < size < 1.2 * 0.01 * 0.6


@pytest.mark.parametrize("shape", [(32, 48), (64, 40)])
def test_matrices_move_as_those_of_pytorchs_own_muon(shape: tuple[int, int]) -> None:
    """Which iterates in bfloat16, so within a few per cent of a step; at its size of step, and over several of them."""
    torch.manual_seed(0)
    ours, theirs = (nn.Parameter(value) for value in torch.randn(shape).expand(2, *shape).clone())
    optimizers = (
        Muon([{"params": [ours], "weight_decay": 0.1, "orthogonal": True, "rms": 0.2}], lr=0.01, betas=(0.9, 0.95)),
        torch.optim.Muon([theirs], lr=0.01, weight_decay=0.1, adjust_lr_fn="match_rms_adamw"),
    )
    start = ours.detach().clone()
    for _ in range(4):
        gradient = torch.randn(shape)
        for weight, optimizer in zip((ours, theirs), optimizers, strict=True):
            weight.grad = gradient.clone()
            optimizer.step()
    moved = (ours - start).norm()
    assert (ours - theirs).norm() < 0.03 * moved


def test_a_run_that_goes_on_keeps_the_size_of_step_that_it_began_with() -> None:
    begun = make_optimizer(Net(), 0.01, 0.1, kind="muon", rms=0.2)
    resumed = make_optimizer(Net(), 0.01, 0.1, kind="muon")
    resumed.load_state_dict(begun.state_dict())
    assert resumed.param_groups[0]["rms"] == 0.2


def test_what_is_no_wide_matrix_moves_as_adamw_moves_it() -> None:
    torch.manual_seed(0)
    net = Net()
    other = copy.deepcopy(net)
    net.wide.requires_grad_(False)
    other.wide.requires_grad_(False)
    moved = trained(net, make_optimizer(net, 0.01, 0.1, kind="muon"), range(3))
    expected = trained(other, make_optimizer(other, 0.01, 0.1), range(3))
    for name, value in moved.state_dict().items():
        assert torch.equal(value, expected.state_dict()[name]), name


def test_wide_matrices_of_linear_maps_alone_are_made_orthogonal() -> None:
    net = Net()
    names = {id(parameter): name for name, parameter in net.named_parameters()}
    groups = make_optimizer(net, 0.01, 0.1, kind="muon").param_groups
    assert [[names[id(each)] for each in group["params"]] for group in groups if group["orthogonal"]] == [
        ["wide.weight"]
    ]
    decay = {names[id(each)]: group["weight_decay"] for group in groups for each in group["params"]}
    assert {name for name, value in decay.items() if value} == {"wide.weight", "thin.weight"}


def test_a_run_that_is_read_back_goes_on_bit_for_bit() -> None:
    torch.manual_seed(0)
    net = Net()
    optimizer = make_optimizer(net, 0.01, 0.1, kind="muon")
    trained(net, optimizer, range(2))
    again = copy.deepcopy(net)
    resumed = make_optimizer(again, 0.01, 0.1, kind="muon")
    resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    trained(net, optimizer, range(2, 5))
    trained(again, resumed, range(2, 5))
    for name, value in net.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name


def test_a_closure_and_an_unknown_optimiser_are_refused() -> None:
    optimizer = make_optimizer(Net(), 0.01, 0.1, kind="muon")
    with pytest.raises(ValueError, match="takes no closure"):
        optimizer.step(lambda: 0.0)
    with pytest.raises(ValueError, match="must be one of adamw, muon, got 'sgd'"):
        make_optimizer(Net(), 0.01, 0.1, kind="sgd")
