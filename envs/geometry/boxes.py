"""Signed distances between oriented boxes of the plane, with rounded corners.

A *box* is ``(x, y, heading, length, width)``; the metric of the Waymo Open Sim Agents Challenge calls two road users in
collision where the distance between their boxes, with corners rounded, is negative (realism.md section 3.1).
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.devices import on_host
from envs.geometry.frames import rotate

CORNER_ROUNDING = 0.7
"""Radius of a corner, as a part of half the shorter side (challenges of 2024 and 2025)."""
NOBODY = 1e10
"""Distance to the nearest box where there is none [m]."""

_CORNERS = ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))
_CIRCLES_PER_CHUNK = 1 << 17
"""Pairs of circles compared together: small enough for the working set to stay in a core's cache."""
_BOXES_PER_CHUNK = 1 << 14
"""Pairs of boxes measured together, for the same reason."""
_PAIRS_ON_DEVICE = 1 << 22
"""Pairs of boxes measured together on a device: some hundred MB."""
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
    front, left = (box[..., 3:5] / 2).unbind(-1)
    corners = torch.stack(
        (torch.stack((front, -front, -front, front), -1), torch.stack((left, left, -left, -left), -1)), -1
    )
    return box[..., None, :2] + rotate(corners, box[..., None, 2])


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
    cos, sin = turn.cos(), turn.sin()

    overlap = torch.maximum(
        _separation(seen_by_first, core_first, core_second, cos, sin),
        _separation(seen_by_second, core_second, core_first, cos, sin),
    )
    gap = torch.minimum(
        _corner_gap(seen_by_first, core_first, core_second, cos, sin),
        _corner_gap(seen_by_second, core_second, core_first, cos, -sin),
    )
    return torch.where(overlap <= 0, overlap, gap) - radius_first - radius_second


def nearest_box_distance(
    boxes: Tensor, valid: Tensor, ego: Tensor | None = None, rounding: float = CORNER_ROUNDING
) -> Tensor:
    """Signed distance from each ego box to the nearest other box of its scene.

    Exact, yet nearly all pairs are only looked at through their circles: a pair can be the nearest one only if its
    circumscribed circles come closer than the inscribed circles of every other pair do. A device measures all
    pairs, for it would have to be waited for to hear which ones are left.

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
    if not on_host(boxes):
        return _of_all_pairs(flat, flat_valid, ego, rounding).view(*boxes.shape[:-2], len(ego))
    ego_row, other = _candidates(flat, flat_valid, ego, rounding)
    flat = flat.reshape(-1, 5)
    nearest = boxes.new_full((len(flat_valid) * len(ego),), NOBODY)
    for row, second in zip(ego_row.split(_BOXES_PER_CHUNK), other.split(_BOXES_PER_CHUNK), strict=True):
        first = row // len(ego) * num_agents + ego[row % len(ego)]
        distance = signed_box_distance(flat.index_select(0, first), flat.index_select(0, second), rounding)
        nearest.scatter_reduce_(0, row, distance, "amin")
    return nearest.view(*boxes.shape[:-2], len(ego))


def _of_all_pairs(boxes: Tensor, valid: Tensor, ego: Tensor, rounding: float) -> Tensor:
    """Distance to the nearest other box, ``[M, A, 5]`` boxes -> ``[M, E]``, from every pair."""
    itself = ego[:, None] == torch.arange(boxes.shape[1], device=ego.device)
    rows = max(1, _PAIRS_ON_DEVICE // max(1, itself.numel()))
    nearest = [boxes.new_empty(0, len(ego))]
    for some, there in zip(boxes.split(rows), valid.split(rows), strict=True):
        apart = signed_box_distance(some[:, ego, None], some[:, None], rounding)
        pair = there[:, ego, None] & there[:, None] & ~itself
        nearest.append(torch.where(pair, apart, NOBODY).amin(-1))
    return torch.cat(nearest)


def _candidates(boxes: Tensor, valid: Tensor, ego: Tensor, rounding: float) -> tuple[Tensor, Tensor]:
    """Pairs that can be nearest, of ``[M, A, 5]`` boxes: rows of ``[M * E]`` egos, rows of ``[M * A]`` boxes."""
    inner = boxes[..., 3:5].amin(-1) / 2
    corner = _corner_radius(boxes, rounding)
    circles = torch.stack((boxes[..., 0], boxes[..., 1], inner, _core_half(boxes, corner).norm(dim=-1) + corner))
    circles = circles.flatten(1)
    # Who is not there costs nothing: those who are come first, and scenes with as many of them go together.
    there, ego_there = (mask.byte().argsort(dim=-1, descending=True, stable=True) for mask in (valid, valid[:, ego]))
    count, ego_count = valid.sum(-1), valid[:, ego].sum(-1)
    place = torch.empty_like(there).scatter_(1, there, torch.arange(valid.shape[1], device=ego.device).expand_as(there))
    scenes = count.argsort(descending=True, stable=True)
    found = [(scenes[:0], scenes[:0])]
    while len(scenes) and (width := int(count[scenes[0]])):
        rows = max(1, _CIRCLES_PER_CHUNK // (width * max(1, len(ego))))
        scene, scenes = scenes[:rows], scenes[rows:]
        column = ego_there[scene, : int(ego_count[scene].max())]
        first, second = (scene[:, None] * valid.shape[1] + one for one in (ego[column], there[scene, :width]))
        near = _near_circles(
            *(circles.index_select(1, row.flatten()).view(4, *row.shape) for row in (first, second)),
            *(valid.flatten()[row] for row in (first, second)),
            place.flatten()[first].clamp(max=width - 1),
        )
        pair = near.flatten().nonzero()[:, 0]
        ego_row, row = (scene[:, None] * len(ego) + column).flatten()[pair // width], pair // (width * column.shape[1])
        found.append((ego_row, second.flatten()[row * width + pair % width]))
    ego_row, other = (torch.cat(part) for part in zip(*found, strict=True))
    return ego_row, other


def _near_circles(first: Tensor, second: Tensor, first_there: Tensor, second_there: Tensor, itself: Tensor) -> Tensor:
    """Which of some boxes can be the nearest one.

    Args:
        first: ``[4, m, e]``, x, y, radius of the inscribed circle, radius of the circumscribed one.
        second: ``[4, m, a]``.
        first_there: ``[m, e]`` bool.
        second_there: ``[m, a]`` bool.
        itself: ``[m, e]`` int64, where the first is found among the second.

    Returns:
        ``[m, e, a]`` bool.
    """
    x, y, inner, outer = second[:, :, None]
    dx = first[0, ..., None] - x
    dy = first[1, ..., None] - y.masked_fill(~second_there[:, None], NOBODY)
    centre = dx.square_().addcmul_(dy, dy).sqrt_().scatter_(2, itself[..., None], NOBODY)
    upper = (centre - inner).amin(-1) - first[2]
    reach = upper + first[3] + _BOUND_MARGIN
    # an ego that is not there has no candidate at all
    reach = torch.where(first_there, reach.clamp(max=NOBODY / 10), -torch.inf)
    return centre.sub_(outer) <= reach[..., None]


def _corner_radius(box: Tensor, rounding: float) -> Tensor:
    return torch.minimum(box[..., 3], box[..., 4]) * (rounding / 2)


def _core_half(box: Tensor, radius: Tensor) -> Tensor:
    """Half sides ``[..., 2]`` of a box without its rounded rim."""
    return box[..., 3:5] / 2 - radius[..., None]


def _separation(offset: Tensor, own: Tensor, other: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Widest gap between two rectangles along the axes of the first; negative where both axes overlap.

    Args:
        offset: ``[..., 2]``, centre of the second in the frame of the first.
        own: ``[..., 2]``, half sides of the first.
        other: ``[..., 2]``, half sides of the second.
        cos: ``[...]``, of the angle from the first to the second.
        sin: ``[...]``, of the same.
    """
    cos, sin = cos.abs(), sin.abs()
    along = offset[..., 0].abs() - own[..., 0] - (other[..., 0] * cos + other[..., 1] * sin)
    across = offset[..., 1].abs() - own[..., 1] - (other[..., 0] * sin + other[..., 1] * cos)
    return torch.maximum(along, across)


def _corner_gap(offset: Tensor, own: Tensor, other: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Distance from the first rectangle to the nearest corner of the second (arguments of :func:`_separation`).

    Two rectangles that do not overlap are nearest at a corner of one of them.
    """
    length, width = torch.stack((cos, sin), -1) * other[..., :1], torch.stack((-sin, cos), -1) * other[..., 1:]
    gap = None
    for front, left in _CORNERS:
        corner = offset + 2 * front * length + 2 * left * width
        distance = (corner.abs() - own).clamp(min=0).norm(dim=-1)
        gap = distance if gap is None else torch.minimum(gap, distance)
    return gap
