"""Trajectories out of what a collector gives."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from envs import keys
from envs.geometry.ground import lift
from envs.scene import CURRENT_STEP, Scene


def simulated_poses(rollouts: TensorDictBase, num_rollouts: int) -> Tensor:
    """Poses at 10 Hz of a collector's batch.

    Args:
        rollouts: ``[S * K, T]``.
        num_rollouts: K.

    Returns:
        ``[S, K, A, T * F, 3]`` in each scene's frame.
    """
    decisions = rollouts["next", *keys.RECENT][..., 1:, :]
    return decisions.movedim(1, 2).flatten(2, 3).unflatten(0, (-1, num_rollouts))


def lifted(scene: Scene, poses: Tensor) -> Tensor:
    """Give rollouts of one scene the height of its road.

    Args:
        scene: uncollated.
        poses: ``[K, A', T * F, 3]``, rows beyond the scene's present agents are dropped.

    Returns:
        ``[K, A, T * F, 4]`` x, y, z, heading.
    """
    present = scene.agents.present
    return lift(poses[:, : int(present.sum())], scene.agents.position[present, CURRENT_STEP], scene.road.points)
