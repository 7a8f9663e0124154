"""What a rollout is paid: rewards by name, the higher the better.

A reward is a function of an :class:`Outcome`. Some are of a rollout as a whole, some of each agent, some of each
decision, so that credit reaches what it belongs to. Add one of your own to :data:`REWARDS`, and any YAML can name it
(a function of a module, if other processes are to call it).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, partial

import torch
from torch import Tensor

from dpa.ranking import Distance, Ranking
from dpa.realism import Features, RealismConfig, compare, contributions, measure
from dpa.realism.tracks import HORIZON
from dpa.safety import MEASURES, Motion
from envs.scene import Scene

YEAR = "2024"
"""Of the realism metric whose events and likelihoods are paid."""


@dataclass(frozen=True)
class Judged:
    """K rollouts of one scene, as the realism metric and measures of safety see them; A agents are present.

    Attributes:
        scene: uncollated.
        trajectories: ``[K, A, T * F, 4]`` x, y, z, heading at 10 Hz after the current step.
        controlled: ``[A]`` bool, agents that the policy moved.
        metric: year of the realism metric.
    """

    scene: Scene
    trajectories: Tensor
    controlled: Tensor
    metric: str = YEAR

    @cached_property
    def motion(self) -> Motion:
        """As measures of safety see it."""
        return Motion.of(self.scene, self.trajectories, self.controlled)

    @cached_property
    def judged(self) -> Scene:
        """The scene with all controlled agents evaluated, not the few that a data set names."""
        scene = self.scene.clone(recurse=False)
        scene.agents = scene.agents.clone(recurse=False)
        predict = torch.zeros_like(scene.agents.predict)
        predict[scene.agents.present] = self.controlled
        scene.agents.predict, scene.agents.sdc = predict, torch.zeros_like(predict)
        return scene

    @cached_property
    def measured(self) -> Features:
        """What the realism metric measures of the controlled agents, in ascending order of track id."""
        config = judge(self.metric)
        return measure([compare(self.judged, self.trajectories, config)], config)[0]

    @property
    def added(self) -> Tensor:
        """``[K, A]``: what each agent of a rollout adds to the realism of the group."""
        return self.by_agent(contributions(self.measured, judge(self.metric)))

    def by_agent(self, value: Tensor) -> Tensor:
        """``[K, E]`` of :attr:`measured` agents as ``[K, A]``, 0 of all others."""
        present = self.scene.agents.track_id[self.scene.agents.present]
        rows = (present == self.measured.track_id[:, None]).nonzero()[:, 1]
        return value.new_zeros(self.trajectories.shape[:2]).index_copy_(1, rows, value)


@dataclass(frozen=True, kw_only=True)
class Outcome(Judged):
    """K rollouts of one scene, as a reward sees them.

    Attributes:
        ranking: of the rollouts.
        distance: that ranked them.
        decisions: T.
    """

    ranking: Ranking
    distance: Distance
    decisions: int


Reward = Callable[[Outcome], Tensor]
"""What follows each decision: ``[K, A, T]``, with one of A or T where all agents or decisions are paid alike."""


@cache
def judge(metric: str) -> RealismConfig:
    """The metric of a year, which is behind the rewards of realism and of its events."""
    return RealismConfig.load(metric)


def _distance(outcome: Outcome) -> Tensor:
    """Minus the preference distance of the scene."""
    return -outcome.ranking.distance[:, None, None]


def _agent_distance(outcome: Outcome) -> Tensor:
    """Minus the preference distance of each agent."""
    return -outcome.ranking.agent_distance[..., None]


def _ade(outcome: Outcome) -> Tensor:
    """Minus ADE [m]."""
    return -outcome.ranking.ade[:, None, None]


def _realism(outcome: Outcome) -> Tensor:
    """What each agent of a rollout adds to the realism of its group."""
    return outcome.added[..., None]


def _step_distance(outcome: Outcome) -> Tensor:
    """Minus what the moments from a decision on pay under the coupling; at the first it is the agent's distance."""
    distance, steps = outcome.distance, outcome.trajectories.shape[2] // outcome.decisions
    ego = outcome.ranking.agent_ranked.nonzero()[:, 0]
    paid = distance.couple(outcome.scene, outcome.trajectories, ego).paid
    decision = (distance.stride * torch.arange(1, paid.shape[-1] + 1) - 1) // steps
    each = paid.new_zeros(*paid.shape[:2], outcome.decisions).index_add_(-1, decision, paid)
    to_go = outcome.trajectories.new_zeros(*outcome.trajectories.shape[:2], outcome.decisions)
    to_go[:, ego] = each.flip(-1).cumsum(-1).flip(-1)
    return -to_go


def _event(name: str, outcome: Outcome) -> Tensor:
    """Minus 1 where an event of the realism metric happens to an agent."""
    happened = outcome.measured.values[name][1:] & outcome.measured.scored
    return -outcome.by_agent(happened.any(-1).float())[..., None]


def _unsafe(name: str, outcome: Outcome) -> Tensor:
    """Minus 1 where an agent does what a measure of safety is about; 0 where the scene has no such thing."""
    found = MEASURES[name][0](outcome.motion)
    nobody = outcome.trajectories.new_zeros(outcome.trajectories.shape[:2])
    return (nobody if found is None else -found.float())[..., None]


REWARDS: dict[str, Reward] = {
    "distance": _distance,
    "agent_distance": _agent_distance,
    "step_distance": _step_distance,
    "ade": _ade,
    "realism": _realism,
    "collision": partial(_event, "collision_per_step"),
    "offroad": partial(_event, "offroad_per_step"),
    **{name: partial(_unsafe, name) for name in MEASURES},
}
"""By name: minus the preference distance of the scene, of each agent or of what follows each decision, minus ADE, what
each agent of a rollout adds to the realism of its group, and minus 1 for events, by agent."""


def check_rewards(weights: Mapping[str, float], distance: Distance) -> None:
    """Refuse rewards that nobody knows, that pay nothing or for the worse, or that a distance cannot tell.

    Raises:
        ValueError: the message lists the known ones.
    """
    if unknown := sorted(weights.keys() - REWARDS.keys()):
        raise ValueError(f"there is no reward {unknown[0]!r}; choose among {', '.join(REWARDS)}.")
    if negative := [name for name, weight in weights.items() if weight < 0]:
        told = f"the reward {negative[0]} weighs {weights[negative[0]]}"
        raise ValueError(f"{told}; every reward is the higher the better, so say a weight of 0 or more.")
    if not any(weights.values()):
        raise ValueError(f"all of the rewards {', '.join(weights)} weigh 0; give one of them a weight.")
    if weights.get("step_distance") and not hasattr(distance, "couple"):
        raise ValueError("the reward step_distance needs a distance that couples moments: ranking.kind=preference.")


JUDGED = ("realism", "collision", "offroad")
"""Rewards that are measured over all of :data:`~dpa.realism.tracks.HORIZON`."""


def check_horizon(weights: Mapping[str, float], steps: int) -> None:
    """Refuse rewards of the realism metric for shorter rollouts than it scores.

    Raises:
        ValueError: so it is.
    """
    judged = [name for name in JUDGED if weights.get(name)]
    if judged and steps != HORIZON:
        raise ValueError(
            f"the reward {judged[0]} is of {HORIZON} steps of 0.1 s, and the policy rolls {steps} out; take a policy "
            "whose context has decision_steps * horizon = 80, or another reward."
        )
