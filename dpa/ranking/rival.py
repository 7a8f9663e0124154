"""Ranking by displacement from the log alone: the rival of the preference distance (paper: ADEF)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from dpa.ranking.displacement import average_displacement, final_displacement
from dpa.ranking.distance import AGENTS, AGGREGATES, Ranking, check_options, ranked_agents
from dpa.ranking.features import log_trajectory
from envs.scene import CURRENT_STEP, Scene

MEASURES = {"average": average_displacement, "final": final_displacement}
"""Displacement of an agent: over its logged steps, or at the last of them."""


@dataclass(frozen=True)
class DisplacementDistance:
    """How far rollouts drive from the log in metres, a :class:`~dpa.ranking.distance.Distance` without features.

    Args:
        measure: a key of :data:`MEASURES`; ``"average"`` is the ADE, ``"final"`` the FDE.
        aggregate: a key of :data:`~dpa.ranking.distance.AGGREGATES`; ``"mean"`` is the scene's ADE.
        agents: rank all ``"controlled"`` agents, or of these only the ``"evaluated"`` ones.

    Raises:
        ValueError: an unknown name among the options; the message lists the known ones.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> log = log_trajectory(scene, 80)
        >>> aside = log + torch.tensor([0.0, 3.0, 0.0, 0.0])
        >>> ranking = DisplacementDistance()(scene, torch.stack((aside, log)))
        >>> ranking.distance, ranking.feature_share.shape
        (tensor([3., 0.]), torch.Size([2, 0]))
    """

    on_device: ClassVar[bool] = True

    measure: Literal["average", "final"] = "average"
    aggregate: str = "mean"
    agents: Literal["controlled", "evaluated"] = "controlled"

    def __post_init__(self) -> None:
        check_options(self, measure=MEASURES, aggregate=AGGREGATES, agents=AGENTS)

    def describe(self) -> dict[str, Any]:
        """The options that decide a ranking, ready for JSON."""
        return {"kind": "displacement", **asdict(self)}

    def __call__(self, scene: Scene, trajectories: Tensor, controlled: Tensor | None = None) -> Ranking:
        """Rank rollouts of one scene (arguments of :meth:`~dpa.ranking.PreferenceDistance.__call__`)."""
        ego, steps, there = ranked_agents(scene, controlled, self.agents), trajectories.shape[2], trajectories.device
        valid = scene.agents.valid[scene.agents.present][:, CURRENT_STEP + 1 : CURRENT_STEP + 1 + steps]
        ego = ego[valid[ego].any(-1)]
        ranked = torch.zeros(trajectories.shape[1], dtype=torch.bool)
        ranked[ego] = True
        log, valid = log_trajectory(scene, steps)[ego].to(trajectories), valid[ego].to(there)
        ego, ranked = ego.to(there), ranked.to(there)
        sides = trajectories[:, ego], log, valid
        moved = MEASURES[self.measure](*sides)
        agent_distance = trajectories.new_zeros(trajectories.shape[:2])
        agent_distance[:, ego] = moved.agent
        nothing = trajectories.new_zeros(len(trajectories))
        distance = AGGREGATES[self.aggregate](moved.agent) if len(ego) else nothing
        ade = average_displacement(*sides).scene if len(ego) else nothing
        return Ranking(distance, agent_distance, ade, ranked, trajectories.new_zeros(len(trajectories), 0))
