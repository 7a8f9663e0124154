"""Signed distances between oriented boxes of the plane, with rounded corners.

A *box* is ``(x, y, heading, length, width)``; the metric of the Waymo Open Sim Agents Challenge calls two road users in
collision where the distance between their boxes, with corners rounded, is negative (SPEC section 3.1).
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.geometry.frames import rotate

CORNER_ROUNDING = 0.7
"""Radius of a corner, as a part of half the shorter side (challenges of 2024 and 2025)."""
NOBODY = 1e10
"""Distance to the nearest box where there is none [m]."""

_CORNERS = ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))
_PAIRS_PER_CHUNK = 1 << 17
"""Pairs handled together: small enough for the working set to stay in a core's cache."""
_BOUND_MARGIN = 1e-3
"""Room for float32 rounding when a pair is ruled out by its circles [m]."""


def box_corners(box: Tensor) -> Tensor:
    """Corners of sharp boxes, counter-clockwise from the front left one.

    Args:
        box: ``[..., 5]``, x, y, heading, length, width.

    Returns:
        ``[..., 4, 2]``.

    Examples:
        >>> box_corners(torch.tensor([1.0, 0.0, 0.0, 4.0, 2.0]))[0]
        tensor([3., 1.])
    """
    unit = torch.tensor(_CORNERS, dtype=box.dtype, device=box.device)
    return box[..., None, :2] + rotate(unit * box[..., None, 3:5], box[..., None, 2])


def signed_box_distance(first: Tensor, second: Tensor, rounding: float = CORNER_ROUNDING) -> Tensor:
    """Gap between two boxes; where they overlap, minus the shortest move that parts them.

    Args:
        first: ``[..., 5]``, x, y, heading, length, width.
        second: ``[..., 5]``, broadcast against ``first``.
        rounding: 0 for sharp corners, 1 for capsules.

    Returns:
        ``[...]`` [m]; negative in a collision.

    Examples:
        >>> car = torch.tensor([0.0, 0.0, 0.0, 4.0, 2.0])
        >>> signed_box_distance(car, torch.tensor([7.0, 0.0, 0.0, 4.0, 2.0]))
        tensor(3.)
        >>> signed_box_distance(car, torch.tensor([0.0, 1.5, 0.0, 4.0, 2.0]))
        tensor(-0.5000)
    """
    radius_first, radius_second = _corner_radius(first, rounding), _corner_radius(second, rounding)
    core_first, core_second = _core_half(first, radius_first), _core_half(second, radius_second)
    offset = second[..., :2] - first[..., :2]
    seen_by_first = rotate(offset, -first[..., 2])
    seen_by_second = rotate(-offset, -second[..., 2])
    turn = second[..., 2] - first[..., 2]

    overlap = torch.maximum(
        _separation(seen_by_first, core_first, core_second, turn),
        _separation(seen_by_second, core_second, core_first, turn),
    )
    gap = torch.minimum(
        _corner_gap(seen_by_first, core_first, core_second, turn),
        _corner_gap(seen_by_second, core_second, core_first, -turn),
    )
    return torch.where(overlap <= 0, overlap, gap) - radius_first - radius_second


def nearest_box_distance(
    boxes: Tensor, valid: Tensor, ego: Tensor | None = None, rounding: float = CORNER_ROUNDING
) -> Tensor:
    """Signed distance from each ego box to the nearest other box of its scene.

    Exact, yet nearly all pairs are only looked at through their circles: a pair can be the nearest one only if its
    circumscribed circles come closer than the inscribed circles of every other pair do.

    Args:
        boxes: ``[..., A, 5]``, x, y, heading, length, width.
        valid: ``[..., A]`` bool.
        ego: ``[E]`` int64, indices into A of the boxes to measure from; all of them by default.
        rounding: of the corners, see :func:`signed_box_distance`.

    Returns:
        ``[..., E]`` [m]; :data:`NOBODY` where the ego is not valid or alone.

    Examples:
        >>> boxes = torch.tensor([[0.0, 0, 0, 4, 2], [7.0, 0, 0, 4, 2], [0.0, 9, 0, 4, 2]])
        >>> nearest_box_distance(boxes, torch.tensor([True, True, True]))
        tensor([3., 3., 7.])
    """
    num_agents = boxes.shape[-2]
    if valid.shape != boxes.shape[:-1]:
        raise ValueError(
            f"valid must have shape {tuple(boxes.shape[:-1])} (boxes without the last dim), got {tuple(valid.shape)}."
        )
    ego = torch.arange(num_agents, device=boxes.device) if ego is None else ego
    flat, flat_valid = boxes.reshape(-1, num_agents, 5), valid.reshape(-1, num_agents)
    rows = max(1, _PAIRS_PER_CHUNK // max(1, num_agents * len(ego)))
    nearest = [
        _nearest_of_chunk(part, part_valid, ego, rounding)
        for part, part_valid in zip(flat.split(rows), flat_valid.split(rows), strict=True)
    ]
    return torch.cat(nearest).reshape(*boxes.shape[:-2], len(ego))


def _nearest_of_chunk(boxes: Tensor, valid: Tensor, ego: Tensor, rounding: float) -> Tensor:
    """:func:`nearest_box_distance` of ``[M, A, 5]`` boxes -> ``[M, E]``."""
    num_scenes, num_agents = valid.shape
    x, y = boxes[..., 0], boxes[..., 1].masked_fill(~valid, NOBODY)
    dx = x[:, ego, None] - x[:, None, :]
    dy = boxes[:, ego, None, 1] - y[:, None, :]
    centre = dx.square_().addcmul_(dy, dy).sqrt_()
    centre[:, torch.arange(len(ego)), ego] = NOBODY

    inner = boxes[..., 3:5].amin(-1) / 2
    corner = _corner_radius(boxes, rounding)
    outer = _core_half(boxes, corner).norm(dim=-1) + corner
    upper = (centre - inner[:, None, :]).amin(-1) - inner[:, ego]
    reach = upper + outer[:, ego] + _BOUND_MARGIN
    # an ego that is not there has no candidate at all
    reach = torch.where(valid[:, ego], reach.clamp(max=NOBODY / 10), -torch.inf)
    candidate = centre.sub_(outer[:, None, :]) <= reach[..., None]

    pair = candidate.flatten().nonzero()[:, 0]
    ego_row = pair // num_agents
    scene, other = ego_row // len(ego), pair % num_agents
    all_boxes = boxes.reshape(-1, 5)
    first = all_boxes[scene * num_agents + ego[ego_row % len(ego)]]
    second = all_boxes[scene * num_agents + other]
    nearest = boxes.new_full((num_scenes * len(ego),), NOBODY)
    nearest.scatter_reduce_(0, ego_row, signed_box_distance(first, second, rounding), "amin")
    return nearest.view(num_scenes, len(ego))


def _corner_radius(box: Tensor, rounding: float) -> Tensor:
    return torch.minimum(box[..., 3], box[..., 4]) * (rounding / 2)


def _core_half(box: Tensor, radius: Tensor) -> Tensor:
    """Half sides ``[..., 2]`` of a box without its rounded rim."""
    return box[..., 3:5] / 2 - radius[..., None]


def _separation(offset: Tensor, own: Tensor, other: Tensor, turn: Tensor) -> Tensor:
    """Widest gap between two rectangles along the axes of the first; negative where both axes overlap.

    Args:
        offset: ``[..., 2]``, centre of the second in the frame of the first.
        own: ``[..., 2]``, half sides of the first.
        other: ``[..., 2]``, half sides of the second.
        turn: ``[...]``, angle between them.
    """
    cos, sin = turn.cos().abs(), turn.sin().abs()
    along = offset[..., 0].abs() - own[..., 0] - (other[..., 0] * cos + other[..., 1] * sin)
    across = offset[..., 1].abs() - own[..., 1] - (other[..., 0] * sin + other[..., 1] * cos)
    return torch.maximum(along, across)


def _corner_gap(offset: Tensor, own: Tensor, other: Tensor, turn: Tensor) -> Tensor:
    """Distance from the first rectangle to the nearest corner of the second (arguments of :func:`_separation`).

    Two rectangles that do not overlap are nearest at a corner of one of them.
    """
    cos, sin = turn.cos(), turn.sin()
    length, width = torch.stack((cos, sin), -1) * other[..., :1], torch.stack((-sin, cos), -1) * other[..., 1:]
    gap = None
    for front, left in _CORNERS:
        corner = offset + 2 * front * length + 2 * left * width
        distance = (corner.abs() - own).clamp(min=0).norm(dim=-1)
        gap = distance if gap is None else torch.minimum(gap, distance)
    return gap
