"""Signed distance from points and boxes to the road edges of a map.

Distances follow the off-road measure of the Waymo Open Sim Agents Challenge (SPEC section 4.1): the nearest segment is
chosen with height stretched by three, so that an edge on a bridge does not rule the road beneath it; what is reported
is the distance in the plane, positive on the right of the edge, which is off the road.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from envs.geometry.boxes import box_corners
from envs.geometry.ragged import Ragged

HEIGHT_STRETCH = 3.0
"""How much a metre of height counts when the nearest edge is chosen."""
CYCLE_GAP = 1.0
"""A polyline whose ends are nearer than this is a ring [m]."""

_CELL_SIZES = (32.0, 8.0, 1.0)
"""Sides of the cells in which queries share their candidate segments, from coarse to fine [m]."""
_MARGIN = 1e-6
"""Room for float32 rounding when a segment is ruled out for a cell, as a part of the largest coordinate."""
_NO_SEGMENT = -1


@dataclass(frozen=True)
class RoadEdges:
    """Road edges as one flat row of W segments, in map order.

    Attributes:
        start: ``[W, 3]``, first point of each segment [m].
        delta: ``[W, 3]``, from its first to its second point [m].
        previous: ``[W]`` int64, the segment that ends where this one starts; -1 where there is none.
        following: ``[W]`` int64, the segment that starts where this one ends; -1 where there is none.
        line: ``[W]`` int64, the polyline of each segment.
        height_stretch: how much a metre of height counts when the nearest segment is chosen; 0 is a flat world.
        points_at_zero: a polyline whose nearest segment has no length is at distance 0, however far (code of 2023).

    Examples:
        >>> edges = RoadEdges.from_polylines([torch.tensor([[0.0, 0, 0], [10, 0, 0], [10, 10, 0]])])
        >>> edges.signed_distance(torch.tensor([[5.0, 2, 0], [5.0, -2, 0], [13.0, 5, 0]]))
        tensor([-2.,  2.,  3.])
    """

    start: Tensor
    delta: Tensor
    previous: Tensor
    following: Tensor
    line: Tensor
    height_stretch: float = HEIGHT_STRETCH
    points_at_zero: bool = False

    @classmethod
    def from_polylines(
        cls,
        lines: Sequence[Tensor],
        *,
        every_ring: bool = False,
        height_stretch: float = HEIGHT_STRETCH,
        points_at_zero: bool = False,
    ) -> RoadEdges:
        """Flatten polylines; those of fewer than two points have no segment and are left out.

        Args:
            lines: each ``[n, 3]``, the drivable side on the left, as :func:`envs.scene.polylines` gives them.
            every_ring: close every ring. By default one is closed only if no polyline of the map has more points: the
                official code pads polylines to the longest one, and its wrap-around meets the padding of all others.
            height_stretch: see the class.
            points_at_zero: see the class.

        Raises:
            ValueError: no polyline has two points.
        """
        lines = [line for line in lines if len(line) >= 2]
        if not lines:
            raise ValueError(
                "no road edge has two points or more, so no distance to the road edge is defined; add one."
            )
        longest = max(map(len, lines))
        previous, following = [], []
        first = 0
        for line in lines:
            last = first + len(line) - 2
            before, after = torch.arange(first - 1, last), torch.arange(first + 1, last + 2)
            ring = (every_ring or len(line) == longest) and float((line[0] - line[-1]).square().sum()) < CYCLE_GAP**2
            before[0], after[-1] = (last, first) if ring else (_NO_SEGMENT, _NO_SEGMENT)
            previous.append(before)
            following.append(after)
            first = last + 1
        device = lines[0].device
        return cls(
            start=torch.cat([line[:-1] for line in lines]),
            delta=torch.cat([line[1:] - line[:-1] for line in lines]),
            previous=torch.cat(previous).to(device),
            following=torch.cat(following).to(device),
            line=torch.arange(len(lines)).repeat_interleave(torch.tensor([len(line) - 1 for line in lines])).to(device),
            height_stretch=height_stretch,
            points_at_zero=points_at_zero,
        )

    def signed_distance(self, points: Tensor) -> Tensor:
        """Distance in the plane to the nearest edge: negative on the road, positive off it.

        Args:
            points: ``[..., 3]`` [m].

        Returns:
            ``[...]`` [m].

        Raises:
            ValueError: a coordinate is not finite.
        """
        flat = points.reshape(-1, 3)
        if not torch.isfinite(flat).all():
            bad = flat[~torch.isfinite(flat).all(-1)][0].tolist()
            raise ValueError(f"the distance to the road edge needs finite points, got {bad}; mask such points out.")
        segment = self._nearest_segment(flat)
        _, residual = self._project(flat, segment)
        distance = residual[0].square().add_(residual[1].square()).sqrt_()
        signed = self._side(flat, segment) * distance
        if self.points_at_zero:
            signed = torch.where(self._beside_a_point(flat), 0, signed)
        return signed.view(points.shape[:-1])

    def box_offroad_distance(self, position: Tensor, heading: Tensor, extent: Tensor) -> Tensor:
        """Signed distance of the bottom corner that is farthest off the road.

        Args:
            position: ``[..., 3]``, centres of the boxes [m].
            heading: ``[...]`` [rad].
            extent: ``[..., 3]``, length, width, height, broadcast against ``position`` [m].

        Returns:
            ``[...]`` [m]; positive where some corner is off the road.

        Examples:
            >>> edges = RoadEdges.from_polylines([torch.tensor([[-50.0, 0, 0], [50, 0, 0]])])
            >>> centre, extent = torch.tensor([0.0, 0.5, 0.8]), torch.tensor([4.6, 2.0, 1.6])
            >>> edges.box_offroad_distance(centre, torch.tensor(0.0), extent)
            tensor(0.5000)
        """
        extent = extent.expand(position.shape)
        corners = box_corners(torch.cat((position[..., :2], heading[..., None], extent[..., :2]), -1))
        bottom = (position[..., 2] - extent[..., 2] / 2)[..., None].expand(corners.shape[:-1])
        return self.signed_distance(torch.cat((corners, bottom[..., None]), -1)).amax(-1)

    def _project(self, points: Tensor, segment: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor]]:
        """Where points fall along segments, and what is left between.

        Args:
            points: ``[n, 3]``.
            segment: ``[n]`` or ``[n, W']`` int64.

        Returns:
            ``t`` of the shape of ``segment``, 0 at the start and 1 at the end, from the plane and not clipped; and the
            three coordinates of the vector from the closest point of the segment.
        """
        columns = points.T if segment.ndim == 1 else points.T[..., None]
        dx, dy, dz = (column[segment] for column in self.delta.T.contiguous())
        x, y, z = (q - a[segment] for q, a in zip(columns, self.start.T.contiguous(), strict=True))
        squared = dx * dx + dy * dy
        t = torch.where(squared > 0, (x * dx + y * dy) / squared, 0)
        clipped = t.clamp(0, 1)
        return t, (x - clipped * dx, y - clipped * dy, z - clipped * dz)

    def _stretched_distance(self, points: Tensor, segment: Tensor) -> Tensor:
        """Distance that chooses the nearest segment: ``[n, 3]``, ``[n, W']`` -> ``[n, W']``."""
        _, (x, y, z) = self._project(points, segment)
        z = self.height_stretch * z
        # Segments of one map often tie but for the last bit. The float32 square root of torch is not rounded
        # correctly, which breaks such ties at random; by way of float64 it is.
        return (x * x + y * y + z * z).double().sqrt_().float()

    def _side(self, points: Tensor, segment: Tensor) -> Tensor:
        """+1 right of the edge, -1 left: ``[n, 3]``, ``[n]`` -> ``[n]``.

        Beyond an end of the segment the neighbour has a say: the corner of a convex bend is right of the edge if the
        point is right of either segment, that of a concave bend only if it is right of both.
        """
        t, _ = self._project(points, segment)
        own = self._own_side(points, segment)

        def with_neighbour(neighbour: Tensor, first: Tensor, second: Tensor) -> Tensor:
            side = self._own_side(points, neighbour)
            convex = _cross(self.delta[first], self.delta[second]) > 0
            return torch.where(convex, torch.maximum(own, side), torch.minimum(own, side))

        previous, following = self.previous[segment], self.following[segment]
        before = (t < 0) & (previous != _NO_SEGMENT)
        after = (t > 1) & (following != _NO_SEGMENT)
        side = torch.where(before, with_neighbour(previous, previous, segment), own)
        return torch.where(after, with_neighbour(following, segment, following), side)

    def _beside_a_point(self, points: Tensor) -> Tensor:
        """Queries whose nearest segment of some polyline has no length, and so no side: ``[n, 3]`` -> ``[n]``."""
        hit = torch.zeros(len(points), dtype=torch.bool, device=points.device)
        degenerate = (self.delta[:, :2] == 0).all(-1)
        for line in self.line[degenerate].unique():
            own = (self.line == line).nonzero()[:, 0]
            nearest = self._stretched_distance(points, own.expand(len(points), -1)).argmin(1)
            hit |= degenerate[own[nearest]]
        return hit

    def _own_side(self, points: Tensor, segment: Tensor) -> Tensor:
        return torch.sign(_cross(points - self.start[segment], self.delta[segment]))

    def _nearest_segment(self, points: Tensor) -> Tensor:
        """Index of the nearest segment, the first in map order on ties: ``[n, 3]`` -> ``[n]``.

        Queries are gathered in boxes, from coarse to fine. Each box inherits the candidates of the coarser box around
        it and keeps those segments that can still be the nearest one of some point inside.
        """
        if not len(points):
            return torch.empty(0, dtype=torch.int64, device=points.device)
        levels, leaf = _nested_boxes(points)
        every = torch.arange(len(self.start), device=points.device)
        candidates = Ragged.from_parts(1, [(every[:1], every[-1:] + 1, every)])
        for level in levels:
            candidates = self._narrow(candidates, level)
        nearest = torch.empty_like(leaf)
        for row, table, _ in candidates.tables(leaf):
            best = self._stretched_distance(points[row], table).argmin(1, keepdim=True)
            nearest[row] = table.gather(1, best)[:, 0]
        return nearest

    def _narrow(self, candidates: Ragged, boxes: _Boxes) -> Ragged:
        """Candidates of each box among those of the coarser box around it.

        A segment stays if its least distance inside the box is within the greatest one of every other segment. Inside
        the box a query moves by at most ``radius`` in the plane and ``half_z`` in height. The distance in the plane
        changes by no more than the radius, the height above the segment by no more than ``half_z`` and the rise of the
        segment under a point that moves by the radius.
        """
        radius, half_z = boxes.half[:, :2].norm(dim=-1), boxes.half[:, 2]
        length = self.delta[:, :2].norm(dim=-1)
        slope = torch.where(length > 0, self.delta[:, 2].abs() / length, 0)
        margin = _MARGIN * (1 + max(boxes.centre.abs().max(), self.start.abs().max()))
        parts = []
        for row, table, real in candidates.tables(boxes.parent):
            distance = self._stretched_distance(boxes.centre[row], table)
            rise = torch.minimum(slope[table] * radius[row, None], self.delta[:, 2].abs()[table])
            slack = torch.hypot(radius[row, None], self.height_stretch * (half_z[row, None] + rise))
            reach = (distance + slack).amin(1, keepdim=True) * (1 + _MARGIN) + margin
            keep = real & (distance - slack <= reach)
            parts.append((row, keep.sum(1), table[keep]))
        return Ragged.from_parts(len(boxes.parent), parts)


@dataclass(frozen=True)
class _Boxes:
    """One level of nested boxes of query points.

    Attributes:
        centre: ``[m, 3]`` [m].
        half: ``[m, 3]``, half sides, no larger than the points inside need [m].
        parent: ``[m]`` int64, the box of the coarser level around each.
    """

    centre: Tensor
    half: Tensor
    parent: Tensor


def _nested_boxes(points: Tensor) -> tuple[list[_Boxes], Tensor]:
    """Gather ``[n, 3]`` points in boxes; the levels from coarse to fine, and the finest box ``[n]`` of each point."""
    low = high = points
    inner_to_outer: list[Tensor] = []
    sides: list[tuple[Tensor, Tensor]] = []
    for size in reversed(_CELL_SIZES):
        cell, owner = torch.unique(_cell_key(low, size), return_inverse=True)
        index = owner[:, None].expand(-1, 3)
        box = low.new_empty(len(cell), 3)
        low = box.scatter_reduce(0, index, low, "amin", include_self=False)
        high = box.scatter_reduce(0, index, high, "amax", include_self=False)
        inner_to_outer.append(owner)
        sides.append((low, high))
    leaf, *parents = inner_to_outer
    parents.append(torch.zeros(len(low), dtype=torch.int64, device=points.device))
    levels = [
        _Boxes((low + high) / 2, (high - low) / 2, parent) for (low, high), parent in zip(sides, parents, strict=True)
    ]
    return levels[::-1], leaf


def _cell_key(points: Tensor, size: float) -> Tensor:
    """One int64 for the cell of each point, ``[n, 3]`` -> ``[n]``; far cells share a key, which costs only time."""
    sides = torch.tensor([size, size, size / (2 * HEIGHT_STRETCH)], device=points.device)
    limit = 1 << 20
    x, y, z = (points / sides).floor().clamp(-limit, limit - 1).long().add_(limit).unbind(-1)
    return (x * 2 * limit + y) * 2 * limit + z


def _cross(first: Tensor, second: Tensor) -> Tensor:
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
