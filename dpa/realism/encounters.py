"""How evaluated agents met whom they collided with first: a collision in sum says nothing of its cause."""

from __future__ import annotations

import math
from enum import IntEnum

import torch
from torch import Tensor

from dpa.realism.config import RealismConfig
from dpa.realism.features import Features
from dpa.realism.likelihood import happened
from dpa.realism.tracks import Tracks
from envs.geometry.boxes import signed_box_distance
from envs.geometry.frames import rotate, wrap_angle

ALIGNED = math.pi / 4
"""Two agents head the same way up to this angle, and opposite ways from its supplement on [rad]."""


class Encounter(IntEnum):
    """With whom an agent collides, as seen from it.

    Attributes:
        NONE: with nobody.
        BESIDE: somebody headed the same way, who is more beside it than ahead or behind.
        IN_LINE: somebody headed the same way, ahead or behind.
        CROSSING: somebody headed across.
        ONCOMING: somebody headed the other way.
    """

    NONE = 0
    BESIDE = 1
    IN_LINE = 2
    CROSSING = 3
    ONCOMING = 4


def encounters(tracks: Tracks, measured: Features, config: RealismConfig) -> Tensor:
    """How each evaluated agent met the one that it overlaps most at its first collision.

    Args:
        tracks: of one scene, from :func:`~dpa.realism.tracks.compare`.
        measured: of the same scene, from :func:`~dpa.realism.features.measure`.
        config: as of both; collisions are those that its collision rate counts.

    Returns:
        ``[C, E]`` int64 of :class:`Encounter`, the log first.

    Examples:
        >>> from dpa.realism.features import measure
        >>> from dpa.realism.tracks import compare
        >>> from envs.sources.synthetic import straight_road
        >>> scene, config = straight_road(num_vehicles=2), RealismConfig.load("2024")
        >>> comparison = compare(scene, torch.zeros(4, 2, 80, 4), config)  # both on one spot
        >>> found = encounters(comparison.tracks, measure([comparison], config)[0], config)
        >>> found[0].tolist(), found[1].tolist()
        ([0, 0], [1, 1])
    """
    hit = happened(measured, "collision_per_step", config)
    row, ego = hit.any(-1).nonzero(as_tuple=True)
    step = hit[row, ego].int().argmax(-1)
    boxes, there = tracks.boxes[row, step], tracks.valid[:, :, tracks.scored][row, :, step]  # [N, A, 5] and [N, A]
    each = torch.arange(len(row), device=row.device)
    own = boxes[each, ego]
    there[each, ego] = False
    apart = signed_box_distance(own[:, None], boxes, config.corner_rounding)
    other = boxes[each, apart.where(there, torch.inf).argmin(-1)]
    found = torch.zeros_like(hit[..., 0], dtype=torch.int64)
    found[row, ego] = encounter_of(own, other)
    return found


def encounter_of(own: Tensor, other: Tensor) -> Tensor:
    """How boxes that overlap have met.

    Two that head the same way are beside each other where a shorter move to the side parts them than one along.

    Args:
        own: ``[N, 5]``, x, y, heading, length, width.
        other: ``[N, 5]``.

    Returns:
        ``[N]`` int64 of :class:`Encounter`.

    Examples:
        >>> car = torch.tensor([[0.0, 0.0, 0.0, 4.0, 2.0]])
        >>> [encounter_of(car, torch.tensor([other])).item() for other in ([0.5, 1.9, 0, 4, 2], [3.9, 0.2, 0, 4, 2])]
        [1, 2]
    """
    turn = wrap_angle(other[:, 2] - own[:, 2]).abs()
    offset = rotate(other[:, :2] - own[:, :2], -own[:, 2]).abs()
    along, aside = ((own[:, 3:] + other[:, 3:]) / 2 - offset).unbind(-1)
    same = torch.where(aside < along, Encounter.BESIDE, Encounter.IN_LINE)
    across = torch.where(turn > math.pi - ALIGNED, Encounter.ONCOMING, Encounter.CROSSING)
    return torch.where(turn < ALIGNED, same, across)
