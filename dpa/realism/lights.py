"""Driving through red lights, as the 2025 challenge counts it (realism.md section 4.2)."""

from __future__ import annotations

from collections.abc import Set

import torch
from torch import Tensor

from dpa.realism.quirks import Quirk
from envs.geometry.lights import Lanes, crosses_red
from envs.scene import RED_STATES, LightState, Scene, surface_streets


def red_light_violation(scene: Scene, position: Tensor, valid: Tensor, quirks: Set[Quirk] = frozenset(Quirk)) -> Tensor:
    """Steps at which agents pass the stop point of the lane that they are on while its light is red.

    Args:
        scene: an uncollated scene in the frame of the world (:func:`dpa.realism.tracks.to_world`), for its lanes
            and lights.
        position: ``[C, E, L, 2]``, centres at the last L of the 91 steps [m].
        valid: ``[C, E, L]`` bool.
        quirks: of the official code that are kept.

    Returns:
        ``[C, E, L - 1]`` bool, for the steps after the first one.
    """
    lanes = Lanes.from_polylines(
        *surface_streets(scene.road),
        to_origin=Quirk.LANES_TO_ORIGIN in quirks,
        plus_for_minus=Quirk.PLUS_FOR_MINUS in quirks,
    )
    if lanes is None:
        return torch.zeros_like(valid[..., 1:])
    steps = position.shape[2]
    state, stop = scene.lights.state[:, -steps:], scene.lights.stop_point[:, -steps:, :2]
    red = torch.isin(state, torch.tensor(RED_STATES, device=state.device))[:, 1:]
    if Quirk.ABSENT_STOP_AT_ORIGIN not in quirks:
        red = red & (state != LightState.ABSENT)[:, :-1]
    crossed = crosses_red(lanes, scene.lights.lane_id, red, stop, position, valid)
    return crossed if Quirk.INVALID_AT_ORIGIN in quirks else crossed & valid[..., :-1]
