"""The preference distance of rollouts to the log of their scene (paper eq. 3), and the ranks that follow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import torch
from scipy.stats import rankdata
from torch import Tensor

from dpa.ranking.displacement import average_displacement
from dpa.ranking.features import feature_clips, feature_names, feature_weights, log_trajectory, occupancy_features
from dpa.ranking.transport import SOLVERS, feature_shares, transport_cost
from envs.scene import CURRENT_STEP, Scene

AGGREGATES: dict[str, Callable[[Tensor], Tensor]] = {
    "sum": lambda distance: distance.sum(-1),
    "mean": lambda distance: distance.mean(-1),
    "max": lambda distance: distance.amax(-1),
    "mean_rank": lambda distance: torch.from_numpy(rankdata(distance.cpu().numpy(), axis=0)).float().mean(-1),
}
"""From the ranked agents' distances ``[R, E]`` to the scene's ``[R]``.

The paper sums. One agent often carries most of a sum; ``mean_rank`` gives each agent the same say: the mean over agents
of the rollout's rank in the eyes of that agent, 1 for the nearest.
"""


class Ranking(NamedTuple):
    """R rollouts of one scene against its log; A are the agents present at the current step."""

    distance: Tensor
    """``[R]``: agents aggregated; 0 where no agent is ranked."""
    agent_distance: Tensor
    """``[R, A]``: 0 where the agent took no part."""
    ade: Tensor
    """``[R]``: mean displacement from the log over the ranked agents [m]."""
    agent_ranked: Tensor
    """``[A]`` bool."""


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
        weights: weights that differ from the paper's, by feature.
        clips: clip ranges that differ from the registered ones, by feature.
        stride: measure every ``stride``-th step of 0.1 s.
        method: a key of :data:`~dpa.ranking.transport.SOLVERS`.
        aggregate: a key of :data:`AGGREGATES`.
        agents: rank all ``"controlled"`` agents, or of these only the ``"evaluated"`` ones.
        threads: transport problems solved at the same time; changes no result.

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
    weights: Mapping[str, float] | None = None
    clips: Mapping[str, tuple[float, float]] | None = None
    stride: int = 1
    method: str = "exact"
    aggregate: str = "sum"
    agents: Literal["controlled", "evaluated"] = "controlled"
    threads: int = 1

    def __post_init__(self) -> None:
        names = feature_names(self.features)
        feature_weights(names, self.weights)
        feature_clips(names, self.clips)
        for option, known in (("method", SOLVERS), ("aggregate", AGGREGATES), ("agents", ("controlled", "evaluated"))):
            if getattr(self, option) not in known:
                raise ValueError(f"unknown {option} {getattr(self, option)!r}; choose one of {sorted(known)}.")

    def describe(self) -> dict[str, Any]:
        """The options that decide a ranking, with defaults filled in, ready for JSON."""
        names = feature_names(self.features)
        options = {k: v for k, v in asdict(self).items() if k not in ("features", "weights", "clips", "threads")}
        weights = dict(zip(names, feature_weights(names, self.weights).tolist(), strict=True))
        clips = {name: list(clip) for name, clip in feature_clips(names, self.clips).items()}
        return {"weights": weights, "clips": clips, **options}

    def __call__(self, scene: Scene, trajectories: Tensor, controlled: Tensor | None = None) -> Ranking:
        """Rank rollouts of one scene.

        Args:
            scene: an uncollated scene.
            trajectories: ``[R, A, T, 4]`` x, y, z, heading at 10 Hz after the current step, of the present agents in
                order.
            controlled: ``[A]`` bool; all of them by default.
        """
        ego = self._ego(scene, controlled)
        phi, log_phi, valid = self._features(scene, trajectories, ego)
        moved = transport_cost(phi, log_phi, valid, valid, self._weights(), method=self.method, threads=self.threads)

        ego = ego[valid.any(-1)]
        agent_distance = trajectories.new_zeros(trajectories.shape[:2])
        agent_distance[:, ego] = moved.distance[:, valid.any(-1)]
        agent_ranked = torch.zeros(trajectories.shape[1], dtype=torch.bool)
        agent_ranked[ego] = True
        if len(ego) == 0:
            nothing = trajectories.new_zeros(len(trajectories))
            return Ranking(nothing, agent_distance, nothing, agent_ranked)
        steps = trajectories.shape[2]
        log_valid = scene.agents.valid[scene.agents.present][ego, CURRENT_STEP + 1 : CURRENT_STEP + 1 + steps]
        ade = average_displacement(trajectories[:, ego], log_trajectory(scene, steps)[ego], log_valid).scene
        return Ranking(AGGREGATES[self.aggregate](agent_distance[:, ego]), agent_distance, ade, agent_ranked)

    def shares(self, scene: Scene, trajectories: Tensor, controlled: Tensor | None = None) -> dict[str, float]:
        """Share of each feature in the squared cost that the rollouts pay (arguments of :meth:`__call__`)."""
        phi, log_phi, valid = self._features(scene, trajectories, self._ego(scene, controlled))
        moved = transport_cost(phi, log_phi, valid, valid, self._weights(), method=self.method, coupling=True)
        shares = feature_shares(phi, log_phi, moved.coupling, self._weights())
        return dict(zip(feature_names(self.features), shares.tolist(), strict=True))

    def _ego(self, scene: Scene, controlled: Tensor | None) -> Tensor:
        """``[E]`` int64: rows of the agents that may be ranked."""
        present = scene.agents.present
        if controlled is None:
            controlled = torch.ones(int(present.sum()), dtype=torch.bool)
        chosen = controlled & scene.agents.evaluated[present] if self.agents == "evaluated" else controlled
        return chosen.nonzero()[:, 0]

    def _features(self, scene: Scene, trajectories: Tensor, ego: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Features of the rollouts ``[R, E, T', D]``, of the log ``[1, E, T', D]``, and valid ``[E, T']``."""
        both = torch.cat((trajectories, log_trajectory(scene, trajectories.shape[2])[None].to(trajectories)))
        phi, valid = occupancy_features(scene, both, self.features, ego=ego, stride=self.stride, clips=self.clips)
        return phi[:-1], phi[-1:], valid

    def _weights(self) -> Tensor:
        return feature_weights(feature_names(self.features), self.weights)
