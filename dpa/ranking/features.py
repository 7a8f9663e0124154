"""phi: what the occupancy measure of an agent is made of (paper section 3.2 and eq. 2).

A feature is a function of the poses of all agents, with a unit, a clip range, the paper's weight and the number of past
steps that it needs. Clip ranges are those of the WOSAC 2024 histograms: beyond them, realism does not tell values
apart either. They matter: the share of a feature in the cost follows from its range more than from its weight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from envs.geometry.boxes import nearest_box_distance
from envs.geometry.edges import RoadEdges
from envs.scene import CURRENT_STEP, EDGE_KINDS, STEP_SECONDS, Scene, polylines

CONTEXT = 2
"""Steps of history before the first simulated one, enough for an acceleration."""


@dataclass(frozen=True)
class Motion:
    """What a feature sees: R futures of a scene, with two steps of logged history in front.

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

    @cached_property
    def clearance(self) -> Tensor:
        """``[R, E, T']`` signed distance to the nearest other agent [m]; two features share it."""
        poses = self.poses[:, :, self.steps]
        extent = self.extent[None, :, None, :2].expand(*poses.shape[:-1], 2)
        boxes = torch.cat((poses[..., [0, 1, 3]], extent), -1).transpose(1, 2).contiguous()
        valid = self.valid[:, self.steps].T.expand(boxes.shape[:-1])
        return nearest_box_distance(boxes, valid, self.ego).transpose(1, 2)


@dataclass(frozen=True)
class Feature:
    """One entry of phi.

    Attributes:
        compute: Motion -> ``[R, E, T']``; values where the log is invalid do not matter.
        unit: of the value.
        clip: smallest and largest value told apart, in the same unit.
        weight: the paper's.
        past: steps before the measured one that it reads, all of which must be valid.
    """

    compute: Callable[[Motion], Tensor]
    unit: str
    clip: tuple[float, float]
    weight: float
    past: int


FEATURES: dict[str, Feature] = {}
"""Every feature by name; :func:`register` adds one."""


def register(
    name: str, *, unit: str, clip: tuple[float, float], weight: float, past: int = 0
) -> Callable[[Callable[[Motion], Tensor]], Callable[[Motion], Tensor]]:
    """Decorator that makes a function a feature (attributes: see :class:`Feature`).

    Raises:
        ValueError: the name is taken, the range is empty, or ``past`` is beyond the context.

    Examples:
        >>> @register("standing", unit="1", clip=(0, 1), weight=1.0, past=1)
        ... def standing(motion):
        ...     return (speed(motion) < 0.1).float()
        >>> FEATURES.pop("standing").past
        1
    """
    if name in FEATURES:
        raise ValueError(f"feature {name!r} is registered already; choose another name.")
    if not clip[0] < clip[1]:
        raise ValueError(f"the clip range of feature {name!r} must be (low, high) with low < high, got {clip}.")
    if not 0 <= past <= CONTEXT:
        raise ValueError(f"feature {name!r} may read 0 to {CONTEXT} past steps, got {past}.")

    def add(compute: Callable[[Motion], Tensor]) -> Callable[[Motion], Tensor]:
        FEATURES[name] = Feature(compute, unit, clip, weight, past)
        return compute

    return add


@register("collision", unit="1", clip=(0.0, 1.0), weight=10.0)
def collision(motion: Motion) -> Tensor:
    """1 while the agent's box, corners rounded, overlaps another one."""
    return (motion.clearance < 0).float()


@register("road_edge", unit="m", clip=(-20.0, 40.0), weight=5.0)
def road_edge(motion: Motion) -> Tensor:
    """Signed distance to the road edge of the corner farthest out; positive off the road."""
    poses, extent = motion.ego_poses(), motion.extent[motion.ego][:, None].expand(*motion.shape[1:], 3)
    distance = poses.new_zeros(motion.shape)
    there = motion.ego_valid  # the look-up costs most of phi, and an absent agent has no place to ask for
    poses, extent = poses[:, there], extent[there]
    edges = RoadEdges.from_polylines(polylines(motion.scene, EDGE_KINDS))
    distance[:, there] = edges.box_offroad_distance(poses[..., :3], poses[..., 3], extent)
    return distance


@register("clearance", unit="m", clip=(-5.0, 40.0), weight=2.0)
def clearance(motion: Motion) -> Tensor:
    """Signed distance to the nearest other agent; negative in a collision."""
    return motion.clearance


@register("effort", unit="m/s^2", clip=(0.0, 12.0), weight=1.0, past=2)
def effort(motion: Motion) -> Tensor:
    """Norm of the acceleration vector from the last three positions."""
    now, before, first = (motion.ego_poses(back)[..., :2] for back in range(3))
    return torch.linalg.vector_norm(now - 2 * before + first, dim=-1) / STEP_SECONDS**2


@register("speed", unit="m/s", clip=(0.0, 25.0), weight=1.0, past=1)
def speed(motion: Motion) -> Tensor:
    """Norm of the velocity from the last two positions."""
    now, before = (motion.ego_poses(back)[..., :2] for back in range(2))
    return torch.linalg.vector_norm(now - before, dim=-1) / STEP_SECONDS


FEATURE_SETS: dict[str, tuple[str, ...]] = {
    "full": ("collision", "road_edge", "clearance", "effort", "speed"),
    "collision": ("collision", "clearance"),
    "progress": ("speed",),
    "comfort": ("effort",),
}
"""The rows of the paper's table 2. Which features its "collision only" has is our reading."""


def feature_names(features: str | Sequence[str]) -> tuple[str, ...]:
    """Names of the features of a set, or the names themselves, checked.

    Raises:
        ValueError: an unknown set or name, or none at all.

    Examples:
        >>> feature_names("full")
        ('collision', 'road_edge', 'clearance', 'effort', 'speed')
    """
    if isinstance(features, str):
        if features not in FEATURE_SETS:
            raise ValueError(
                f"unknown feature set {features!r}; choose one of {sorted(FEATURE_SETS)} or give a list of names."
            )
        return FEATURE_SETS[features]
    unknown = [name for name in features if name not in FEATURES]
    if unknown or not features:
        raise ValueError(f"unknown features {unknown} in {list(features)}; choose among {sorted(FEATURES)}.")
    return tuple(features)


def feature_weights(names: Sequence[str], weights: Mapping[str, float] | None = None) -> Tensor:
    """The paper's weights ``[D]`` of some features, or others where given by name.

    Raises:
        ValueError: a weight is given for a feature that is not among the names.

    Examples:
        >>> feature_weights(feature_names("full"), {"speed": 3.0})
        tensor([10.,  5.,  2.,  1.,  3.])
    """
    given = _only_among(names, weights, "weights")
    return torch.tensor([given.get(name, FEATURES[name].weight) for name in names])


def feature_clips(
    names: Sequence[str], clips: Mapping[str, tuple[float, float]] | None = None
) -> dict[str, tuple[float, float]]:
    """The registered clip ranges of some features, or others where given by name.

    Raises:
        ValueError: a range is given for a feature that is not among the names.

    Examples:
        >>> feature_clips(["speed", "effort"], {"effort": (0.0, 8.0)})
        {'speed': (0.0, 25.0), 'effort': (0.0, 8.0)}
    """
    return {name: FEATURES[name].clip for name in names} | _only_among(names, clips, "clips")


def log_trajectory(scene: Scene, steps: int) -> Tensor:
    """The log as a trajectory: ``[A, T, 4]`` x, y, z, heading of the present agents after the current step."""
    return _poses(scene)[:, CURRENT_STEP + 1 : CURRENT_STEP + 1 + steps]


def occupancy_features(
    scene: Scene,
    trajectories: Tensor,
    names: str | Sequence[str] = "full",
    *,
    ego: Tensor | None = None,
    stride: int = 1,
    clips: Mapping[str, tuple[float, float]] | None = None,
) -> tuple[Tensor, Tensor]:
    """Clipped features of every measured agent at every measured step.

    An agent-step is valid where the log is valid at it and at the earlier steps that the features read; steps up to the
    current one come from the log on both sides. So a hole in the log costs the steps after it and nothing else.

    Args:
        scene: an uncollated scene.
        trajectories: ``[R, A, T, 4]`` x, y, z, heading at 10 Hz after the current step, of the present agents in the
            order of the scene; rollouts (see :func:`~envs.geometry.ground.lift`) or the log (:func:`log_trajectory`).
        names: a set of :data:`FEATURE_SETS` or names of :data:`FEATURES`.
        ego: ``[E]`` int64, rows of the agents to measure; all of them by default.
        stride: measure every ``stride``-th step, the last of each group: 5 gives the ends of 0.5 s decisions.
        clips: other clip ranges, by name.

    Returns:
        features ``[R, E, T // stride, D]``, 0 where not valid, and valid ``[E, T // stride]`` bool.

    Raises:
        ValueError: unknown names, a stride below 1, or trajectories that do not fit the scene.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2, speed=10.0)
        >>> phi, valid = occupancy_features(scene, log_trajectory(scene, 80)[None])
        >>> phi[0, 0, 0]
        tensor([ 0.0000, -1.5500, 10.4000,  0.0000, 10.0000])
    """
    names = feature_names(names)
    ranges = feature_clips(names, clips)
    motion = _motion(scene, trajectories, ego, stride)
    past = max(FEATURES[name].past for name in names)
    valid = torch.stack([motion.valid[motion.ego][:, motion.steps - back] for back in range(past + 1)]).all(0)
    phi = torch.stack([FEATURES[name].compute(motion).clamp(*ranges[name]) for name in names], -1)
    return torch.where(valid[..., None], phi, 0.0), valid


def _motion(scene: Scene, trajectories: Tensor, ego: Tensor | None, stride: int) -> Motion:
    agents, present = scene.agents, scene.agents.present
    steps = trajectories.shape[2]
    room = agents.valid.shape[-1] - CURRENT_STEP - 1
    if trajectories.shape[1] != int(present.sum()) or trajectories.shape[-1] != 4 or not 1 <= steps <= room:
        raise ValueError(
            f"scene {scene.scene_id} takes trajectories [R, {int(present.sum())}, T, 4] with T up to {room}, got "
            f"{list(trajectories.shape)}."
        )
    if not 1 <= stride <= steps:
        raise ValueError(f"stride must be 1 to {steps} (the number of steps), got {stride}.")
    history = slice(CURRENT_STEP + 1 - CONTEXT, CURRENT_STEP + 1)
    before = _poses(scene)[:, history].to(trajectories).expand(len(trajectories), -1, -1, -1)
    return Motion(
        scene=scene,
        poses=torch.cat((before, trajectories), 2),
        valid=agents.valid[present][:, history.start : history.stop + steps],
        extent=agents.extent[present],
        ego=torch.arange(int(present.sum())) if ego is None else ego,
        steps=torch.arange(stride - 1, steps, stride) + CONTEXT,
    )


def _poses(scene: Scene) -> Tensor:
    """``[A, L, 4]`` x, y, z, heading of the present agents."""
    agents, present = scene.agents, scene.agents.present
    return torch.cat((agents.position[present], agents.heading[present][..., None]), -1)


def _only_among(names: Sequence[str], given: Mapping | None, what: str) -> dict:
    """The mapping given, refused where it names a feature that is not used: a typing slip would pass unseen."""
    unknown = sorted(set(given or {}) - set(names))
    if unknown:
        raise ValueError(f"{what} are given for {unknown}, which are not among the features {list(names)}.")
    return dict(given or {})
