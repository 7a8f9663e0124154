"""Solvers without approximation, one problem at a time on the CPU; and the coupling of equal times."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import ot
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from dpa.ranking.transport.problems import Pairs, Problems

SIMPLEX_STEPS = 10_000_000
"""Of POT's network simplex: a limit that clouds of some hundred points never reach."""


@dataclass(frozen=True)
class Exact:
    """The cheapest coupling; time is free.

    With equal counts the marginals are those of a permutation matrix, so an assignment is optimal (Birkhoff), which
    scipy finds several times faster than a general solver would; POT's network simplex solves the rest.
    """

    on_device: ClassVar[bool] = False

    def __call__(self, problems: Problems) -> Pairs:
        """Solve; see :class:`~dpa.ranking.transport.Solver`."""
        return _solve(problems, reach=None)


@dataclass(frozen=True)
class Windowed:
    """The cheapest coupling of steps that are at most a window apart in time.

    Where holes leave some step without enough mass in reach, no coupling keeps to the window. The window of that
    problem is then widened to the smallest one that some coupling keeps to, which on the line of time has a closed
    form: the longest way of the coupling that keeps the order. A rollout and its log have the same valid steps, so
    their window is never widened.

    Args:
        window: time [s]; as many whole steps as fit into it.

    Raises:
        ValueError: a window below 0.
    """

    on_device: ClassVar[bool] = False

    window: float = 2.0

    def __post_init__(self) -> None:
        if not self.window >= 0:
            raise ValueError(f"window must be 0 s or more, got {self.window}.")

    def __call__(self, problems: Problems) -> Pairs:
        """Solve; see :class:`~dpa.ranking.transport.Solver`."""
        # 0.3 / 0.1 is a little less than 3.
        return _solve(problems, reach=self.window / problems.step * (1 + 1e-9))


@dataclass(frozen=True)
class TimeAligned:
    """Each step with the same step of the other side, over the steps that are valid on both."""

    on_device: ClassVar[bool] = False

    def __call__(self, problems: Problems) -> Pairs:
        """Solve; see :class:`~dpa.ranking.transport.Solver`.

        Raises:
            ValueError: the sides have different numbers of steps.
        """
        steps, other = problems.x.shape[1], problems.y.shape[1]
        if steps != other:
            raise ValueError(f"time_aligned needs as many steps on both sides, got {steps} and {other}.")
        both = problems.x_valid & problems.y_valid
        problem, step = both.nonzero(as_tuple=True)
        return Pairs(problem, step, step, (1 / both.sum(-1).double())[problem])


def _solve(problems: Problems, reach: float | None) -> Pairs:
    """The cheapest coupling of each problem, with a limit on the steps between partners where one is given.

    Solvers are on the CPU: features on a device come over, here, and the couplings go back.
    """
    x, y = ((value.double() * problems.weights.sqrt()).cpu().numpy() for value in (problems.x, problems.y))
    x_valid, y_valid = (valid.cpu().numpy() for valid in (problems.x_valid, problems.y_valid))
    device = problems.x.device
    problem, row, column, mass = [], [], [], []
    for index in range(len(problems)):
        rows, columns = np.flatnonzero(x_valid[index]), np.flatnonzero(y_valid[index])
        if len(rows) == 0 or len(columns) == 0:
            continue
        # cdist takes differences before it squares them: what is equal has a cost of 0.
        cost = cdist(x[index][rows], y[index][columns])
        far = None if reach is None else _out_of_reach(rows, columns, reach)
        i, j, part = _assign(cost, far) if len(rows) == len(columns) else _transport(cost, far)
        problem.append(np.full(len(i), index))
        row.append(rows[i])
        column.append(columns[j])
        mass.append(part)

    def together(values: list[np.ndarray], dtype: type) -> torch.Tensor:
        return torch.from_numpy(np.concatenate(values or [np.zeros(0, dtype)])).to(device)

    return Pairs(
        together(problem, np.int64), together(row, np.int64), together(column, np.int64), together(mass, float)
    )


def _assign(cost: np.ndarray, far: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and mass of an optimal assignment."""
    i, j = linear_sum_assignment(cost if far is None else np.where(far, np.inf, cost))
    return i, j, np.full(len(i), 1 / len(i))


def _transport(cost: np.ndarray, far: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and mass of an optimal coupling between unequal counts."""
    if far is not None:
        # Mass on one forbidden entry can be moved to allowed ones along a cycle of fewer than n + m entries.
        cost = np.where(far, (sum(cost.shape) + 1) * (cost.max() + 1), cost)
    n, m = cost.shape
    plan = ot.emd(ot.unif(n), ot.unif(m), np.ascontiguousarray(cost), numItermax=SIMPLEX_STEPS)
    plan = np.rint(plan * (n * m)) / (n * m)  # masses of a vertex; rounding left traces on other entries
    i, j = plan.nonzero()
    return i, j, plan[i, j]


def _out_of_reach(rows: np.ndarray, columns: np.ndarray, reach: float) -> np.ndarray:
    """``[n, m]`` bool: steps too far apart to be coupled."""
    n, m = len(rows), len(columns)
    # In units of 1 / (n m), row i holds the mass from i m on, column j that from j n on.
    start = np.union1d(np.arange(n) * m, np.arange(m) * n)
    needed = np.abs(rows[start // m] - columns[start // n]).max()
    return np.abs(rows[:, None] - columns) > max(math.floor(reach) if reach < np.inf else reach, needed)
