"""What a solver is given, and what it gives back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import torch
from torch import Tensor


@dataclass(frozen=True)
class Problems:
    """N transport problems: move the steps of a rollout onto those of the log.

    Attributes:
        x: ``[N, T, D]`` features of the rollouts; 0 where a step is not valid.
        y: ``[N, T', D]`` of the log, likewise.
        x_valid: ``[N, T]`` bool; valid steps of a side share its mass of 1 equally.
        y_valid: ``[N, T']`` bool.
        weights: ``[D]`` float64, not negative.
        step: time between two steps [s].
    """

    x: Tensor
    y: Tensor
    x_valid: Tensor
    y_valid: Tensor
    weights: Tensor
    step: float

    def __len__(self) -> int:
        return len(self.x)

    @property
    def cost(self) -> Tensor:
        """``[N, T, T']``, see :func:`step_cost`; computed anew at each call."""
        return step_cost(self.x, self.y, self.weights)

    @property
    def x_mass(self) -> Tensor:
        """``[N, T]`` the same mass for each valid step, 1 in all; 0 everywhere if there is none."""
        return _uniform(self.x_valid).to(self.x.dtype)

    @property
    def y_mass(self) -> Tensor:
        """``[N, T']``, likewise."""
        return _uniform(self.y_valid).to(self.y.dtype)

    def split(self, count: int) -> list[Problems]:
        """The same problems, ``count`` at a time."""
        values = (value.split(count) for value in (self.x, self.y, self.x_valid, self.y_valid))
        return [
            replace(self, x=x, y=y, x_valid=x_valid, y_valid=y_valid)
            for x, y, x_valid, y_valid in zip(*values, strict=True)
        ]


def step_cost(x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
    """``sqrt(sum_k w_k (x_k - y_k)^2)``: ``[..., T, D]`` and ``[..., T', D]`` -> ``[..., T, T']``, in their dtype."""
    # Not the matrix-product form, which cancels digits: distances of 0 must come out as 0.
    scaled = (value.double() * weights.sqrt() for value in (x, y))
    return torch.cdist(*scaled, compute_mode="donot_use_mm_for_euclid_dist").to(x.dtype)


class Plan(Protocol):
    """Which mass goes from which step to which."""

    marginal_error: Tensor | None
    """``[N]``: mass that is not where a marginal wants it, or None where marginals hold to rounding."""

    def parts(self, problems: Problems) -> Tensor:
        """``[N, D]`` float64: what each feature pays."""

    def moved(self, problems: Problems) -> Tensor:
        """``[N]`` bool: there is mass."""

    def coupling(self, problems: Problems) -> Tensor:
        """``[N, T, T']``: mass from step to step."""


class Solver(Protocol):
    """A way to couple the steps of two measures: a frozen dataclass whose fields are its options.

    A field made with ``field(compare=False)`` is one that changes no result; provenance leaves it out.
    """

    on_device: ClassVar[bool]
    """It works where the features are; otherwise it brings them to the CPU."""

    def __call__(self, problems: Problems) -> Plan:
        """Solve problems; the plan is :class:`Pairs` or :class:`Dense`."""


@dataclass(frozen=True)
class Pairs:
    """A coupling of few entries, such as an assignment.

    Attributes:
        problem: ``[E]`` int64, of the entry.
        row: ``[E]`` int64, step of x.
        column: ``[E]`` int64, step of y.
        mass: ``[E]`` float64.
        marginal_error: of :class:`Plan`.
    """

    problem: Tensor
    row: Tensor
    column: Tensor
    mass: Tensor
    marginal_error: Tensor | None = None

    def parts(self, problems: Problems) -> Tensor:
        """``[N, D]`` float64, from the matched steps alone."""
        difference = problems.x[self.problem, self.row].double() - problems.y[self.problem, self.column].double()
        paid = self.mass[:, None] * _paid(problems.weights * difference**2)
        total = paid.new_zeros(len(problems), paid.shape[-1])
        return total.index_add_(0, self.problem, paid)

    def moved(self, problems: Problems) -> Tensor:
        """``[N]`` bool."""
        there = torch.zeros(len(problems), dtype=torch.bool, device=self.mass.device)
        return there.index_fill_(0, self.problem, True)

    def coupling(self, problems: Problems) -> Tensor:
        """``[N, T, T']`` float64."""
        plan = self.mass.new_zeros(len(problems), problems.x.shape[1], problems.y.shape[1])
        return plan.index_put_((self.problem, self.row, self.column), self.mass)


@dataclass(frozen=True)
class Dense:
    """A coupling of many entries.

    Attributes:
        mass: ``[N, T, T']``.
        marginal_error: of :class:`Plan`.
    """

    mass: Tensor
    marginal_error: Tensor | None = None

    @classmethod
    def cat(cls, plans: Sequence[Dense]) -> Dense:
        """Plans of problems one after the other."""
        errors = [plan.marginal_error for plan in plans]
        return cls(torch.cat([plan.mass for plan in plans]), None if None in errors else torch.cat(errors))

    def parts(self, problems: Problems) -> Tensor:
        """``[N, D]`` float64."""
        cost = problems.cost
        rate = torch.where(cost > 0, self.mass / cost, 0)
        parts = []
        for x, y, weight in zip(problems.x.unbind(-1), problems.y.unbind(-1), problems.weights, strict=True):
            squared = (x[:, :, None] - y[:, None]) ** 2
            parts.append(weight * (rate * squared).sum((1, 2)))
        return torch.stack(parts, -1).double()

    def moved(self, problems: Problems) -> Tensor:
        """``[N]`` bool."""
        return self.mass.flatten(1).any(1)

    def coupling(self, problems: Problems) -> Tensor:
        """``[N, T, T']``."""
        return self.mass


def _uniform(valid: Tensor) -> Tensor:
    return valid / valid.sum(-1, keepdim=True, dtype=torch.float64).clamp_min(1)


def _paid(squared: Tensor) -> Tensor:
    """Squares ``[..., D]`` over the root of their sum; 0 where that is 0."""
    cost = squared.sum(-1, keepdim=True).sqrt()
    return torch.where(cost > 0, squared / cost, 0)
