"""Entropic transport: an approximation whose work is batched, for accelerators."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from dpa.ranking.transport.problems import Dense, Problems
from envs.devices import on_host

CHECK_EVERY = 10
"""Iterations between two looks at the marginal error; on a device each look waits for it."""
CELLS_AT_ONCE = 1 << 17
"""Of cost matrices on a CPU: what a core's cache holds. A device takes all that it is given."""


@dataclass(frozen=True)
class Sinkhorn:
    """The coupling of least cost plus ``epsilon * mean cost`` times its entropy, in the log domain.

    The distance is the cost of the coupling without its entropy. It lies above the exact one, and the log is not at 0
    from itself; both go to the exact value with epsilon. Each problem stops by itself, so its result does not depend on
    the problems beside it. Cuturi, "Sinkhorn distances", NeurIPS 2013; log domain and annealing as in Peyre and Cuturi,
    "Computational optimal transport", 2019, section 4.4.

    Args:
        epsilon: regularisation, in units of the problem's mean cost.
        start: regularisation to begin with, halved every ten iterations down to ``epsilon``; None begins there.
        iterations: at most, each an update of both sides.
        tolerance: stop at this marginal error (mass, of 1 in all, that is in excess or missing at the steps of x).
        compile: run iterations through ``torch.compile``, for GPUs; the result differs by rounding alone.

    Raises:
        ValueError: an option out of its range.

    Warns:
        UserWarning: some problem stopped by ``iterations`` and not by ``tolerance``.
    """

    on_device: ClassVar[bool] = True

    epsilon: float = 0.02
    start: float | None = 1.0
    iterations: int = 1000
    tolerance: float = 1e-2
    compile: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("epsilon", "iterations", "tolerance"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} of sinkhorn must be above 0, got {getattr(self, name)}.")
        if self.start is not None and not self.epsilon <= self.start < math.inf:
            raise ValueError(f"start of sinkhorn must be epsilon ({self.epsilon}) or more, got {self.start}.")
        if self.iterations <= self.annealing:
            raise ValueError(
                f"iterations of sinkhorn must be more than the {self.annealing} that lead from start ({self.start}) to "
                f"epsilon ({self.epsilon}), got {self.iterations}."
            )

    @property
    def annealing(self) -> int:
        """Iterations before ``epsilon`` is reached."""
        return 0 if self.start is None else CHECK_EVERY * math.ceil(math.log2(self.start / self.epsilon))

    def __call__(self, problems: Problems) -> Dense:
        """Solve; see :class:`~dpa.ranking.transport.Solver`."""
        if not on_host(problems.x) or len(problems) == 0:
            return self._solve(problems)
        count = max(1, CELLS_AT_ONCE // max(1, problems.x.shape[1] * problems.y.shape[1]))
        return Dense.cat([self._solve(some) for some in problems.split(count)])

    def _solve(self, problems: Problems) -> Dense:
        update = _compiled() if self.compile else _update
        cost, a, b = problems.cost, problems.x_mass, problems.y_mass
        there = a.any(-1) & b.any(-1)
        log_a, log_b = (torch.where(there[:, None], mass, 1).log() for mass in (a, b))  # no mass would give NaN
        pairs = a[:, :, None] * b[:, None]
        mean = (pairs * cost).sum((1, 2), keepdim=True)
        cost = cost / torch.where(mean > 0, mean, 1)

        # u and v are potentials in units of epsilon; those of a problem that has converged stand still.
        epsilon = self.epsilon if self.start is None else self.start
        u, v = torch.zeros_like(a), torch.zeros_like(b)
        done, error = ~there, torch.zeros_like(mean[:, 0, 0])
        for first in range(0, self.iterations, CHECK_EVERY):
            scaled, new_u, new_v = cost / epsilon, u, v
            for _ in range(min(CHECK_EVERY, self.iterations - first)):
                new_u, new_v = update(scaled, new_v, log_a, log_b)
            u, v = torch.where(done[:, None], u, new_u), torch.where(done[:, None], v, new_v)
            if epsilon > self.epsilon:
                following = max(epsilon / 2, self.epsilon)
                u, v, epsilon = u * (epsilon / following), v * (epsilon / following), following
                continue
            # The update of v has set the mass at y; what u would change next is wrong at x.
            left = (a * (u - _potential(scaled, v, log_b, 2)).expm1().abs()).sum(-1)
            error = torch.where(done, error, left)
            done = done | (error <= self.tolerance)
            if bool(done.all()):  # all that is read back from the device
                break
        else:
            warnings.warn(
                f"sinkhorn left couplings further than tolerance={self.tolerance:g} from their marginals after "
                f"iterations={self.iterations}; allow more of these, or a larger epsilon than {self.epsilon:g}.",
                stacklevel=2,
            )
        coupling = pairs * (u[:, :, None] + v[:, None] - cost / epsilon).exp()
        # Steps that do not count have no cost, and potentials at will.
        return Dense(coupling.where(pairs > 0, 0.0), error)


def _potential(scaled: Tensor, other: Tensor, log_mass: Tensor, dim: int) -> Tensor:
    """The potential of one side that gives it its marginal, from that of the other side, along ``dim``."""
    return -torch.logsumexp((other + log_mass).unsqueeze(3 - dim) - scaled, dim)


def _update(scaled: Tensor, v: Tensor, log_a: Tensor, log_b: Tensor) -> tuple[Tensor, Tensor]:
    """One iteration: both potentials, ``[N, T]`` and ``[N, T']``."""
    u = _potential(scaled, v, log_b, 2)
    return u, _potential(scaled, u, log_a, 1)


@functools.cache
def _compiled() -> Callable[..., tuple[Tensor, Tensor]]:
    return torch.compile(_update)
