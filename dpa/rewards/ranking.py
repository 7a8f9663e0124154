"""Ranking by the realism of a group: pairs of the signal that a policy gradient takes as reward."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from dpa.ranking import DisplacementDistance, Ranking
from dpa.realism.tracks import HORIZON
from dpa.rewards.advantages import SMALLEST_SPREAD
from dpa.rewards.functions import YEAR, Judged, judge
from envs.scene import Scene


@dataclass(frozen=True)
class RealismRanking:
    """How little rollouts add to the realism of their group, a :class:`~dpa.ranking.Distance` of the group's own.

    An agent's distance is how much less its rollout adds (:func:`~dpa.realism.contributions`) than the best one of the
    group does, 0 of an agent for which all do alike but for rounding; a rollout's is the sum over its agents. So it
    depends on the rollouts that it is ranked among.

    Args:
        metric: year of the realism metric, or a file of one's own (``.yaml``).

    Raises:
        ValueError: there is no such metric.

    Examples:
        >>> from dpa.ranking import log_trajectory
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> log = log_trajectory(scene, 80)
        >>> RealismRanking()(scene, torch.stack((log, log, log + 50.0))).distance.argmax()
        tensor(2)
    """

    metric: str | int = YEAR

    def __post_init__(self) -> None:
        object.__setattr__(self, "metric", str(self.metric))  # a command line says 2025
        judge(self.metric)

    def describe(self) -> dict[str, Any]:
        """The options that decide a ranking, ready for JSON; of a metric in a file its content as well."""
        if not self.metric.endswith(".yaml"):
            return {"kind": "realism", **asdict(self)}
        name, digest = judge(self.metric).describe()
        return {"kind": "realism", "metric": name, "digest": digest}

    def __call__(self, scene: Scene, trajectories: Tensor, controlled: Tensor | None = None) -> Ranking:
        """Rank rollouts of one scene (arguments of :meth:`~dpa.ranking.PreferenceDistance.__call__`).

        Raises:
            ValueError: one rollout alone, or rollouts of another length than the metric scores.
        """
        if trajectories.shape[2] != HORIZON:
            raise ValueError(f"realism is of {HORIZON} steps of 0.1 s, and rollouts have {trajectories.shape[2]}.")
        ranking = DisplacementDistance()(scene, trajectories, controlled)
        if controlled is None:
            controlled = torch.ones(trajectories.shape[1], dtype=torch.bool)
        if not controlled.any():
            return ranking
        added = Judged(scene, trajectories, controlled, self.metric).added
        missed = added.amax(0) - added
        differs = added.std(0) > SMALLEST_SPREAD * added.abs().amax(0)
        agent_distance = torch.where(differs, missed, 0)
        return ranking._replace(distance=agent_distance.sum(-1), agent_distance=agent_distance)
