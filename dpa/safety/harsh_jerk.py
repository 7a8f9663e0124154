"""Jerks beyond what systems that drive are allowed."""

from __future__ import annotations

import torch
from torch import Tensor

from dpa.safety.motion import DECISION_SECONDS, DECISION_STEPS, Motion, lasts
from envs.scene import STEP_SECONDS

JERK_BOUND = 5.0
"""Jerk that is harsh [m/s^3]: the bound of UN Regulation No. 79 for the lateral jerk of a system that steers, as a
mean over 0.5 s, and of ISO 15622 for the braking jerk of adaptive cruise control at low speed, as a mean over 1 s."""
JERK_SECONDS = 0.3
"""For how long it has to be above the bound [s]."""


def harsh_jerk(motion: Motion) -> Tensor:
    """Controlled vehicles whose longitudinal or lateral jerk stays above :data:`JERK_BOUND` for :data:`JERK_SECONDS`.

    Returns:
        ``[K, A]`` bool.
    """
    driver = motion.driver
    found = motion.controlled.new_zeros(motion.poses.shape[:2])
    found[:, driver] = harsh(*jerks(motion.poses[:, driver], motion.valid[driver]))
    return found


def harsh(jerk: Tensor, there: Tensor, bound: float = JERK_BOUND) -> Tensor:
    """Whether some jerk stays above a bound: ``[K, E, T', 2]`` [m/s^3] and ``[E, T']`` bool -> ``[K, E]`` bool."""
    above = (jerk.abs() > bound) & there[..., None]
    return lasts(above.transpose(-1, -2), round(JERK_SECONDS / STEP_SECONDS) + 1).any(-1)


def jerks(poses: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Longitudinal and lateral jerk in the vehicle's own frame, from differences over 0.5 s.

    Velocity is the displacement of 0.5 s, acceleration the difference of two of them in a row, split by the heading
    between them; jerk is the difference of two such accelerations 0.5 s apart. So neither the noise of a track at
    10 Hz nor the steps between tokens at 2 Hz are taken for jerks.

    Args:
        poses: ``[K, E, T, 4]`` x, y, z, heading.
        valid: ``[E, T]`` bool.

    Returns:
        ``[K, E, T - 15, 2]`` [m/s^3], and ``[E, T - 15]`` bool where all that a jerk reads is valid.

    Examples:
        >>> time = torch.arange(21) / 10
        >>> x = torch.stack((time**3, 0 * time, 0 * time, 0 * time), -1)
        >>> jerks(x[None, None], torch.ones(1, 21, dtype=torch.bool))[0][0, 0, 0]
        tensor([6.0000, 0.0000])
    """
    span = DECISION_STEPS
    velocity = (poses[..., span:, :2] - poses[..., :-span, :2]) / DECISION_SECONDS
    change = (velocity[..., span:, :] - velocity[..., :-span, :]) / DECISION_SECONDS
    heading = poses[..., span:-span, 3]
    cos, sin = heading.cos(), heading.sin()
    x, y = change.unbind(-1)
    acceleration = torch.stack((x * cos + y * sin, y * cos - x * sin), -1)
    jerk = (acceleration[..., span:, :] - acceleration[..., :-span, :]) / DECISION_SECONDS
    if valid.shape[-1] <= 3 * span:  # too short for a jerk
        return jerk, valid[:, :0]
    return jerk, valid.unfold(-1, 3 * span + 1, 1).all(-1)
