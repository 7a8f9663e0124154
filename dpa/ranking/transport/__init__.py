"""Optimal transport between two occupancy measures (paper eq. 2 and 3), on plain tensors.

A *problem* is one agent of one rollout against the same agent of the log: two clouds of feature vectors, one vector per
step, each step with the same weight. A solver couples the steps of the two; what the coupling pays is the distance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from inspect import signature
from typing import Any, NamedTuple

import torch
from torch import Tensor

from dpa.ranking.transport.exact import Exact, TimeAligned, Windowed
from dpa.ranking.transport.problems import Dense, Pairs, Plan, Problems, Solver
from dpa.ranking.transport.sinkhorn import Sinkhorn
from envs.devices import on_host

__all__ = ["SOLVERS", "Dense", "Pairs", "Plan", "Problems", "Solver", "Transport", "make_solver", "transport_cost"]

SOLVERS: dict[str, Callable[..., Solver]] = {
    "exact": Exact,
    "windowed": Windowed,
    "sinkhorn": Sinkhorn,
    "time_aligned": TimeAligned,
}
"""Every way to couple the steps of two measures, by name; what is called with a solver's options gives the solver."""

CELLS_ON_CPU, CELLS_ON_DEVICE = 1 << 22, 1 << 26
"""Entries of the cost matrices that are in memory together."""


class Transport(NamedTuple):
    """What moving one occupancy measure onto another costs; floats have the dtype of the features."""

    distance: Tensor
    """``[...]``: mean cost per unit of mass; 0 where a side has no valid step."""
    ranked: Tensor
    """``[...]`` bool: there was mass to move, so the distance means something."""
    coupling: Tensor | None
    """``[..., T, T']``: mass moved from step to step, summing to 1; only on request."""
    parts: Tensor
    """``[..., D]``: what each feature pays of the distance; they sum to it."""
    marginal_error: Tensor | None
    """``[...]``: mass, of 1, in excess or missing at the steps of x; None from solvers that leave none."""


def make_solver(method: str, **options: Any) -> Solver:
    """A solver by name.

    Raises:
        ValueError: unknown method or option, or a value that the solver refuses.

    Examples:
        >>> make_solver("windowed", window=1.0)
        Windowed(window=1.0)
    """
    if method not in SOLVERS:
        raise ValueError(f"unknown transport method {method!r}; choose one of {sorted(SOLVERS)}.")
    known = list(signature(SOLVERS[method]).parameters)
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise ValueError(
            f"transport method {method!r} has no option {unknown[0]!r}; it takes {', '.join(known) or 'none'}."
        )
    return SOLVERS[method](**options)


def deciding_options(solver: Solver) -> dict[str, Any]:
    """The options of a solver that decide its result.

    Examples:
        >>> deciding_options(make_solver("sinkhorn", epsilon=0.1, compile=True))
        {'epsilon': 0.1, 'start': 1.0, 'iterations': 1000, 'tolerance': 0.01}
    """
    return {field.name: getattr(solver, field.name) for field in dataclasses.fields(solver) if field.compare}


def transport_cost(
    x: Tensor,
    y: Tensor,
    x_valid: Tensor,
    y_valid: Tensor,
    weights: Tensor,
    *,
    method: str = "exact",
    coupling: bool = False,
    threads: int = 1,
    step: float = 0.1,
    **options: Any,
) -> Transport:
    """Distance between the occupancy measures of x and y, problem by problem.

    The cost of a step of x and a step of y is ``sqrt(sum_k weights_k (x_k - y_k)^2)``; valid steps of a side share its
    mass equally, so a distance does not grow with the number of steps. Of a coupled pair, feature k pays
    ``weights_k (x_k - y_k)^2`` over the cost, times the mass.

    Args:
        x: ``[..., T, D]`` features, already clipped.
        y: ``[..., T', D]``; leading dimensions broadcast against those of x.
        x_valid: ``[..., T]`` bool, broadcast likewise.
        y_valid: ``[..., T']`` bool.
        weights: ``[D]``, not negative.
        method: a key of :data:`SOLVERS`: ``"exact"`` (time is free: the optimal coupling), ``"windowed"`` (the optimal
            one of steps near in time), ``"sinkhorn"`` (approximate, batched, where the features are) or
            ``"time_aligned"`` (each step with itself, over the steps valid on both sides).
        coupling: also return the couplings.
        threads: blocks of problems solved at the same time (scipy releases the interpreter lock); changes no result. A
            device has one queue, so there they are not needed.
        step: time between two steps [s].
        options: of the solver, see :class:`~dpa.ranking.transport.exact.Windowed` and
            :class:`~dpa.ranking.transport.sinkhorn.Sinkhorn`.

    Raises:
        ValueError: unknown method or option, a negative weight, or shapes that do not fit.

    Examples:
        >>> x, y = torch.tensor([[0.0], [1.0]]), torch.tensor([[1.0], [0.0]])
        >>> always = torch.ones(2, dtype=torch.bool)
        >>> transport_cost(x, y, always, always, torch.ones(1)).distance
        tensor(0.)
        >>> transport_cost(x, y, always, always, torch.ones(1), method="windowed", window=0.05).distance
        tensor(1.)
        >>> x, y = torch.tensor([[0.0, 0.0]]), torch.tensor([[3.0, 4.0]])
        >>> transport_cost(x, y, always[:1], always[:1], torch.ones(2)).parts
        tensor([1.8000, 3.2000])
    """
    solver = make_solver(method, **options)
    problems, batch = _problems(x, y, x_valid, y_valid, weights, step)
    threads = threads if on_host(x) else 1
    cells = (CELLS_ON_CPU if on_host(x) else CELLS_ON_DEVICE) // max(1, x.shape[-2] * y.shape[-2])
    blocks = problems.split(max(1, min(cells, -(-len(problems) // threads))))

    def solve(block: Problems) -> Transport:
        plan = solver(block)
        parts, moved = plan.parts(block), plan.moved(block)
        return Transport(parts.sum(-1), moved, plan.coupling(block) if coupling else None, parts, plan.marginal_error)

    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            solved = list(pool.map(solve, blocks))
    else:
        solved = list(map(solve, blocks))

    def together(values: tuple[Tensor | None, ...]) -> Tensor | None:
        if values[0] is None:
            return None
        value = torch.cat(values)
        return value.reshape((*batch, *value.shape[1:])).to(torch.bool if value.dtype == torch.bool else x.dtype)

    return Transport(*map(together, zip(*solved, strict=True)))


def _problems(
    x: Tensor, y: Tensor, x_valid: Tensor, y_valid: Tensor, weights: Tensor, step: float
) -> tuple[Problems, torch.Size]:
    """All problems in a row, and how they were arranged."""
    weights = torch.as_tensor(weights, dtype=torch.float64)  # looked at where they are, before they go to the device
    if weights.shape != (x.shape[-1],) or y.shape[-1] != x.shape[-1]:
        raise ValueError(
            f"x, y and weights need one size of features, got {x.shape[-1]}, {y.shape[-1]} and {tuple(weights.shape)}."
        )
    if not bool((weights >= 0).all()):
        raise ValueError(f"weights must be numbers of 0 or more, got {weights.tolist()}.")
    batch = torch.broadcast_shapes(x.shape[:-2], y.shape[:-2], x_valid.shape[:-1], y_valid.shape[:-1])
    x, y = (torch.where(valid[..., None], value, 0) for value, valid in ((x, x_valid), (y, y_valid)))
    x, y = (_flat(value, batch, 2) for value in (x, y))
    x_valid, y_valid = (_flat(value, batch, 1) for value in (x_valid, y_valid))
    return Problems(x, y, x_valid, y_valid, weights.to(x.device), step), batch


def _flat(value: Tensor, batch: torch.Size, event_dims: int) -> Tensor:
    """``[*batch, ...]`` as ``[n, ...]``."""
    event = value.shape[value.dim() - event_dims :]
    return value.expand(*batch, *event).reshape(-1, *event)
