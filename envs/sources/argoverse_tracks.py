"""Rows of an Argoverse 2 scenario, one for each track and time step -> tracks of 91 steps."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from envs.scene import LOG_STEPS, SceneError
from envs.sources.fields import LARGEST_NUMBER, shown

SCENARIO_STEPS = 110
FIRST_STEP = SCENARIO_STEPS - LOG_STEPS
"""The step that becomes our step 0, so that our current step 10 is their step 29: the latest choice with all 80 steps
of future. (Their own current step is 49, with 60 steps to come.)"""
SDC_TRACK = "AV"
MOST_ROWS = 1_000_000
MOST_TRACKS = 10_000
"""Of one scenario; usual are 5,000 and 100."""

TEXT_COLUMNS = ("scenario_id", "track_id", "object_type")
WHOLE_COLUMNS = ("timestep", "object_category")
NUMBER_COLUMNS = ("position_x", "position_y", "heading", "velocity_x", "velocity_y")
_OWN_NUMBER = re.compile(r"0|[1-9][0-9]{0,17}")
"""Track ids that are numbers of their own, within int64 and with room to count on."""


@dataclass(frozen=True)
class Tracks:
    """The tracks of the 91 steps, in order of their first row.

    Attributes:
        scenario_id: the recording's id.
        number: A ids.
        object_type: A types.
        category: ``[A]`` int64.
        states: ``[A, L, 5]`` float64, x, y, heading, velocity; 0 where invalid.
        valid: ``[A, L]`` bool.
        sdc: index of the ego car.
    """

    scenario_id: str
    number: list[int]
    object_type: list[str]
    category: np.ndarray
    states: np.ndarray
    valid: np.ndarray
    sdc: int


def read_tracks(columns: Mapping[str, Any], name: str) -> Tracks:
    """Check the columns and sort their rows into tracks and steps.

    Args:
        columns: by name, each an array or list with one value for each row.
        name: what errors call the file.

    Raises:
        SceneError: naming the column and row: missing, of the wrong type, not finite, a step out of range or twice for
            one track, a type that changes within a track, a log that stops early, no track :data:`SDC_TRACK`.
    """
    rows = _checked_columns(columns, name)
    _check_steps(rows["timestep"], name)
    index: dict[str, int] = {}
    owner = np.array([index.setdefault(track, len(index)) for track in rows["track_id"]])
    if len(index) > MOST_TRACKS:
        raise SceneError(f"{name}: column track_id has {len(index)} tracks; at most {MOST_TRACKS} are read.")
    _check_repeats(owner, rows, name)
    first = np.unique(owner, return_index=True)[1]
    for field in ("object_type", "object_category"):
        _check_constant(rows[field], rows[field][first][owner], field, name)
    _check_constant(rows["scenario_id"], np.full(len(owner), rows["scenario_id"][0], dtype=object), "scenario_id", name)

    inside = rows["timestep"] >= FIRST_STEP
    place = owner[inside], rows["timestep"][inside] - FIRST_STEP
    valid = np.zeros((len(index), LOG_STEPS), dtype=bool)
    valid[place] = True
    states = np.zeros((len(index), LOG_STEPS, len(NUMBER_COLUMNS)))
    states[place] = np.column_stack([rows[field][inside] for field in NUMBER_COLUMNS])
    kept = valid.any(1)
    names = [track for track, there in zip(index, kept, strict=True) if there]
    if SDC_TRACK not in names:
        raise SceneError(f"{name}: column track_id has no '{SDC_TRACK}' in the last {LOG_STEPS} steps; it is the SDC.")
    return Tracks(
        scenario_id=rows["scenario_id"][0],
        number=_numbers(names),
        object_type=rows["object_type"][first][kept].tolist(),
        category=rows["object_category"][first][kept],
        states=states[kept],
        valid=valid[kept],
        sdc=names.index(SDC_TRACK),
    )


def _checked_columns(columns: Mapping[str, Any], name: str) -> dict[str, np.ndarray]:
    checks = {
        **dict.fromkeys(TEXT_COLUMNS, _text),
        **dict.fromkeys(WHOLE_COLUMNS, _whole),
        **dict.fromkeys(NUMBER_COLUMNS, _finite),
    }
    rows = {}
    for field, check in checks.items():
        if field not in columns:
            raise SceneError(f"{name}: the column {field} is missing; it is no Argoverse 2 scenario.")
        rows[field] = check(columns[field], field, name)
    lengths = {field: len(values) for field, values in rows.items()}
    if len(set(lengths.values())) > 1 or not 0 < lengths["timestep"] <= MOST_ROWS:
        raise SceneError(f"{name}: the columns have {lengths} rows; each must have the same, from 1 to {MOST_ROWS}.")
    return rows


def _array(values: Any, field: str, name: str, dtype: type | None = None) -> np.ndarray:
    try:
        array = np.asarray(values, dtype=dtype)
    except (OverflowError, TypeError, ValueError):  # such as lists of unequal length
        array = np.array(None)
    if array.ndim != 1:
        raise SceneError(f"{name}: column {field} is {shown(values)}; must have one value in each row.")
    return array


def _text(values: Any, field: str, name: str) -> np.ndarray:
    array = _array(values, field, name, dtype=object)
    for row, value in enumerate(array):
        if not isinstance(value, str) or not value:
            raise SceneError(f"{name}: {field}[{row}] is {shown(value)}; must be text.")
    return array


def _whole(values: Any, field: str, name: str) -> np.ndarray:
    array = _array(values, field, name)
    if array.dtype.kind not in "iu":
        raise SceneError(f"{name}: column {field} holds {array.dtype}; must hold whole numbers in each row.")
    return array


def _finite(values: Any, field: str, name: str) -> np.ndarray:
    array = _array(values, field, name)
    if array.dtype.kind not in "iuf":
        raise SceneError(f"{name}: column {field} holds {array.dtype}; must hold numbers.")
    bad = ~(np.abs(array.astype(np.float64)) <= LARGEST_NUMBER)
    if bad.any():
        row = int(bad.argmax())
        raise SceneError(
            f"{name}: {field}[{row}] is {array[row]}; must be a finite number between -{LARGEST_NUMBER:g} and "
            f"{LARGEST_NUMBER:g}."
        )
    return array.astype(np.float64)


def _check_steps(steps: np.ndarray, name: str) -> None:
    outside = (steps < 0) | (steps >= SCENARIO_STEPS)
    if outside.any():
        row = int(outside.argmax())
        raise SceneError(f"{name}: timestep[{row}] is {steps[row]}; must be from 0 to {SCENARIO_STEPS - 1}.")
    if steps.max() != SCENARIO_STEPS - 1:
        raise SceneError(
            f"{name}: the last timestep is {steps.max()} where {SCENARIO_STEPS - 1} is needed. The test split holds "
            "only the 5 s of history: take the training or validation split."
        )


def _check_repeats(owner: np.ndarray, rows: dict[str, np.ndarray], name: str) -> None:
    place = owner * SCENARIO_STEPS + rows["timestep"].astype(np.int64)
    seen = np.zeros(len(place), dtype=bool)
    seen[np.unique(place, return_index=True)[1]] = True
    if not seen.all():
        row = int(seen.argmin())
        raise SceneError(
            f"{name}: row {row} repeats track_id {shown(rows['track_id'][row])} at timestep {rows['timestep'][row]}; "
            "a track must have one row for a step."
        )


def _check_constant(values: np.ndarray, expected: np.ndarray, field: str, name: str) -> None:
    other = values != expected
    if other.any():
        row = int(other.argmax())
        raise SceneError(
            f"{name}: {field}[{row}] is {shown(values.item(row))} where earlier rows have {shown(expected.item(row))}; "
            "it must stay the same."
        )


def _numbers(track_ids: list[str]) -> list[int]:
    """An int64 for each id.

    Examples:
        >>> _numbers(["AV", "17", "x", "4"])
        [18, 17, 19, 4]
    """
    own = {track: int(track) for track in track_ids if _OWN_NUMBER.fullmatch(track)}
    free = iter(range(max(own.values(), default=0) + 1, 2**63))
    return [own[track] if track in own else next(free) for track in track_ids]
