"""From SUMO's front bumpers to box centres, headings and velocities that a body on wheels can have.

SUMO steers by lane geometry: the front bumper follows lane centres and the angle may jump where lanes meet. Here the
centre of the box is smoothed in time, and the heading is that of a trailer: a point behind the centre (about where the
rear axle is) is pulled along, so it never slides sideways and a standing body never turns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envs.scene import STEP_SECONDS, AgentKind
from envs.sources.sumo.traffic import Recording

SMOOTHING_STEPS = 2.0
"""Standard deviation of the Gaussian that smooths a centre in time [steps of 0.1 s]."""
KERNEL_REACH = 6
"""Half the length of that Gaussian's kernel [steps]; a shorter track is left out."""
DECIMALS = 5
"""Of a centre [m]: what processors compute differently in the last bits is the same scene on all of them."""
AXLE_SHARE = {AgentKind.VEHICLE: 0.3, AgentKind.CYCLIST: 0.3, AgentKind.PEDESTRIAN: 1.0}
"""Distance from the centre to the pulled point, in lengths of the road user."""
JUMP_SLACK = 0.5
"""A step longer than the speed allows by more than this [m] is a teleport; SUMO moves pedestrians so at corners."""


@dataclass(frozen=True)
class Tracks:
    """Road users of a simulation at 10 Hz.

    Attributes:
        owner: ``[V]``, place of the road user in the recording.
        kind: ``[V]``, :class:`~envs.scene.AgentKind`.
        is_car: ``[V]`` bool, can be an SDC.
        extent: ``[V, 3]`` [m].
        track_id: ``[V]`` int64.
        centre: ``[V, T, 2]``, 0 where invalid [m].
        heading: ``[V, T]``, counter-clockwise from east, 0 where invalid [rad].
        velocity: ``[V, T, 2]``, 0 where invalid [m/s].
        valid: ``[V, T]`` bool; one unbroken run for each road user.
    """

    owner: np.ndarray
    kind: np.ndarray
    is_car: np.ndarray
    extent: np.ndarray
    track_id: np.ndarray
    centre: np.ndarray
    heading: np.ndarray
    velocity: np.ndarray
    valid: np.ndarray


def make_tracks(recording: Recording) -> Tracks:
    """Kinematically plausible tracks; one that teleports is cut there, and its parts are tracks of their own.

    Args:
        recording: of a simulation.
    """
    heading = np.deg2rad(90.0 - recording.angle)
    facing = np.stack((np.cos(heading), np.sin(heading)), -1)
    raw = recording.front - facing * recording.extent[:, None, :1] / 2
    runs = [(i, s, e) for i in range(len(raw)) for s, e in _unbroken(recording.front[i], recording.speed[i])]
    owner = np.array([i for i, _, _ in runs], dtype=np.int64)
    centre = np.full((len(runs), *raw.shape[1:]), np.nan)
    velocity = np.zeros_like(centre)
    for row, (i, start, end) in enumerate(runs):
        centre[row, start:end] = smooth(raw[i, start:end]).round(DECIMALS)
        velocity[row, start:end] = np.gradient(centre[row, start:end], STEP_SECONDS, axis=0)
    valid = np.isfinite(centre[..., 0])
    share = np.array([AXLE_SHARE[AgentKind(kind)] for kind in recording.kind])
    trailed = trail(centre, heading[owner], (share * recording.extent[:, 0])[owner])
    return Tracks(
        owner=owner,
        kind=recording.kind[owner],
        is_car=recording.is_car[owner],
        extent=recording.extent[owner],
        track_id=np.arange(len(runs)) + 1,
        centre=np.where(valid[..., None], centre, 0.0),
        heading=np.where(valid, trailed, 0.0),
        velocity=velocity,
        valid=valid,
    )


def _unbroken(front: np.ndarray, speed: np.ndarray) -> list[tuple[int, int]]:
    """Runs ``start, end`` of ``[T, 2]`` positions without a hole or a teleport, long enough to be smoothed."""
    there = np.isfinite(speed)
    step = np.linalg.norm(np.diff(front, axis=0), axis=1)
    joined = step <= np.nan_to_num(speed[1:]) * STEP_SECONDS + JUMP_SLACK  # a NaN step is not joined
    starts = np.flatnonzero(there & ~np.concatenate(([False], joined)))
    ends = np.flatnonzero(there & ~np.concatenate((joined, [False]))) + 1
    return [(int(s), int(e)) for s, e in zip(starts, ends, strict=True) if e - s > KERNEL_REACH]


def smooth(positions: np.ndarray) -> np.ndarray:
    """Gaussian smoothing in time that keeps straight uniform motion, also at both ends.

    Args:
        positions: ``[T, 2]``, T > :data:`KERNEL_REACH`.

    Returns:
        ``[T, 2]``.

    Examples:
        >>> line = np.arange(20.0)[:, None] * [1.0, 2.0]
        >>> bool(np.allclose(smooth(line), line))
        True
    """
    reach = KERNEL_REACH
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SMOOTHING_STEPS) ** 2)
    kernel /= kernel.sum()
    # reflect through the end points, so that the motion goes on as it was
    before = 2 * positions[0] - positions[reach:0:-1]
    after = 2 * positions[-1] - positions[-2 : -reach - 2 : -1]
    padded = np.concatenate((before, positions, after))
    return np.stack([np.convolve(padded[:, i], kernel, mode="valid") for i in range(2)], -1)


def trail(centre: np.ndarray, first_heading: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Headings of bodies whose pulled point follows the centre at a fixed distance (a tractrix).

    Args:
        centre: ``[V, T, 2]``; NaN where invalid [m].
        first_heading: ``[V, T]``; only the value where a track begins is used [rad].
        distance: ``[V]``, from the centre to the pulled point [m].

    Returns:
        ``[V, T]`` [rad]; NaN where invalid.

    Examples:
        >>> east = np.stack((np.arange(100.0), np.zeros(100)), -1)[None]
        >>> float(trail(east, np.full((1, 100), 1.0), np.array([1.5]))[0, -1].round(6))
        0.0
    """
    heading = np.full(centre.shape[:2], np.nan)
    facing = np.stack((np.cos(first_heading), np.sin(first_heading)), -1)
    pulled = np.full((len(centre), 2), np.nan)
    for t in range(centre.shape[1]):
        new = np.isnan(pulled[:, 0])
        pull = np.where(new[:, None], facing[:, t] * distance[:, None], centre[:, t] - pulled)
        pull /= np.linalg.norm(pull, axis=-1, keepdims=True)
        heading[:, t] = np.arctan2(pull[:, 1], pull[:, 0])
        pulled = centre[:, t] - pull * distance[:, None]
    return heading
