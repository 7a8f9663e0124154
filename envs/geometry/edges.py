"""Signed distance from points and boxes to the road edges of a map.

Distances follow the off-road measure of the Waymo Open Sim Agents Challenge (realism.md 4.1): the nearest segment is
chosen with height stretched by three, so that an edge on a bridge does not rule the road beneath it; what is reported
is the distance in the plane, positive on the right of the edge, which is off the road.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from envs.devices import on_host, require
from envs.geometry.boxes import box_corners
from envs.geometry.cells import Boxes, nested_boxes
from envs.geometry.ragged import Ragged

HEIGHT_STRETCH = 3.0
"""How much a metre of height counts when the nearest edge is chosen."""
CYCLE_GAP = 1.0
"""A polyline whose ends are nearer than this is a ring [m]."""

_MARGIN = 1e-6
"""Room for float32 rounding when a segment is ruled out for a cell, as a part of the largest coordinate."""
_TINY = torch.finfo(torch.float32).tiny
_NO_SEGMENT = -1
_PAIRS_ON_DEVICE = 1 << 25
"""Pairs of a query and a segment that are looked at together on a device, a dozen numbers each."""


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
        gaps = torch.stack([line[0] - line[-1] for line in lines]).cpu()
        for line, gap in zip(lines, gaps, strict=True):
            last = first + len(line) - 2
            before, after = torch.arange(first - 1, last), torch.arange(first + 1, last + 2)
            ring = (every_ring or len(line) == longest) and float(gap.square().sum()) < CYCLE_GAP**2
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

    def to(self, device: torch.device | str) -> RoadEdges:
        """The same on a device."""
        return replace(
            self,
            **{name: getattr(self, name).to(device) for name in ("start", "delta", "previous", "following", "line")},
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
        flat = _finite_columns(points)
        segment = self._nearest_segment(flat)
        projection = self._project(flat, segment)
        distance = projection.x.square().add_(projection.y.square()).sqrt_()
        signed = self._side(flat, segment, projection).mul_(distance)
        if self.points_at_zero:
            signed = torch.where(self._beside_a_point(flat), 0, signed)
        return signed.view(points.shape[:-1])

    def nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Distance in the plane to the nearest line, and the direction of its segment there.

        Args:
            points: ``[..., 3]`` [m].

        Returns:
            ``[...]`` [m], 0 or more; ``[...]`` [rad].

        Raises:
            ValueError: a coordinate is not finite.

        Examples:
            >>> lane = RoadEdges.from_polylines([torch.tensor([[0.0, 0, 0], [0, 10, 0]])])
            >>> lane.nearest(torch.tensor([2.0, 5.0, 0.0]))
            (tensor(2.), tensor(1.5708))
        """
        flat = _finite_columns(points)
        segment = self._nearest_segment(flat)
        projection = self._project(flat, segment)
        dx, dy, _ = self.delta[segment].unbind(-1)
        distance, direction = torch.hypot(projection.x, projection.y), torch.atan2(dy, dx)
        return distance.view(points.shape[:-1]), direction.view(points.shape[:-1])

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
        boxes = torch.cat((position, heading[..., None], extent.expand(position.shape)), -1).reshape(-1, 7)
        if not on_host(boxes):
            return self._of_boxes(boxes).view(position.shape[:-1])
        # Half of all agents stand, and a box that repeats the one before it has the same distance.
        new = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
        new[1:] = (boxes[1:] != boxes[:-1]).any(-1)
        return self._of_boxes(boxes[new])[new.cumsum(0) - 1].view(position.shape[:-1])

    def _of_boxes(self, boxes: Tensor) -> Tensor:
        """Signed distance of boxes ``[n, 7]``, x, y, z, heading, length, width, height: ``[n]`` [m]."""
        corners = box_corners(torch.cat((boxes[:, :2], boxes[:, 3:6]), -1))
        bottom = (boxes[:, 2] - boxes[:, 6] / 2)[:, None, None].expand(-1, 4, 1)
        return self.signed_distance(torch.cat((corners, bottom), -1)).amax(-1)

    @cached_property
    def _columns(self) -> tuple[Tensor, ...]:
        """Start x, y, z, delta x, y, z and squared length in the plane, each ``[W]``; infinite in place of length 0."""
        squared = self.delta[:, 0] * self.delta[:, 0] + self.delta[:, 1] * self.delta[:, 1]
        squared = torch.where(squared > 0, squared, torch.inf)  # any point falls on the start, t = 0
        return *self.start.T.contiguous(), *self.delta.T.contiguous(), squared

    def _project(self, points: Tensor, segment: Tensor) -> _Projection:
        """Project points onto segments in the plane.

        Args:
            points: ``[3, n]``.
            segment: ``[n]`` or ``[c, n]`` int64.
        """
        x, y, z, dx, dy, dz, squared = (
            column.index_select(0, segment.flatten()).view(segment.shape) for column in self._columns
        )
        x, y, z = points[0] - x, points[1] - y, points[2] - z
        t = (x * dx).add_(y * dy).div_(squared)
        side = torch.sign((x * dy).sub_(y * dx)) if segment.dim() == 1 else None
        clipped = t.clamp(0, 1)
        return _Projection(t, x.sub_(clipped * dx), y.sub_(clipped * dy), z.sub_(clipped * dz), side)

    def _first_nearest(self, points: Tensor, table: Tensor) -> Tensor:
        """The first of the nearest ones among some segments: ``[3, n]``, ``[c, n]`` -> ``[n]``."""
        return table.gather(0, self._place_of_nearest(points, table)[None])[0]

    def _place_of_nearest(self, points: Tensor, table: Tensor) -> Tensor:
        """Where it is in the table, ``[n]`` int64; one table ``[c, 1]`` may serve all points."""
        near = self._project(points, table)
        height = near.z.mul_(self.height_stretch)
        squared = near.x.square_().add_(near.y.square_()).add_(height.square_())
        # Segments of one map often tie but for the last bit, so it is their distances in float32 that are compared.
        tied = squared <= _largest_of_same_root(squared.amin(0))
        order = torch.arange(len(table), 0, -1, dtype=torch.int32, device=table.device)[:, None]
        return (len(table) - tied.to(torch.int32).mul_(order).amax(0)).long()

    def _side(self, points: Tensor, segment: Tensor, projection: _Projection) -> Tensor:
        """+1 right of the edge, -1 left: ``[3, n]``, ``[n]`` -> ``[n]``.

        Beyond an end of the segment the neighbour has a say: the corner of a convex bend is right of the edge if the
        point is right of either segment, that of a concave bend only if it is right of both.
        """
        side = projection.side.clone()

        def ask(neighbour: Tensor, beyond: Tensor, *, before: bool) -> None:
            asked = beyond & (neighbour[segment] != _NO_SEGMENT)
            if not on_host(asked):
                side.copy_(torch.where(asked, answer(neighbour, slice(None), before), side))
                return
            row = asked.nonzero()[:, 0]
            side[row] = answer(neighbour, row, before)

        def answer(neighbour: Tensor, row: Tensor | slice, before: bool) -> Tensor:
            own, other = segment[row], neighbour[segment[row]].clamp(min=0)
            first, second = (other, own) if before else (own, other)
            convex = _cross(self.delta[first], self.delta[second]) > 0
            mine, its = projection.side[row], self._project(points[:, row], other).side
            return torch.where(convex, torch.maximum(mine, its), torch.minimum(mine, its))

        ask(self.previous, projection.t < 0, before=True)
        ask(self.following, projection.t > 1, before=False)
        return side

    def _beside_a_point(self, points: Tensor) -> Tensor:
        """Queries whose nearest segment of some polyline has no length, and so no side: ``[3, n]`` -> ``[n]``."""
        hit = torch.zeros_like(points[0], dtype=torch.bool)
        degenerate = (self.delta[:, :2] == 0).all(-1)
        for line in self.line[degenerate].unique():
            own = (self.line == line).nonzero()
            hit |= degenerate[self._first_nearest(points, own.expand(-1, points.shape[1]))]
        return hit

    def _nearest_segment(self, points: Tensor) -> Tensor:
        """Index of the nearest segment, the first in map order on ties: ``[3, n]`` -> ``[n]``.

        Queries are gathered in boxes, from coarse to fine. Each box inherits the candidates of the coarser box around
        it and keeps those segments that can still be the nearest one of some point inside. A device looks at all
        segments, for it would have to be waited for to hear how many are left.
        """
        if not points.shape[1]:
            return torch.empty(0, dtype=torch.int64, device=points.device)
        if not on_host(points):
            every = torch.arange(len(self.start), device=points.device)[:, None]
            rows = max(1, _PAIRS_ON_DEVICE // len(every))
            return torch.cat([self._place_of_nearest(some, every) for some in points.split(rows, 1)])
        levels, leaf = nested_boxes(points, HEIGHT_STRETCH)
        every = torch.arange(len(self.start), device=points.device)
        candidates = Ragged.from_parts(1, [(every[:1], every[-1:] + 1, every)])
        for level in levels:
            candidates = self._narrow(candidates, level)
        nearest = torch.empty_like(leaf)
        for row, table, _ in candidates.tables(leaf):
            nearest[row] = self._first_nearest(points.index_select(1, row), table)
        return nearest

    def _narrow(self, candidates: Ragged, boxes: Boxes) -> Ragged:
        """Candidates of each box among those of the coarser box around it.

        Let ``v`` lead from the place on a segment that is nearest to the centre of the box to that centre, height
        stretched, and ``D`` be its length. As the query moves by ``o`` from the centre, the distance becomes at least
        ``D + o . v / D``, for it is convex, and at most ``|v + o|``, hence at most ``D + o . v / D + o . o / 2D`` and
        at most ``D + |o|``. A segment stays if its lower bound is within the upper bound of the segment that is nearest
        to the centre somewhere in the box. What a segment rises or falls under the query comes on top of both.
        """
        stretch = self.height_stretch
        half = (boxes.half[0], boxes.half[1], stretch * boxes.half[2])
        radius, reach = torch.hypot(*half[:2]), torch.stack(half).norm(dim=0)
        length = self.delta[:, :2].norm(dim=-1)
        slope = torch.where(length > 0, stretch * self.delta[:, 2].abs() / length, 0)
        climb = stretch * self.delta[:, 2].abs()
        margin = _MARGIN * (1 + max(boxes.centre.abs().max(), self.start.abs().max()))
        parts = []
        for row, table, real in candidates.tables(boxes.parent):
            near = self._project(boxes.centre[:, row], table)
            away = (near.x, near.y, near.z.mul_(stretch))
            distance = (away[0].square() + away[1].square() + away[2].square()).sqrt_()
            least, nearest = distance.min(0, keepdim=True)
            spread = torch.zeros_like(distance)
            for component, side in zip(away, half, strict=True):
                towards = component / distance.clamp(min=_TINY)
                spread += (towards - towards.gather(0, nearest)).abs_() * side[row]
            spread += reach[row].square() / (2 * least).clamp(min=_TINY)
            rise = torch.minimum(slope[table] * radius[row], climb[table])
            bound = torch.minimum(spread, 2 * reach[row]).add_(least + rise.gather(0, nearest)).add_(rise)
            keep = (real & (distance <= bound.mul_(1 + _MARGIN).add_(margin))).T.contiguous()
            parts.append((row, keep.sum(1), table.T[keep]))
        return Ragged.from_parts(len(boxes.parent), parts)


class _Projection(NamedTuple):
    """Points projected onto segments in the plane, each of the shape of the segments.

    Attributes:
        t: 0 at the start of the segment and 1 at its end, not clipped.
        x: of what lies between the point and the nearest place of the segment [m], as ``y`` and ``z``.
        side: +1 right of the segment's line, -1 left; None for tables of segments, which do without.
    """

    t: Tensor
    x: Tensor
    y: Tensor
    z: Tensor
    side: Tensor | None


def _finite_columns(points: Tensor) -> Tensor:
    """Points ``[..., 3]`` as ``[3, n]``, refused where one is not finite."""
    flat = points.reshape(-1, 3).T.contiguous()

    def refused() -> str:
        bad = flat[:, ~torch.isfinite(flat).all(0)][:, 0].tolist()
        return f"the distance to the road edge needs finite points, got {bad}; mask such points out."

    require(torch.isfinite(flat).all(), refused)
    return flat


def _largest_of_same_root(squared: Tensor) -> Tensor:
    """The largest float32 whose root, rounded to float32, is that of the given one: ``[n]`` -> ``[n]``.

    The float32 square root of torch is not rounded correctly; by way of float64 it is. What rounds to a root lies below
    the middle between it and the next number, whose square float64 holds exactly.
    """
    root = squared.double().sqrt_().float()
    above = torch.nextafter(root, torch.full_like(root, torch.inf))
    limit = root.double().add_(above).div_(2).square_()
    rounded = limit.float()
    return torch.where(rounded > limit, torch.nextafter(rounded, torch.zeros_like(rounded)), rounded)


def _cross(first: Tensor, second: Tensor) -> Tensor:
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
