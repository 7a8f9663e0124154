"""Features of a set, clipped, of every agent and step; with the weights that the cost gives them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from dpa.ranking.features import more  # noqa: F401 - registers its features
from dpa.ranking.features.paper import FEATURE_SETS
from dpa.ranking.features.registry import CONTEXT, FEATURES, Motion, check_clip
from envs.scene import CURRENT_STEP, Scene

WEIGHTS = ("paper", "normalised")
"""Ways to weigh features that have a name."""


def feature_names(features: str | Sequence[str]) -> tuple[str, ...]:
    """Names of the features of a set, or the names themselves, checked.

    Raises:
        ValueError: an unknown set or name, one that comes twice, or none at all.

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
    if len(set(features)) < len(features):
        raise ValueError(f"a feature comes twice in {list(features)}; name each once, and weigh it with weights.")
    return tuple(features)


def feature_weights(names: Sequence[str], weights: str | Mapping[str, float] | None = None) -> Tensor:
    """Weights ``[D]`` of some features.

    Args:
        names: of the features.
        weights: the paper's by default, or as ``"paper"``; ``"normalised"`` divides each by the square of the feature's
            spread, so that the weights and not the units decide the shares in the cost; a mapping gives other weights
            by name, and the paper's for what it does not name.

    Raises:
        ValueError: an unknown way to weigh, a negative weight, or one for a feature that is not among the names.

    Examples:
        >>> feature_weights(feature_names("full"), {"speed": 3.0})
        tensor([10.,  5.,  2.,  1.,  3.])
        >>> shares = feature_weights(["collision"], "normalised") * FEATURES["collision"].spread ** 2
        >>> shares
        tensor([10.])
    """
    if isinstance(weights, str):
        if weights not in WEIGHTS:
            raise ValueError(f"unknown weights {weights!r}; choose one of {list(WEIGHTS)} or give numbers by name.")
        power = 2 if weights == "normalised" else 0
        return torch.tensor([FEATURES[name].weight / FEATURES[name].spread ** power for name in names])
    given = _only_among(names, weights, "weights")
    for name, weight in given.items():
        if not (weight >= 0 and math.isfinite(weight)):
            raise ValueError(f"the weight of feature {name!r} must be a number of 0 or more, got {weight}.")
    return torch.tensor([given.get(name, FEATURES[name].weight) for name in names])


def feature_clips(
    names: Sequence[str], clips: Mapping[str, tuple[float, float]] | None = None
) -> dict[str, tuple[float, float]]:
    """The registered clip ranges of some features, or others where given by name.

    Raises:
        ValueError: a range is empty, or given for a feature that is not among the names.

    Examples:
        >>> feature_clips(["speed", "effort"], {"effort": (0.0, 8.0)})
        {'speed': (0.0, 25.0), 'effort': (0.0, 8.0)}
    """
    given = _only_among(names, clips, "clips")
    for name, clip in given.items():
        check_clip(name, clip)
    return {name: FEATURES[name].clip for name in names} | given


def log_trajectory(scene: Scene, steps: int) -> Tensor:
    """The log as a trajectory: ``[A, T, 4]`` x, y, z, heading of the present agents after the current step."""
    return scene.agents.trajectory[scene.agents.present, CURRENT_STEP + 1 : CURRENT_STEP + 1 + steps]


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
        scene: an uncollated scene, on the CPU; features are computed where the trajectories are.
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
    valid = logged_steps(scene, trajectories.shape[2], names, ego=ego, stride=stride).to(trajectories.device)
    phi = torch.stack([FEATURES[name].compute(motion).clamp(*ranges[name]) for name in names], -1)
    return torch.where(valid[..., None], phi, 0.0), valid


def logged_steps(
    scene: Scene,
    steps: int,
    names: str | Sequence[str] = "full",
    *,
    ego: Tensor | None = None,
    stride: int = 1,
) -> Tensor:
    """At which measured steps the log has what features read, where the scene is: nobody waits for a device to know.

    Args:
        scene: an uncollated scene.
        steps: T.
        names: of the features, as for :func:`occupancy_features`.

    Keyword Args:
        ego: ``[E]`` int64, rows of the agents to measure; all of them by default.
        stride: measure every ``stride``-th step.

    Returns:
        ``[E, T // stride]`` bool.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> logged_steps(straight_road(2), 80, stride=5).shape
        torch.Size([2, 16])
    """
    valid = scene.agents.valid[scene.agents.present]
    valid = valid if ego is None else valid[ego]
    at = torch.arange(CURRENT_STEP + stride, CURRENT_STEP + 1 + steps, stride, device=valid.device)
    past = max(FEATURES[name].past for name in feature_names(names))
    return torch.stack([valid[:, at - back] for back in range(past + 1)]).all(0)


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
    history, device = slice(CURRENT_STEP + 1 - CONTEXT, CURRENT_STEP + 1), trajectories.device
    before = agents.trajectory[present, history].to(trajectories).expand(len(trajectories), -1, -1, -1)
    return Motion(
        scene=scene,
        poses=torch.cat((before, trajectories), 2),
        valid=agents.valid[present][:, history.start : history.stop + steps].to(device),
        extent=agents.extent[present].to(device),
        ego=torch.arange(trajectories.shape[1], device=device) if ego is None else ego.to(device),
        steps=torch.arange(stride - 1, steps, stride, device=device) + CONTEXT,
    )


def _only_among(names: Sequence[str], given: Mapping | None, what: str) -> dict:
    """The mapping given, refused where it names a feature that is not used: a typing slip would pass unseen."""
    unknown = sorted(set(given or {}) - set(names))
    if unknown:
        raise ValueError(f"{what} are given for {unknown}, which are not among the features {list(names)}.")
    return dict(given or {})
