"""Numbers of a page as short text: whole centimetres, each against what the two before it lead one to expect.

A number takes one letter for each five bits, least first, its sign in the lowest bit of all; a letter of the second
half of the alphabet is followed by more. This is how source maps of browsers write numbers.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

CENTIMETRE = 0.01
"""Unit of packed positions [m] and headings [rad]."""
ALPHABET = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
_BITS, _MORE = 5, 32


def pack_numbers(numbers: Iterable[int]) -> str:
    """Whole numbers as text; zeros at the end are left out.

    Examples:
        >>> pack_numbers([0, 1, -1, 15, -16, 1000, 0, 0])
        'ACDehBw+B'
    """
    letters: list[str] = []
    length = 0
    for number in numbers:
        rest = 2 * number if number >= 0 else 1 - 2 * number
        while rest >= _MORE:
            letters.append(ALPHABET[rest % _MORE + _MORE])
            rest >>= _BITS
        letters.append(ALPHABET[rest])
        length = len(letters) if number else length
    return "".join(letters[:length])


def pack_tracks(poses: Tensor) -> list[str]:
    """Pack poses ``[A, T, 3]`` (NaN where absent), one text for each agent.

    The numbers are the count of runs of steps at which the agent is there, first step and length of each run, and then
    x, y, heading of these steps: the first pose, the step to the second one, and from there by how much each step
    differs from the step before. Differences are taken after rounding, so adding them up gives every rounded pose.

    Examples:
        >>> import torch
        >>> pack_tracks(torch.tensor([[[1.0, 2.0, 0.5], [1.5, 2.0, 0.5], [torch.nan] * 3, [2.0, 2.0, 0.5]]]))
        ['EAEGCoGwMkDkD']
    """
    packed = []
    for agent in poses.numpy():
        there = np.isfinite(agent).all(-1)
        change = np.diff(whole(agent[there]), axis=0, prepend=np.zeros((1, 3), dtype=np.int64))
        change[2:] -= change[1:-1].copy()
        runs = run_lengths(there)
        packed.append(pack_numbers([len(runs) // 2, *runs, *change.ravel().tolist()]))
    return packed


def run_lengths(flags: NDArray[np.bool_]) -> list[int]:
    """Runs of steps at which a flag is set: first step and length of each.

    Examples:
        >>> run_lengths(np.array([False, True, True, False, True]))
        [1, 2, 4, 1]
    """
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return [number for first, end in edges.reshape(-1, 2).tolist() for number in (first, end - first)]


def pack_line(line: NDArray[np.float32]) -> str:
    """Points ``[n, 2]`` of a polyline, each against the one before."""
    return pack_numbers(np.diff(whole(line), axis=0, prepend=np.zeros((1, 2), dtype=np.int64)).ravel().tolist())


def simplified(line: NDArray[np.float32], tolerance: float) -> NDArray[np.bool_]:
    """Which points of a polyline to keep so that it moves by no more than a tolerance (Ramer, Douglas and Peucker).

    Args:
        line: ``[n, 2]``.
        tolerance: [m].

    Returns:
        ``[n]`` bool; the ends are kept.

    Examples:
        >>> simplified(np.array([[0.0, 0.0], [1.0, 0.01], [2.0, 0.0], [2.0, 5.0]]), 0.1).tolist()
        [True, False, True, True]
    """
    keep = np.zeros(len(line), dtype=bool)
    keep[[0, -1]] = True
    pieces = [(0, len(line) - 1)]
    while pieces:
        first, last = pieces.pop()
        if last - first < 2:
            continue
        chord, inner = line[last] - line[first], line[first + 1 : last] - line[first]
        # The distance is to the chord, not to its line: a track that doubles back would else lose its turning point.
        along = np.clip(inner @ chord / max(float(chord @ chord), 1e-12), 0, 1)
        away = np.linalg.norm(inner - along[:, None] * chord, axis=1)
        worst = int(away.argmax())
        if away[worst] > tolerance:
            middle = first + 1 + worst
            keep[middle] = True
            pieces += [(first, middle), (middle, last)]
    return keep


def whole(values: NDArray[np.floating]) -> NDArray[np.int64]:
    """Values [m or rad] in whole hundredths."""
    return np.rint(np.asarray(values, dtype=np.float64) / CENTIMETRE).astype(np.int64)
