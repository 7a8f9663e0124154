"""What a feature is, and the table of all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from envs.geometry.boxes import nearest_box_distance
from envs.scene import CURRENT_STEP, Scene

CONTEXT = 2
"""Steps of history before the first simulated one, enough for an acceleration."""


@dataclass(frozen=True)
class Motion:
    """What a feature sees: R futures of a scene, with two steps of logged history in front.

    All but the scene is on the device of the poses.

    Attributes:
        scene: an uncollated scene.
        poses: ``[R, A, CONTEXT + T, 4]`` x, y, z, heading of the agents present at the current step.
        valid: ``[A, CONTEXT + T]`` bool, the LOG is valid: rollouts and log lose the same neighbours, or a feature
            could tell them apart by who is missing.
        extent: ``[A, 3]`` [m].
        ego: ``[E]`` int64, agents to measure.
        steps: ``[T']`` int64, steps to measure, counted with the context.
    """

    scene: Scene
    poses: Tensor
    valid: Tensor
    extent: Tensor
    ego: Tensor
    steps: Tensor

    @property
    def shape(self) -> tuple[int, int, int]:
        """``(R, E, T')``, the shape of a feature."""
        return self.poses.shape[0], len(self.ego), len(self.steps)

    @property
    def ego_valid(self) -> Tensor:
        """``[E, T']`` bool."""
        return self.valid[self.ego][:, self.steps]

    def ego_poses(self, back: int = 0) -> Tensor:
        """``[R, E, T', 4]``: poses of the measured agents, some steps earlier."""
        return self.poses[:, self.ego][:, :, self.steps - back]

    @property
    def logged(self) -> slice:
        """Steps of the scene's log that :attr:`poses` and :attr:`valid` span."""
        first = CURRENT_STEP + 1 - CONTEXT
        return slice(first, first + self.valid.shape[1])

    @cached_property
    def clearance(self) -> Tensor:
        """``[R, E, T']`` signed distance to the nearest other agent [m]; two features share it."""
        poses = self.poses[:, :, self.steps]
        extent = self.extent[None, :, None, :2].expand(*poses.shape[:-1], 2)
        boxes = torch.cat((poses[..., :2], poses[..., 3:], extent), -1).transpose(1, 2).contiguous()
        valid = self.valid[:, self.steps].T.expand(boxes.shape[:-1])
        return nearest_box_distance(boxes, valid, self.ego).transpose(1, 2)


@dataclass(frozen=True)
class Feature:
    """One entry of phi.

    Attributes:
        compute: Motion -> ``[R, E, T']``; values where the log is invalid do not matter.
        unit: of the value.
        clip: smallest and largest value told apart, in the same unit.
        weight: the paper's; of a feature that the paper does not have, ours.
        spread: root mean square of the difference between rollouts and their log at the same step, clipped, in the same
            unit. ``weights="normalised"`` divides the weight by its square. ``python -m recipes.spread`` measures it.
        past: steps before the measured one that it reads, all of which must be valid.
    """

    compute: Callable[[Motion], Tensor]
    unit: str
    clip: tuple[float, float]
    weight: float
    spread: float
    past: int


FEATURES: dict[str, Feature] = {}
"""Every feature by name; :func:`register` adds one."""


def check_clip(name: str, clip: tuple[float, float]) -> None:
    """Refuse a range that tells nothing apart."""
    if not clip[0] < clip[1]:
        raise ValueError(f"the clip range of feature {name!r} must be (low, high) with low < high, got {clip}.")


def register(
    name: str, *, unit: str, clip: tuple[float, float], weight: float, spread: float, past: int = 0
) -> Callable[[Callable[[Motion], Tensor]], Callable[[Motion], Tensor]]:
    """Decorator that makes a function a feature (attributes: see :class:`Feature`).

    Raises:
        ValueError: the name is taken, the range is empty, the spread is not positive, or ``past`` is beyond the
            context.

    Examples:
        >>> @register("standing", unit="1", clip=(0, 1), weight=1.0, spread=0.3, past=1)
        ... def standing(motion):
        ...     return (motion.ego_poses() == motion.ego_poses(1)).all(-1).float()
        >>> FEATURES.pop("standing").past
        1
    """
    if name in FEATURES:
        raise ValueError(f"feature {name!r} is registered already; choose another name.")
    check_clip(name, clip)
    if not spread > 0:
        raise ValueError(f"the spread of feature {name!r} must be above 0, got {spread}; recipes.spread measures it.")
    if not 0 <= past <= CONTEXT:
        raise ValueError(f"feature {name!r} may read 0 to {CONTEXT} past steps, got {past}.")

    def add(compute: Callable[[Motion], Tensor]) -> Callable[[Motion], Tensor]:
        FEATURES[name] = Feature(compute, unit, clip, weight, spread, past)
        return compute

    return add
