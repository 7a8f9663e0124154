"""How smoothly agents move, measured on their own poses alone."""

from __future__ import annotations

import torch
from torch import Tensor

from envs.scene import CURRENT_STEP, STEP_SECONDS, Scene

DIFFERENCES = 3
"""A jerk is a third difference of positions."""


def mean_squared_jerk(scene: Scene, trajectories: Tensor, *, ego: Tensor | None = None, stride: int = 1) -> Tensor:
    """Mean over agents and steps of the squared jerk of each rollout, steps without a log left out.

    Args:
        scene: uncollated; its log decides which steps count, and gives the poses before the first simulated one.
        trajectories: ``[R, A, T, 4]`` at 10 Hz after the current step, of the present agents in order.
        ego: ``[E]`` int64, rows of the agents to measure; all of them by default.
        stride: differences between every ``stride``-th pose: 5 measures what decisions of 0.5 s do, and nothing of how
            poses inside a decision are made.

    Returns:
        ``[R]`` [m^2/s^6]; 0 where no step counts.

    Raises:
        ValueError: the stride is below 1, or longer than the trajectories allow.

    Examples:
        >>> from dpa.ranking import log_trajectory
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> log = log_trajectory(scene, 80)
        >>> cubic = log.clone()
        >>> cubic[..., 0] += (0.1 * torch.arange(1, 81)) ** 3  # 6 m/s^3, less where history ends
        >>> mean_squared_jerk(scene, torch.stack((log, cubic)), stride=5).round(decimals=1)
        tensor([ 0.0, 33.1])
    """
    steps = trajectories.shape[2]
    if stride < 1 or _history(stride) + 1 + steps // stride <= DIFFERENCES:
        raise ValueError(
            f"stride must be 1 or more, and {DIFFERENCES + 1} poses of the log and of {steps} steps must lie so far "
            f"apart, got {stride}."
        )
    agents, present = scene.agents, scene.agents.present
    ego = torch.arange(trajectories.shape[1]) if ego is None else ego
    history = _history(stride)
    first = CURRENT_STEP - history * stride
    before = agents.position[present][ego, first : CURRENT_STEP + 1 : stride, :2].to(trajectories)
    after = trajectories[:, ego, stride - 1 :: stride, :2]
    xy = torch.cat((before.expand(len(after), -1, -1, -1), after), 2)
    valid = agents.valid[present][ego, first : CURRENT_STEP + 1 + steps - steps % stride : stride]
    counts = valid.unfold(-1, DIFFERENCES + 1, 1).all(-1)
    # float64: third differences of positions of hundreds of metres, over 0.1 s cubed, drown in the rounding of float32.
    jerk = xy.double().diff(n=DIFFERENCES, dim=2) / (stride * STEP_SECONDS) ** DIFFERENCES
    squared = jerk.square().sum(-1) * counts
    return (squared.sum((1, 2)) / counts.sum().clamp(min=1)).to(trajectories.dtype)


def _history(stride: int) -> int:
    """Poses of the log that are taken before the current one, whole strides apart."""
    return min(DIFFERENCES - 1, CURRENT_STEP // stride)
