"""Likelihood of the log under the rollouts, feature by feature and event by event (realism.md sections 6 and 7)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from dpa.realism.config import Differences, Histogram, Kernel, RealismConfig
from dpa.realism.estimators import indicator_log_likelihood, log_likelihood
from dpa.realism.features import Features
from dpa.realism.quirks import Quirk
from envs.scene import AgentKind

_EVENTS = {
    "collision_indication": "collision_per_step",
    "offroad_indication": "offroad_per_step",
    "traffic_light_violation": "traffic_light_violation_per_step",
}
_RATES = {
    "collision_rate": "collision_per_step",
    "offroad_rate": "offroad_per_step",
    "traffic_light_violation_rate": "traffic_light_violation_per_step",
}

_OF_CLASS = {
    "vehicle_collision": (AgentKind.VEHICLE, "collision_per_step"),
    "pedestrian_collision": (AgentKind.PEDESTRIAN, "collision_per_step"),
    "cyclist_collision": (AgentKind.CYCLIST, "collision_per_step"),
    "vehicle_offroad": (AgentKind.VEHICLE, "offroad_per_step"),
}
CLASS_RATES = tuple(_OF_CLASS)
"""Rates of the agents of one class. Those on foot are off the road by rights, so only of vehicles it is told."""


class Score(NamedTuple):
    """How likely the log of each of E agents is by one metric."""

    total: Tensor
    """``[E]``: log-likelihood, summed over what is scored [nats]."""
    count: Tensor
    """``[E]`` int64: steps that are scored, or 1 of an event."""


def scores(measured: Features, config: RealismConfig) -> dict[str, Score]:
    """Score every metric that was measured: continuous features, then events."""
    masks = _masks(measured, config)
    found = {
        name: _continuous(measured.values[name], masks[name], estimator, config)
        for name, estimator in config.continuous.items()
    }
    for name, indicator in config.indicators.items():
        if _EVENTS[name] in measured.values:
            event = happened(measured, _EVENTS[name], config).any(-1)
            if name == "traffic_light_violation":
                event = event & measured.vehicle
            score = indicator_log_likelihood(event[0], event[1:], indicator)
            found[name] = Score(score, torch.ones_like(score, dtype=torch.int64))
    return found


def _continuous(value: Tensor, mask: Tensor, estimator: Histogram | Kernel, config: RealismConfig) -> Score:
    score = log_likelihood(
        value[0],
        value[1:],
        estimator,
        None if Quirk.UNMASKED_SAMPLES in config.quirks else mask,
        keep_nan=Quirk.NAN_IN_LAST_BIN in config.quirks,
    )
    return Score(torch.where(mask, score, 0).sum(-1), mask.sum(-1))


def _masks(measured: Features, config: RealismConfig) -> dict[str, Tensor]:
    """Steps ``[E, T]`` at which the log of each continuous feature counts."""
    scored, steps = measured.scored, measured.scored.shape[-1]
    # The official code looks for neighbours among the scored steps only, so the ends have none.
    known = scored if Quirk.ENDS_UNSCORED in config.quirks else measured.valid
    speed = _with_neighbours(known, config.differences)
    acceleration = _with_neighbours(speed, config.differences)[:, -steps:]
    ttc = scored & measured.vehicle[0, :, None] if config.ttc_vehicle_only else scored
    if Quirk.LAST_TTC not in config.quirks and config.differences == "central":
        ttc = ttc & (torch.arange(steps, device=ttc.device) < steps - 1)
    # Beside a hole of the log there is no speed; the ends are no holes.
    if Quirk.INVALID_AT_ORIGIN not in config.quirks:
        ttc = ttc & _with_neighbours(pad(measured.valid, (1, 1), value=True), config.differences)[:, 1:-1][:, -steps:]
    return {
        "linear_speed": speed[:, -steps:],
        "angular_speed": speed[:, -steps:],
        "linear_acceleration": acceleration,
        "angular_acceleration": acceleration,
        "distance_to_nearest_object": scored,
        "distance_to_road_edge": scored,
        "time_to_collision": ttc,
    }


def _with_neighbours(valid: Tensor, differences: Differences) -> Tensor:
    """Steps whose difference is known (realism.md sections 2.3 and 8): ``[E, T]`` -> ``[E, T]``."""
    result = torch.zeros_like(valid)
    if differences == "central":
        result[:, 1:-1] = valid[:, :-2] & valid[:, 2:]
    else:
        result[:, 1:] = valid[:, :-1] & valid[:, 1:]
    return result


def event_rates(measured: Features, config: RealismConfig) -> dict[str, Tensor]:
    """Share of rollouts and agents to which each event happened, ``[]`` each."""
    return {
        name: happened(measured, event, config).any(-1)[1:].float().mean()
        for name, event in _RATES.items()
        if event in measured.values
    }


def class_rates(measured: Features, config: RealismConfig) -> dict[str, float]:
    """What the rates of collision and off-road are of the evaluated agents of each class.

    Args:
        measured: what the metric measured in a scene.
        config: as of the metric.

    Returns:
        Share of (rollout, agent) pairs by name of :data:`CLASS_RATES`; NaN where nobody of the class is evaluated.

    Examples:
        >>> from dpa.realism import realism
        >>> from envs.sources.synthetic import straight_road
        >>> scene, config = straight_road(num_vehicles=2), RealismConfig.load("2024")
        >>> piled_up = realism(scene, torch.zeros(4, 2, 80, 4), config, features=True)
        >>> class_rates(piled_up.features, config)["vehicle_collision"]
        1.0
    """
    return {
        name: happened(measured, event, config).any(-1)[1:, measured.kind == of].float().mean().item()
        for name, (of, event) in _OF_CLASS.items()
    }


def happened(measured: Features, event: str, config: RealismConfig) -> Tensor:
    """``[C, E, T]`` bool: the event happens at steps at which the agent is there in the log, as rates count it."""
    return measured.values[event] & (measured.scored | (Quirk.GHOSTS in config.quirks))
