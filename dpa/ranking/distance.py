"""The preference distance of rollouts to the log of their scene (paper eq. 3), and the ranks that follow."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from dpa.ranking.displacement import average_displacement
from dpa.ranking.features import (
    feature_clips,
    feature_names,
    feature_weights,
    log_trajectory,
    logged_steps,
    occupancy_features,
)
from dpa.ranking.transport import Transport, deciding_options, make_solver, transport_cost
from dpa.ranking.transport.problems import step_cost
from envs.scene import CURRENT_STEP, STEP_SECONDS, Scene

AGGREGATES: dict[str, Callable[[Tensor], Tensor]] = {
    "sum": lambda distance: distance.sum(-1),
    "mean": lambda distance: distance.mean(-1),
    "median": lambda distance: distance.quantile(0.5, dim=-1),
    "max": lambda distance: distance.amax(-1),
    "mean_rank": lambda distance: _ranks(distance).mean(-1),
}
"""From the ranked agents' distances ``[R, E]`` to the scene's ``[R]``.

The paper sums. One agent often carries most of a sum; ``median`` leaves such an agent no more than its place in the
order, and ``mean_rank`` gives each agent the same say: the mean over agents of the rollout's rank in the eyes of that
agent, 1 for the nearest.
"""


AGENTS = ("controlled", "evaluated")
"""Whom a distance ranks: all controlled agents, or of these the SDC and the tracks to predict."""


class Ranking(NamedTuple):
    """R rollouts of one scene against its log; A are the agents present at the current step, D features."""

    distance: Tensor
    """``[R]``: agents aggregated; 0 where no agent is ranked."""
    agent_distance: Tensor
    """``[R, A]``: 0 where the agent took no part."""
    ade: Tensor
    """``[R]``: mean displacement from the log over the ranked agents [m]."""
    agent_ranked: Tensor
    """``[A]`` bool."""
    feature_share: Tensor
    """``[R, D]``: share of each feature in the summed distance of the ranked agents, whatever the aggregate; rows sum
    to 1, or are 0 where that distance is 0. It tells which feature decides: units and clip ranges do more than weights.
    """


class Coupled(NamedTuple):
    """Occupancy measures of E agents in R rollouts and in the log, coupled; T' measured steps, D features."""

    rollouts: Tensor
    """``[R, E, T', D]`` features, clipped."""
    log: Tensor
    """``[E, T', D]``."""
    valid: Tensor
    """``[E, T']`` bool, of the log and so of the rollouts."""
    weights: Tensor
    """``[D]``."""
    moved: Transport
    """Of ``[R, E]`` problems."""

    @property
    def paid(self) -> Tensor:
        """``[R, E, T']``: what each measured step of a rollout pays under the coupling; they sum to the distance."""
        return (self.moved.coupling * step_cost(self.rollouts, self.log, self.weights)).sum(-1)


class Distance(Protocol):
    """How rollouts of a scene are compared with its log: :class:`PreferenceDistance`, or a function of your own.

    One that has a true attribute ``on_device`` is given trajectories where they were rolled out; any other gets them on
    the CPU.
    """

    def __call__(self, scene: Scene, trajectories: Tensor, controlled: Tensor, /) -> Ranking:
        """Rank rollouts of one scene.

        Args:
            scene: an uncollated scene, on the CPU.
            trajectories: ``[R, A, T, 4]`` x, y, z, heading at 10 Hz after the current step, of the present agents in
                order.
            controlled: ``[A]`` bool, on the CPU.

        Returns:
            the ranking; D is the same for all scenes and may be 0.
        """

    def describe(self) -> dict[str, Any]:
        """What decides a ranking, ready for JSON; a preference store keeps it. Only recipes ask for it."""


def rank_of(distance: Tensor) -> Tensor:
    """Rank of each rollout, 0 for the nearest; ties go to the smaller index.

    Args:
        distance: ``[..., K]``.

    Returns:
        ``[..., K]`` int64.

    Examples:
        >>> rank_of(torch.tensor([0.5, 0.1, 0.5, 0.2]))
        tensor([2, 0, 3, 1])
    """
    return distance.argsort(dim=-1, stable=True).argsort(dim=-1)


@dataclass(frozen=True)
class PreferenceDistance:
    """How far rollouts lie from the log, as a function with options.

    Args:
        features: a set of :data:`~dpa.ranking.features.FEATURE_SETS`, or names of features.
        weights: the name of a set of weights, or weights that differ from the paper's, by feature.
        clips: clip ranges that differ from the registered ones, by feature.
        stride: measure every ``stride``-th step of 0.1 s.
        method: a key of :data:`~dpa.ranking.transport.SOLVERS`.
        solver: options of the method: ``window`` [s], or those of :class:`~dpa.ranking.transport.sinkhorn.Sinkhorn`.
        aggregate: a key of :data:`AGGREGATES`.
        agents: rank all ``"controlled"`` agents, or of these only the ``"evaluated"`` ones.
        threads: blocks of transport problems solved at the same time; changes no result.

    Raises:
        ValueError: an unknown name among the options; the message lists the known ones.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> log = log_trajectory(scene, 80)
        >>> slower = log - torch.linspace(0, 20, 80)[:, None] * torch.tensor([1.0, 0, 0, 0])
        >>> ranking = PreferenceDistance()(scene, torch.stack((slower, log)))
        >>> ranking.distance
        tensor([5.2433, 0.0000])
        >>> rank_of(ranking.distance)
        tensor([1, 0])
    """

    features: str | Sequence[str] = "full"
    weights: str | Mapping[str, float] | None = None
    clips: Mapping[str, tuple[float, float]] | None = None
    stride: int = 1
    method: str = "exact"
    solver: Mapping[str, Any] = field(default_factory=dict)
    aggregate: str = "sum"
    agents: Literal["controlled", "evaluated"] = "controlled"
    threads: int = 1

    def __post_init__(self) -> None:
        names = feature_names(self.features)
        if self.stride < 1:
            raise ValueError(f"stride must be 1 or more steps, got {self.stride}.")
        feature_weights(names, self.weights)
        feature_clips(names, self.clips)
        make_solver(self.method, **self.solver)
        check_options(self, aggregate=AGGREGATES, agents=AGENTS)

    @property
    def on_device(self) -> bool:
        """Features and transport are computed where trajectories are; exact solvers would bring the features back."""
        return make_solver(self.method, **self.solver).on_device

    def describe(self) -> dict[str, Any]:
        """The options that decide a ranking, with defaults filled in, ready for JSON."""
        names = feature_names(self.features)
        return {
            "kind": "preference",
            "weights": dict(zip(names, feature_weights(names, self.weights).tolist(), strict=True)),
            "clips": {name: list(clip) for name, clip in feature_clips(names, self.clips).items()},
            "stride": self.stride,
            "method": self.method,
            "solver": deciding_options(make_solver(self.method, **self.solver)),
            "aggregate": self.aggregate,
            "agents": self.agents,
        }

    def __call__(self, scene: Scene, trajectories: Tensor, controlled: Tensor | None = None) -> Ranking:
        """Rank rollouts of one scene.

        Args:
            scene: an uncollated scene, on the CPU.
            trajectories: ``[R, A, T, 4]`` x, y, z, heading at 10 Hz after the current step, of the present agents in
                order; the ranking is on their device.
            controlled: ``[A]`` bool, on the CPU; all of them by default.
        """
        ego, steps, there = ranked_agents(scene, controlled, self.agents), trajectories.shape[2], trajectories.device
        moved = self.couple(scene, trajectories, ego, coupling=False).moved
        # Who has a logged step is known on the CPU, from the scene; a device only gets their rows.
        logged = logged_steps(scene, steps, self.features, ego=ego, stride=self.stride).any(-1)
        found, ego = logged.nonzero()[:, 0].to(there), ego[logged]
        agent_ranked = torch.zeros(trajectories.shape[1], dtype=torch.bool)
        agent_ranked[ego] = True
        log_valid = scene.agents.valid[scene.agents.present][ego, CURRENT_STEP + 1 : CURRENT_STEP + 1 + steps]
        log, ego = log_trajectory(scene, steps)[ego].to(trajectories), ego.to(there)

        agent_distance = trajectories.new_zeros(trajectories.shape[:2])
        agent_distance[:, ego] = moved.distance[:, found]
        agent_ranked = agent_ranked.to(there)
        if len(ego) == 0:
            nothing = trajectories.new_zeros(len(trajectories))
            return Ranking(nothing, agent_distance, nothing, agent_ranked, _shares(moved.parts))
        ade = average_displacement(trajectories[:, ego], log, log_valid.to(there)).scene
        distance = AGGREGATES[self.aggregate](agent_distance[:, ego])
        return Ranking(distance, agent_distance, ade, agent_ranked, _shares(moved.parts))

    def couple(
        self, scene: Scene, trajectories: Tensor, ego: Tensor, *, coupling: bool = True, stride: int | None = None
    ) -> Coupled:
        """Transport agents of rollouts onto their log.

        Args:
            scene: an uncollated scene, on the CPU.
            trajectories: ``[R, A, T, 4]`` as for a ranking.
            ego: ``[E]`` int64, rows of the agents, on the CPU.
            coupling: keep the couplings, not their cost alone.
            stride: steps of 0.1 s between two measurements; by default that of the distance.

        Examples:
            >>> from envs.sources.synthetic import straight_road
            >>> scene = straight_road(2)
            >>> coupled = PreferenceDistance(stride=5).couple(scene, log_trajectory(scene, 80)[None], torch.arange(2))
            >>> coupled.rollouts.shape, coupled.moved.coupling.shape
            (torch.Size([1, 2, 16, 5]), torch.Size([1, 2, 16, 16]))
        """
        names, stride = feature_names(self.features), stride or self.stride
        both = torch.cat((trajectories, log_trajectory(scene, trajectories.shape[2])[None].to(trajectories)))
        phi, valid = occupancy_features(scene, both, names, ego=ego, stride=stride, clips=self.clips)
        weights = feature_weights(names, self.weights)
        moved = transport_cost(
            phi[:-1],
            phi[-1],
            valid,
            valid,
            weights,
            method=self.method,
            coupling=coupling,
            threads=self.threads,
            step=stride * STEP_SECONDS,
            **self.solver,
        )
        return Coupled(phi[:-1], phi[-1], valid, weights.to(phi), moved)


def check_options(distance: object, **known: Collection[str]) -> None:
    """Refuse an option of a distance that names nothing.

    Args:
        distance: whose attributes are looked at.
        known: the names that each option may have.

    Raises:
        ValueError: the first one that has another; the message lists the known ones.
    """
    for option, names in known.items():
        if getattr(distance, option) not in names:
            raise ValueError(f"unknown {option} {getattr(distance, option)!r}; choose one of {sorted(names)}.")


def ranked_agents(scene: Scene, controlled: Tensor | None, agents: str) -> Tensor:
    """Rows of the agents that may be ranked, ``[E]`` int64.

    Args:
        scene: an uncollated scene.
        controlled: ``[A]`` bool of the present agents; all of them where it is None.
        agents: ``"controlled"``, or ``"evaluated"``: of these only the SDC and the tracks to predict.
    """
    present = scene.agents.present
    if controlled is None:
        controlled = torch.ones(int(present.sum()), dtype=torch.bool)
    return (controlled & scene.agents.evaluated[present] if agents == "evaluated" else controlled).nonzero()[:, 0]


def _ranks(distance: Tensor) -> Tensor:
    """Rank of each rollout in the eyes of each agent, 1 for the nearest, ties at their mean: ``[R, E]`` -> ``[R, E]``.

    Every pair is compared, which keeps the work where the distances are.
    """
    mine, others = distance[:, None], distance[None]
    return (others < mine).sum(1) + ((others == mine).sum(1) + 1) / 2


def _shares(parts: Tensor) -> Tensor:
    """``[R, D]`` of the agents' parts ``[R, E, D]``."""
    paid = parts.sum(1)
    total = paid.sum(-1, keepdim=True)
    return torch.where(total > 0, paid / total, 0)
