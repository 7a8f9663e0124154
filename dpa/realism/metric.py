"""From measurements to the realism meta-metric of the Waymo Open Sim Agents Challenge (realism.md section 7)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from dpa.realism.config import BUCKETS, RealismConfig
from dpa.realism.features import Features, measure
from dpa.realism.likelihood import event_rates, scores
from dpa.realism.tracks import HORIZON, Comparison, Generated, compare
from envs.scene import LOG_STEPS, Scene

BYTES_PER_GIB = 1 << 30
BYTES_PER_POSE = 170
"""Peak memory of measuring a batch, by agents x steps x (rollouts and log); of 4 to 32 crowded scenes on a CPU."""


@dataclass(frozen=True)
class RealismResult:
    """Realism of the rollouts of a scene, or the mean over scenes.

    Attributes:
        realism: the meta-metric, 0 to 1.
        kinematic: weighted mean of the likelihoods of speeds and accelerations.
        interactive: that of distances, collisions and time to collision.
        map_based: that of the road edge, off-road and, in 2025, red lights.
        likelihood: of each scored metric, by name.
        rate: part of (rollout, agent) pairs with an event, by name: ``collision_rate``, ``offroad_rate`` and, in 2025,
            ``traffic_light_violation_rate``.
        min_ade: mean displacement of the best rollout, history included as in the official code [m].
        ade: mean displacement of all rollouts [m].
        scenes: how many scenes the values are the mean of.
        features: what was measured, if asked for.
    """

    realism: float
    kinematic: float
    interactive: float
    map_based: float
    likelihood: Mapping[str, float]
    rate: Mapping[str, float]
    min_ade: float
    ade: float
    scenes: int = 1
    features: Features | None = field(default=None, repr=False, compare=False)

    @property
    def collision_rate(self) -> float:
        """Part of (rollout, agent) pairs with a collision."""
        return self.rate["collision_rate"]

    @property
    def offroad_rate(self) -> float:
        """Part of (rollout, agent) pairs that leave the road."""
        return self.rate["offroad_rate"]

    def as_dict(self) -> dict[str, float]:
        """All figures in one flat dictionary; likelihoods end in ``_likelihood``."""
        return {
            "realism": self.realism,
            "kinematic": self.kinematic,
            "interactive": self.interactive,
            "map_based": self.map_based,
            "min_ade": self.min_ade,
            "ade": self.ade,
            **self.rate,
            **{f"{name}_likelihood": value for name, value in self.likelihood.items()},
        }

    def official(self) -> dict[str, dict[str, float]]:
        """All figures under their official names: ``metrics`` of the metric, ``buckets`` of the challenge's ranking."""
        rates = {f"simulated_{name}": value for name, value in self.rate.items()}
        return {
            "metrics": {
                "metametric": self.realism,
                "average_displacement_error": self.ade,
                "min_average_displacement_error": self.min_ade,
                **{f"{name}_likelihood": value for name, value in self.likelihood.items()},
                **rates,
            },
            "buckets": {
                "realism_meta_metric": self.realism,
                **{f"{name}_metrics": getattr(self, name) for name in BUCKETS},
                "min_ade": self.min_ade,
                **rates,
            },
        }


@torch.no_grad()
def realism(
    scene: Scene,
    simulated: Tensor,
    config: str | Path | RealismConfig = "2024",
    *,
    quirks: bool = True,
    generated: Generated | None = None,
    features: bool = False,
) -> RealismResult:
    """Score rollouts of one scene.

    The evaluated agents are the SDC and the tracks to predict, as far as they are present at the current step; all
    present agents are obstacles. A likelihood over no step at all is NaN, and so is the meta-metric then.

    Args:
        scene: one uncollated scene, on whose device the metric is computed.
        simulated: ``[R, A, 80, 4]``, x, y, z, heading of steps 11 to 90 in the scene's frame, where A are the agents
            with ``scene.agents.present``, in that order; from another device they are brought over. The standard is
            R = 32. With a configuration of the Scenario Generation challenge ``[R, A, 91, 4]``, all steps.
        config: the year, a path or a :class:`RealismConfig`.
        quirks: ``False`` leaves out all that looks like an accident of the official code (:mod:`dpa.realism.quirks`):
            a cleaner metric, whose numbers compare with no others.
        generated: sizes and classes that generated scenes bring along; those of the log by default.
        features: also return what was measured.

    Raises:
        ValueError: the shape does not fit the scene, or a value is not finite.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(num_vehicles=3, seed=0)
        >>> log = scene.agents.trajectory[None, :, 11:]
        >>> result = realism(scene, log.expand(32, -1, -1, -1))
        >>> result.min_ade, result.collision_rate
        (0.0, 0.0)
    """
    return realism_of([scene], [simulated], config, quirks=quirks, generated=[generated], features=features)[0]


@torch.no_grad()
def realism_of(
    scenes: Sequence[Scene],
    simulated: Sequence[Tensor],
    config: str | Path | RealismConfig = "2024",
    *,
    quirks: bool = True,
    generated: Sequence[Generated | None] | None = None,
    features: bool = False,
    memory: float = 1.0,
) -> list[RealismResult]:
    """Score rollouts of several scenes, many at a time; the arguments are those of :func:`realism`, one of each scene.

    Scenes in one batch share the cost of starting each operation. That is for GPUs; on a CPU one scene at a time is
    faster, as its working set stays in the cache (docs/studies/speed.md).

    Args:
        scenes: uncollated, all on one device: there the metric is computed.
        simulated: rollouts of each; they are brought to the scenes.
        config: see :func:`realism`.
        quirks: see :func:`realism`.
        generated: see :func:`realism`.
        features: see :func:`realism`.
        memory: roughly what the batch may take beyond its inputs [GiB]; a scene that needs more is scored alone.

    Raises:
        ValueError: as for :func:`realism`, or not as many rollouts as scenes.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scenes = [straight_road(num_vehicles=n, seed=n) for n in (2, 3)]
        >>> [result.min_ade for result in realism_of(scenes, [torch.zeros(4, n, 80, 4) for n in (2, 3)])] != [0.0, 0.0]
        True
    """
    config = _opened(config, quirks)
    extras = [None] * len(scenes) if generated is None else generated
    comparisons = []
    for scene, poses, extra in zip(scenes, simulated, extras, strict=True):
        poses = poses.to(scene.agents.position)  # the one way from where they were rolled out to where the scene is
        _check(scene, poses, config, extra)
        comparisons.append(compare(scene, poses, config, extra))
    return [
        _score(measured, config, features)
        for batch in _batches(comparisons, memory * BYTES_PER_GIB)
        for measured in measure(batch, config)
    ]


@torch.no_grad()
def realism_of_groups(
    scene: Scene,
    simulated: Tensor,
    groups: Sequence[Tensor],
    config: str | Path | RealismConfig = "2024",
) -> list[RealismResult]:
    """Score groups of the rollouts of one scene, each as :func:`realism` would; all are measured once.

    Args:
        scene: one uncollated scene.
        simulated: ``[R, A, 80, 4]``, see :func:`realism`.
        groups: of each group the rollouts, ``[R']`` int64.
        config: see :func:`realism`.

    Raises:
        ValueError: as for :func:`realism`, or a group without rollouts.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(num_vehicles=2)
        >>> halves = torch.arange(8).view(2, 4)
        >>> len(realism_of_groups(scene, torch.zeros(8, 2, 80, 4), halves))
        2
    """
    if any(len(group) == 0 for group in groups):
        raise ValueError(f"scene {scene.scene_id}: a group without rollouts has no realism; give each at least one.")
    config, simulated = _opened(config), simulated.to(scene.agents.position)
    _check(scene, simulated, config, None)
    (measured,) = measure([compare(scene, simulated, config)], config)
    return [_score(measured.of(group), config, features=False) for group in groups]


def contributions(measured: Features, config: RealismConfig) -> Tensor:
    """What each evaluated agent of each rollout adds to the realism of the group, all rollouts against all but one.

    An entry is the realism of the R rollouts minus what it is when the distributions of this agent are estimated from
    the other R - 1 of them; a rollout adds the more, the more it looks like the log where others do not. With one
    evaluated agent this is the difference of two calls of :func:`realism`; with many, the entries of a rollout add up
    to that difference to first order. (A distribution that agents share is estimated without the whole rollout.)

    Args:
        measured: from :func:`~dpa.realism.measure`, of two rollouts or more.
        config: that it was measured with.

    Returns:
        ``[R, E]``, agents as in ``measured.track_id``.

    Raises:
        ValueError: one rollout alone.

    Examples:
        >>> from dpa.realism import compare, measure
        >>> from envs.sources.synthetic import straight_road
        >>> scene, config = straight_road(num_vehicles=2), RealismConfig.load("2024")
        >>> log = scene.agents.trajectory[None, :, 11:]
        >>> (measured,) = measure([compare(scene, torch.cat((log, log, log + 50.0)), config)], config)
        >>> contributions(measured, config).sum(1).sign()
        tensor([ 1.,  1., -1.])
    """
    rollouts = len(measured.displacement)
    if rollouts < 2:
        raise ValueError("one rollout is a group of its own, to which it adds all; measure two or more.")
    others = [torch.tensor([other for other in range(rollouts) if other != each]) for each in range(rollouts)]
    without = [scores(measured.of(some.to(measured.displacement.device)), config) for some in others]
    added = measured.displacement.new_zeros(rollouts, len(measured.track_id))
    for name, (total, count) in scores(measured, config).items():
        left = torch.stack([each[name].total for each in without])
        whole, steps = total.sum(), count.sum().clamp(min=1)
        added += config.weights[name] * ((whole / steps).exp() - ((whole - total + left) / steps).exp())
    return added


def _opened(config: str | Path | RealismConfig, quirks: bool = True) -> RealismConfig:
    opened = config if isinstance(config, RealismConfig) else RealismConfig.load(config)
    return opened if quirks else opened.replace(quirks=frozenset())


def _batches(comparisons: list[Comparison], budget: float) -> Iterator[list[Comparison]]:
    """Neighbouring scenes whose working sets fit into the budget [bytes] together, one at least."""
    batch: list[Comparison] = []
    for each in comparisons:
        rows, agents = 0, 0
        for other in (*batch, each):
            rows, agents = rows + len(other.tracks.valid), max(agents, other.tracks.valid.shape[1])
        needed = rows * agents * each.tracks.valid.shape[2] * BYTES_PER_POSE
        if batch and needed > budget:
            yield batch
            batch = []
        batch.append(each)
    if batch:
        yield batch


def _score(measured: Features, config: RealismConfig, features: bool) -> RealismResult:
    scored, rates = scores(measured, config), event_rates(measured, config)
    weights, displacement = config.weights, measured.displacement
    displacement = displacement[:, ~displacement.isnan().any(0)]  # without history, an agent may have no step at all
    figures = {name: (total.sum() / count.sum()).exp() for name, (total, count) in scored.items()}
    figures |= rates | {"min_ade": displacement.mean(1).min(), "ade": displacement.mean()}
    # Read at once: each look at a figure would wait for the device.
    figures = dict(zip(figures, torch.stack(list(figures.values())).tolist(), strict=True))
    likelihood = {name: figures[name] for name in scored}
    return RealismResult(
        realism=sum(weights[name] * value for name, value in likelihood.items()),
        likelihood=likelihood,
        rate={name: figures[name] for name in rates},
        min_ade=figures["min_ade"],
        ade=figures["ade"],
        features=measured if features else None,
        **{bucket: _weighted_mean(likelihood, weights, names) for bucket, names in BUCKETS.items()},
    )


def mean_result(results: Sequence[RealismResult]) -> RealismResult:
    """Mean of every figure over scenes, as the challenge averages (each scene counts the same).

    Args:
        results: of single scenes or of groups of them, all of one configuration.

    Raises:
        ValueError: there are none, or they score different metrics.

    Examples:
        >>> one = RealismResult(0.2, 0.2, 0.2, 0.2, {}, {}, 1.0, 2.0)
        >>> mean_result([one, RealismResult(0.4, 0.4, 0.4, 0.4, {}, {}, 3.0, 4.0, scenes=3)]).min_ade
        2.5
    """
    if not results:
        raise ValueError("the mean of no results is not defined; give at least one.")
    names = {tuple(result.as_dict()) for result in results}
    if len(names) > 1:
        raise ValueError(f"results of different configurations cannot be averaged: their figures are {sorted(names)}.")
    total = sum(result.scenes for result in results)

    def mean(values: Sequence[float]) -> float:
        return sum(value * result.scenes for value, result in zip(values, results, strict=True)) / total

    def mean_of(attribute: str) -> float:
        return mean([getattr(result, attribute) for result in results])

    def mean_by_name(attribute: str) -> dict[str, float]:
        return {name: mean([getattr(r, attribute)[name] for r in results]) for name in getattr(results[0], attribute)}

    return RealismResult(
        likelihood=mean_by_name("likelihood"),
        rate=mean_by_name("rate"),
        scenes=total,
        **{name: mean_of(name) for name in ("realism", *BUCKETS, "min_ade", "ade")},
    )


def _check(scene: Scene, simulated: Tensor, config: RealismConfig, generated: Generated | None) -> None:
    agents, steps = int(scene.agents.present.sum()), LOG_STEPS if config.scenario_generation else HORIZON
    if simulated.ndim != 4 or not len(simulated) or simulated.shape[1:] != (agents, steps, 4):
        raise ValueError(
            f"scene {scene.scene_id}: rollouts must have shape [R, {agents}, {steps}, 4] (rollouts, agents present "
            f"at the current step, steps, x y z heading) with R >= 1, got {list(simulated.shape)}."
        )
    if generated is not None:
        shapes, wanted = [list(part.shape) for part in generated], [[*simulated.shape[:2], 3], [*simulated.shape[:2]]]
        if not config.scenario_generation or shapes != wanted:
            raise ValueError(
                f"scene {scene.scene_id}: extent and kind of generated agents must have the shapes {wanted}, got "
                f"{shapes}; only configurations of the Scenario Generation challenge take them, not {config.name!r}."
            )
    finite = torch.isfinite(simulated)
    if not finite.all():
        rollout, agent, step, column = (~finite).nonzero()[0].tolist()
        track = int(scene.agents.track_id[scene.agents.present][agent])
        value = simulated[rollout, agent, step, column].item()
        raise ValueError(
            f"scene {scene.scene_id}: rollout {rollout} has {'xyz'[column] if column < 3 else 'heading'} = {value} for "
            f"track {track} at simulated step {step}; every present agent needs a finite state at every step."
        )


def _weighted_mean(likelihood: Mapping[str, float], weights: Mapping[str, float], names: Sequence[str]) -> float:
    scored = [name for name in names if name in likelihood]
    return sum(weights[name] * likelihood[name] for name in scored) / sum(weights[name] for name in scored)
