"""All measures of a scene as numbers."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from dpa.safety.close_pass import close_pass
from dpa.safety.harsh_jerk import harsh_jerk
from dpa.safety.motion import Motion
from dpa.safety.red_light import red_light
from dpa.safety.wrong_way import wrong_way
from envs.scene import Scene

MEASURES: dict[str, tuple[Callable[[Motion], Tensor | None], bool]] = {
    "wrong_way": (wrong_way, True),
    "red_light": (red_light, True),
    "close_pass": (close_pass, False),
    "harsh_jerk": (harsh_jerk, True),
}
"""Motion -> ``[K, A]`` bool by name, and whether it is about controlled vehicles only, or about all agents."""


def safety(scene: Scene, trajectories: Tensor, controlled: Tensor) -> dict[str, float | None]:
    """Shares of the controlled agents that do what is unsafe, over all rollouts.

    Nothing here is part of the preference distance of the paper or of the realism metrics of 2023 and 2024, so neither
    alignment nor the choice of a decoding has seen it. Those of 2025 weigh driving through red lights, in a way of
    their own (realism.md 4.2): with them ``red_light`` is a measure that the choice has seen. The log is measured by
    the same function, as the one rollout.

    Args:
        scene: uncollated.
        trajectories: ``[K, A, T, 4]`` x, y, z, heading at 10 Hz after the current step, of the present agents in the
            order of the scene. They are measured at the steps at which the log is valid.
        controlled: ``[A]`` bool, agents that the policy moved.

    Returns:
        Share of agents, 0 to 1, by name of :data:`MEASURES`; None where the scene has no lane, no light, or nobody whom
        the measure is about.

    Raises:
        ValueError: trajectories or controlled do not fit the scene.

    Examples:
        >>> import torch
        >>> from envs.sources.synthetic import red_light
        >>> scene = red_light(speed=8.0)
        >>> log = scene.agents.trajectory[None, :, 11:]
        >>> safety(scene, log, torch.tensor([True]))
        {'wrong_way': 0.0, 'red_light': 1.0, 'close_pass': 0.0, 'harsh_jerk': 0.0}
    """
    motion = Motion.of(scene, trajectories, controlled)
    return {name: _share(measure, motion, vehicles) for name, (measure, vehicles) in MEASURES.items()}


def _share(measure: Callable[[Motion], Tensor | None], motion: Motion, vehicles: bool) -> float | None:
    concerned = motion.driver if vehicles else motion.controlled
    found = measure(motion) if concerned.any() else None
    return None if found is None else found[:, concerned].float().mean().item()
