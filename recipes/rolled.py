"""The walk over what a collector gives, scene by scene."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from typing import NamedTuple

from tensordict import TensorDictBase
from torch import Tensor

from dpa.rollout import lifted, simulated_poses
from envs import keys
from envs.scene import Scene, SceneSource


class Rolled(NamedTuple):
    """The rollouts of one scene.

    Attributes:
        index: of the scene in its source.
        scene: uncollated.
        trajectories: ``[K, A, 80, 4]`` x, y, z, heading of the present agents, on the CPU.
        controlled: ``[A]`` bool.
    """

    index: int
    scene: Scene
    trajectories: Tensor
    controlled: Tensor


def rolled(
    batches: Iterable[TensorDictBase], scenes: SceneSource, num_rollouts: int, done: Collection[int] = ()
) -> Iterator[Rolled]:
    """Each scene of a collector's batches, in the order in which they come.

    Args:
        batches: ``[S * K, T]`` each.
        scenes: that ``scene`` in the batches points to.
        num_rollouts: K.
        done: scenes to leave out: a collector rolls them out again where they share a batch with others.
    """
    for batch in batches:
        poses = simulated_poses(batch, num_rollouts).cpu()
        controlled = batch[keys.CONTROLLED][::num_rollouts, 0].cpu()
        for row, index in enumerate(batch[keys.SCENE][::num_rollouts, 0].tolist()):
            if index in done:
                continue
            scene = scenes[index]
            trajectories = lifted(scene, poses[row])
            yield Rolled(index, scene, trajectories, controlled[row, : trajectories.shape[1]])
