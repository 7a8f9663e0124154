"""What every measure of safety sees: how agents move, and at which steps that can be said."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from envs.scene import CURRENT_STEP, AgentKind, Scene

NOW = CURRENT_STEP
"""Step of a :class:`Motion` that is the current one: the logged history comes first."""
DECISION_STEPS = 5
"""Steps of 0.1 s in a decision: motion is measured over 0.5 s, at which tokens are drawn."""
DECISION_SECONDS = 0.5
DRIVING_SPEED = 1.0
"""A vehicle that is slower stands or creeps [m/s]."""
LANE_WIDTH = 3.5
"""Of an ordinary lane [m]."""


@dataclass(frozen=True)
class Motion:
    """K futures of a scene, with the logged history in front.

    Attributes:
        scene: uncollated.
        poses: ``[K, A, NOW + 1 + T, 4]`` x, y, z, heading of the agents present at the current step.
        valid: ``[A, NOW + 1 + T]`` bool, the LOG is valid. Rollouts are measured at the steps of the log, or the two
            would differ by how long somebody was in sight.
        controlled: ``[A]`` bool.
    """

    scene: Scene
    poses: Tensor
    valid: Tensor
    controlled: Tensor

    @classmethod
    def of(cls, scene: Scene, trajectories: Tensor, controlled: Tensor) -> Motion:
        """Put the history of the log in front of trajectories (arguments: see :func:`~dpa.safety.safety`).

        What is unsafe is looked for pair by pair and light by light, on the CPU with the scene; trajectories from a
        device come over here, and nothing else does.

        Raises:
            ValueError: trajectories or controlled do not fit the scene.
        """
        agents, present = scene.agents, scene.agents.present
        trajectories, controlled = (value.to(present.device) for value in (trajectories, controlled))
        num, room = int(present.sum()), agents.valid.shape[-1] - NOW - 1
        if trajectories.dim() != 4 or trajectories.shape[1] != num or trajectories.shape[-1] != 4:
            raise ValueError(
                f"scene {scene.scene_id} takes trajectories [K, {num}, T, 4], got {list(trajectories.shape)}."
            )
        steps = trajectories.shape[2]
        if not 1 <= steps <= room:
            raise ValueError(f"scene {scene.scene_id} has {room} steps after the current one, got {steps} of them.")
        if controlled.shape != (num,) or controlled.dtype != torch.bool:
            raise ValueError(
                f"scene {scene.scene_id} has {num} present agents, so controlled is [{num}] bool, got "
                f"{list(controlled.shape)} {controlled.dtype}."
            )
        history = agents.trajectory[None, present, : NOW + 1].to(trajectories).expand(len(trajectories), -1, -1, -1)
        valid = agents.valid[present][:, : NOW + 1 + steps]
        return cls(scene, torch.cat((history, trajectories), 2), valid, controlled)

    @property
    def log(self) -> Motion:
        """The log over the same steps, as the one future (K = 1)."""
        agents = self.scene.agents
        poses = agents.trajectory[agents.present, : self.valid.shape[1]]
        return Motion(self.scene, poses[None], self.valid, self.controlled)

    @cached_property
    def extent(self) -> Tensor:
        """``[A, 3]`` length, width, height [m]."""
        return self.scene.agents.extent[self.scene.agents.present]

    @cached_property
    def vehicle(self) -> Tensor:
        """``[A]`` bool."""
        return self.scene.agents.kind[self.scene.agents.present] == AgentKind.VEHICLE

    @property
    def driver(self) -> Tensor:
        """``[A]`` bool: a vehicle that the policy moves."""
        return self.controlled & self.vehicle


def lasts(flag: Tensor, steps: int) -> Tensor:
    """Whether something holds for some consecutive steps: ``[..., T]`` bool -> ``[...]`` bool.

    Examples:
        >>> lasts(torch.tensor([[True, True, False, True], [True, False, True, False]]), 2)
        tensor([ True, False])
    """
    if flag.shape[-1] < steps:
        return flag.new_zeros(flag.shape[:-1])
    return flag.unfold(-1, steps, 1).all(-1).any(-1)
