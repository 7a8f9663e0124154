"""A scene as a simulation of it knows it: who takes part, what they did, whom a policy moves, where the others go."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Integral
from typing import Any

from tensordict import TensorClass
from torch import Tensor

from envs.geometry.frames import to_local
from envs.participants import MAX_CONTROLLED, Control, check_control, choose_controlled, simulated_agents
from envs.scene import CURRENT_STEP, LOG_STEPS, Scene, check_episode

HISTORY = CURRENT_STEP + 1
"""Logged steps up to the current one."""
EPISODE_STEPS = LOG_STEPS - HISTORY
"""Logged steps of 0.1 s after the current one: 8 s."""


@dataclass(frozen=True)
class EpisodeOptions:
    """What decides an episode of a scene; the same for environment, policy and ranking.

    Attributes:
        max_controlled: agents that a policy moves at most.
        decision_steps: F, steps of 0.1 s in a decision.
        horizon: T, decisions in an episode.
        control: whom a policy may move; the log replays all others.
        arrivals: agents that are logged in the episode but not at its beginning take part, replayed.

    Raises:
        ValueError: a number that is not positive, an episode longer than a log, or a control that is none.
    """

    max_controlled: int = MAX_CONTROLLED
    decision_steps: int = 5
    horizon: int = 16
    control: Control = "all"
    arrivals: bool = False

    def __post_init__(self) -> None:
        for name in ("max_controlled", "decision_steps", "horizon"):
            value = getattr(self, name)
            if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
                raise ValueError(f"{name} must be a whole number of 1 or more, got {value!r}.")
        check_control(self.control)
        check_episode(self.decision_steps, self.horizon)

    @property
    def steps(self) -> int:
        """T * F, steps of 0.1 s in an episode."""
        return self.decision_steps * self.horizon

    @property
    def cast(self) -> dict[str, Any]:
        """Who takes part, as :func:`~envs.participants.simulated_agents` is told."""
        return {"arrivals": self.arrivals, "last_step": CURRENT_STEP + self.steps}

    def choose(self, scene: Scene) -> Tensor:
        """``[A]`` bool: whom a policy moves, of the agents of an uncollated scene."""
        return choose_controlled(scene, self.max_controlled, self.control)


class Episode(TensorClass["nocast"]):
    """The agents of one scene's simulation, or of a padded batch of them (``*`` is nothing or ``S``).

    Attributes:
        history: ``[*, A, HISTORY, 3]`` logged poses in the agent's current frame; 0 where invalid.
        history_valid: ``[*, A, HISTORY]`` bool.
        extent: ``[*, A, 3]`` [m].
        kind: ``[*, A]`` :class:`~envs.scene.AgentKind`.
        recent: ``[*, A, F + 1, 3]`` poses of the last decision before the episode.
        valid: ``[*, A]`` bool, the agent is there at the current step; false for padding and arrivals.
        controlled: ``[*, A]`` bool.
        logged: ``[*, A, T * F, 3]`` logged poses to come; where invalid, what
            :func:`~envs.participants.simulated_agents` holds there: read it under its mask.
        logged_valid: ``[*, A, T * F]`` bool.
    """

    history: Tensor
    history_valid: Tensor
    extent: Tensor
    kind: Tensor
    recent: Tensor
    valid: Tensor
    controlled: Tensor
    logged: Tensor
    logged_valid: Tensor


def make_episode(scene: Scene, options: EpisodeOptions | None = None) -> Episode:
    """The episode of one uncollated scene: its present agents, then arrivals.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> make_episode(straight_road(2)).history.shape
        torch.Size([2, 11, 3])
    """
    options = options or EpisodeOptions()
    scene = simulated_agents(scene, **options.cast)
    agents = scene.agents
    poses, seen = agents.poses, agents.valid[:, :HISTORY]
    future = slice(HISTORY, HISTORY + options.steps)
    return Episode(
        history=to_local(poses[:, :HISTORY], poses[:, CURRENT_STEP, None]) * seen[..., None],
        history_valid=seen,
        extent=agents.extent,
        kind=agents.kind,
        recent=agents.recent(options.decision_steps),
        valid=agents.present,
        controlled=options.choose(scene),
        logged=poses[:, future],
        logged_valid=agents.valid[:, future],
        batch_size=[],
    )
