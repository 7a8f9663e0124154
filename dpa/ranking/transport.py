"""Optimal transport between two occupancy measures (paper eq. 2 and 3), on plain tensors.

A *problem* is one agent of one rollout against the same agent of the log: two clouds of feature vectors, one vector per
step, each step with the same weight. Cost matrices are built for many problems at once; each problem is then solved
exactly by itself. Between clouds of equal size the best coupling is an assignment, which scipy finds about five times
faster than a general solver; POT solves the others.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import ot
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

PROBLEMS_AT_ONCE = 512
"""Problems whose cost matrices are in memory together (80 x 80 doubles each: 26 MB)."""


class Transport(NamedTuple):
    """What moving one occupancy measure onto another costs."""

    distance: Tensor
    """``[...]`` float32: mean cost per unit of mass; 0 where a side has no valid step."""
    ranked: Tensor
    """``[...]`` bool: both sides have a valid step, so the distance means something."""
    coupling: Tensor | None
    """``[..., T, T']`` float32: mass moved from step to step, summing to 1; only on request."""


Solver = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[float, np.ndarray]]
"""(cost ``[T, T']``, valid ``[T]``, valid ``[T']``) -> (distance, coupling ``[T, T']``)."""


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
) -> Transport:
    """Distance between the occupancy measures of x and y, problem by problem.

    The cost of a step of x and a step of y is ``sqrt(sum_k weights_k (x_k - y_k)^2)``; valid steps of a side share its
    mass equally, so a distance does not grow with the number of steps.

    Args:
        x: ``[..., T, D]`` features, already clipped.
        y: ``[..., T', D]``; leading dimensions broadcast against those of x.
        x_valid: ``[..., T]`` bool, broadcast likewise.
        y_valid: ``[..., T']`` bool.
        weights: ``[D]``, not negative.
        method: ``"exact"`` (time is free: the optimal coupling) or ``"time_aligned"`` (each step with itself, over the
            steps valid on both sides); see :data:`SOLVERS`.
        coupling: also return the couplings.
        threads: problems solved at the same time (scipy releases the interpreter lock).

    Raises:
        ValueError: unknown method, a negative weight, or shapes that do not fit.

    Examples:
        >>> x, y = torch.tensor([[0.0], [1.0]]), torch.tensor([[1.0], [0.0]])
        >>> always = torch.ones(2, dtype=torch.bool)
        >>> transport_cost(x, y, always, always, torch.ones(1)).distance
        tensor(0.)
        >>> transport_cost(x, y, always, always, torch.ones(1), method="time_aligned").distance
        tensor(1.)
    """
    solve = _solver(method)
    weights = torch.as_tensor(weights, dtype=torch.float64)
    if weights.shape != (x.shape[-1],) or y.shape[-1] != x.shape[-1]:
        raise ValueError(
            f"x, y and weights need one size of features, got {x.shape[-1]}, {y.shape[-1]} and {tuple(weights.shape)}."
        )
    if not bool((weights >= 0).all()):
        raise ValueError(f"weights must be numbers of 0 or more, got {weights.tolist()}.")

    device = x.device
    batch = torch.broadcast_shapes(x.shape[:-2], y.shape[:-2], x_valid.shape[:-1], y_valid.shape[:-1])
    x, y = (_flat(v.cpu().double() * weights.sqrt(), batch, 2) for v in (x, y))
    x_valid, y_valid = (_flat(v.cpu(), batch, 1).numpy() for v in (x_valid, y_valid))

    distances, couplings = np.zeros(len(x)), []
    with ThreadPoolExecutor(threads) as pool:
        each = pool.map if threads > 1 else map
        for first in range(0, len(x), PROBLEMS_AT_ONCE):
            part = slice(first, first + PROBLEMS_AT_ONCE)
            # The matrix-product form of cdist cancels digits; distances of 0 must come out as 0.
            costs = torch.cdist(x[part], y[part], compute_mode="donot_use_mm_for_euclid_dist").numpy()
            solved = list(each(solve, costs, x_valid[part], y_valid[part]))
            distances[part] = [distance for distance, _ in solved]
            if coupling:
                couplings += [torch.from_numpy(plan).float() for _, plan in solved]

    ranked = torch.from_numpy(_takes_part(method, x_valid, y_valid)).reshape(batch)
    shape = (*batch, x.shape[-2], y.shape[-2])
    return Transport(
        distance=torch.from_numpy(distances).float().reshape(batch).to(device),
        ranked=ranked.to(device),
        coupling=(torch.stack(couplings) if couplings else torch.zeros(shape)).reshape(shape).to(device)
        if coupling
        else None,
    )


def feature_shares(x: Tensor, y: Tensor, coupling: Tensor, weights: Tensor) -> Tensor:
    """Share of each feature in the squared cost that a coupling pays, over all problems together.

    Tells which feature decides a ranking: units and clip ranges do more than the weights (see ``docs/method``).

    Args:
        x: ``[..., T, D]``.
        y: ``[..., T', D]``.
        coupling: ``[..., T, T']`` of :func:`transport_cost`.
        weights: ``[D]``.

    Returns:
        ``[D]``, summing to 1; all 0 where nothing differs.

    Examples:
        >>> x, y = torch.tensor([[0.0, 0.0]]), torch.tensor([[1.0, 3.0]])
        >>> feature_shares(x, y, torch.ones(1, 1), torch.tensor([1.0, 1.0]))
        tensor([0.1000, 0.9000])
    """
    mass = coupling.double()
    paid = torch.zeros(x.shape[-1], dtype=torch.float64, device=x.device)
    for k, weight in enumerate(weights.tolist()):
        squared = (x[..., :, None, k].double() - y[..., None, :, k].double()) ** 2
        paid[k] = weight * torch.where(mass > 0, mass * squared, 0).sum()
    return (paid / paid.sum().clamp_min(torch.finfo(paid.dtype).tiny)).float()


def _exact(cost: np.ndarray, x_valid: np.ndarray, y_valid: np.ndarray) -> tuple[float, np.ndarray]:
    """The cheapest coupling of the valid steps."""
    rows, columns = np.flatnonzero(x_valid), np.flatnonzero(y_valid)
    plan = np.zeros_like(cost)
    if len(rows) == 0 or len(columns) == 0:
        return 0.0, plan
    cost = np.ascontiguousarray(cost[np.ix_(rows, columns)])
    if len(rows) == len(columns):
        # Birkhoff: with equal uniform marginals some permutation is optimal.
        i, j = linear_sum_assignment(cost)
        plan[rows[i], columns[j]] = 1 / len(rows)
        return float(cost[i, j].mean()), plan
    inner = ot.emd(ot.unif(len(rows)), ot.unif(len(columns)), cost)
    plan[np.ix_(rows, columns)] = inner
    return float((inner * cost).sum()), plan


def _time_aligned(cost: np.ndarray, x_valid: np.ndarray, y_valid: np.ndarray) -> tuple[float, np.ndarray]:
    """Each step with the same step of the other side."""
    if cost.shape[0] != cost.shape[1]:
        raise ValueError(f"time_aligned needs as many steps on both sides, got {cost.shape[0]} and {cost.shape[1]}.")
    steps = np.flatnonzero(x_valid & y_valid)
    plan = np.zeros_like(cost)
    if len(steps) == 0:
        return 0.0, plan
    plan[steps, steps] = 1 / len(steps)
    return float(cost[steps, steps].mean()), plan


SOLVERS: dict[str, Solver] = {"exact": _exact, "time_aligned": _time_aligned}
"""Every way to couple the steps of two measures, by name."""


def _solver(method: str) -> Solver:
    if method not in SOLVERS:
        raise ValueError(f"unknown transport method {method!r}; choose one of {sorted(SOLVERS)}.")
    return SOLVERS[method]


def _takes_part(method: str, x_valid: np.ndarray, y_valid: np.ndarray) -> np.ndarray:
    """``[n]`` bool: the problem has mass to move."""
    return (x_valid & y_valid).any(-1) if method == "time_aligned" else x_valid.any(-1) & y_valid.any(-1)


def _flat(value: Tensor, batch: torch.Size, event_dims: int) -> Tensor:
    """``[*batch, ...]`` as ``[n, ...]``."""
    event = value.shape[value.dim() - event_dims :]
    return value.expand(*batch, *event).reshape(-1, *event)
