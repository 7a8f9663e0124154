"""Muon: momentum whose matrices are made orthogonal, and AdamW for all that is no matrix.

PyTorch has a Muon too, for matrices alone, one by one, in bfloat16. Here one optimiser holds all parameters, so that
schedule, checkpoint and clipping see one, and matrices of one shape move together, in float32.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.optim import AdamW

MOMENTUM = 0.95
COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""Of the quintic polynomial that lifts every singular value to about 1 in few rounds (Jordan et al. 2024)."""
ROUNDS = 5
RMS = 0.6
"""Root mean square of the entries of a step of matrices at a learning rate of 1. A step of AdamW has about 0.2 (Liu et
al. 2025); matrices bear three times as much, other parameters diverge there (docs/studies/references.md)."""


def orthogonalised(matrix: Tensor) -> Tensor:
    """About ``U V^T`` of matrices ``U S V^T``, by Newton-Schulz iterations.

    Singular values come to lie between 0.68 and 1.13, but for those below a hundredth of the matrix's norm, which stay
    smaller.

    Args:
        matrix: ``[..., n, m]``.

    Examples:
        >>> made = orthogonalised(torch.randn(2, 8, 5, generator=torch.Generator().manual_seed(0)))
        >>> values = torch.linalg.svdvals(made)
        >>> bool(((values > 0.6) & (values < 1.3)).all())
        True
    """
    a, b, c = COEFFICIENTS
    tall = matrix.shape[-2] > matrix.shape[-1]
    x = matrix.mT if tall else matrix
    x = x / x.norm(dim=(-2, -1), keepdim=True).clamp(min=1e-7)
    for _ in range(ROUNDS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * gram @ gram) @ x
    return x.mT if tall else x


class Muon(AdamW):
    """AdamW, but for groups of matrices marked ``orthogonal``, which follow their orthogonalised momentum.

    A step along the gradient is ruled by its few largest singular values; made orthogonal, it moves in all directions
    of a matrix alike (Jordan et al. 2024, "Muon"). Its root mean square is the same for matrices of all shapes (Liu et
    al. 2025, arXiv 2502.16982, section 2.2).

    Args:
        groups: of parameters, each with ``orthogonal``, true for a group of matrices, which may say its ``rms``.
        lr: learning rate.
        betas: decay rates of AdamW's moments.

    Examples:
        >>> net = torch.nn.Linear(4, 4)
        >>> groups = [{"params": [net.weight], "orthogonal": True}, {"params": [net.bias], "orthogonal": False}]
        >>> optimizer, before = Muon(groups, lr=0.1, betas=(0.9, 0.95)), net.weight.detach().clone()
        >>> net(torch.eye(4)).square().sum().backward()
        >>> optimizer.step()
        >>> torch.equal(net.weight, before)
        False
    """

    def __init__(self, groups: Iterable[Mapping[str, Any]], lr: float, betas: tuple[float, float]) -> None:
        # In the groups, so that a run that goes on has the size of step that it began with.
        super().__init__([{"rms": RMS} | dict(group) for group in groups], lr=lr, betas=betas, fused=True)
        self._step_supports_amp_scaling = False

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """Take one step.

        Args:
            closure: not supported: gradients are there before.

        Raises:
            ValueError: one was given.
        """
        if closure is not None:
            raise ValueError("Muon takes no closure; compute the gradients before the step.")
        for group in self.param_groups:
            if group["orthogonal"]:
                self._step_matrices(group)
        return super().step()

    def _step_matrices(self, group: dict[str, Any]) -> None:
        """Move matrices of one shape together, and take their gradients away: AdamW passes over what has none."""
        by_shape: dict[torch.Size, list[Tensor]] = {}
        for parameter in group["params"]:
            if parameter.grad is not None:
                by_shape.setdefault(parameter.shape, []).append(parameter)
        for shape, parameters in by_shape.items():
            ahead = torch.stack([self._momentum(parameter) for parameter in parameters])
            size = group["lr"] * group["rms"] * max(shape) ** 0.5
            for parameter, turned in zip(parameters, orthogonalised(ahead), strict=True):
                parameter.mul_(1 - group["lr"] * group["weight_decay"]).add_(turned, alpha=-size)
                parameter.grad = None

    def _momentum(self, parameter: Tensor) -> Tensor:
        """The mean of past gradients, a step ahead (Nesterov)."""
        state = self.state[parameter]
        if not state:  # its step is what AdamW reads of every state
            state |= {"step": torch.zeros(()), "momentum": torch.zeros_like(parameter)}
        state["step"] += 1
        state["momentum"].lerp_(parameter.grad, 1 - MOMENTUM)
        return parameter.grad.lerp(state["momentum"], MOMENTUM)
