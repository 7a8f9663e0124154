"""Signed distances to road edges."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.geometry.edges import RoadEdges


def random_lines(seed: int) -> list[torch.Tensor]:
    """Winding polylines with a ring, a repeated point, a vertical step and a bridge."""
    generator = torch.Generator().manual_seed(seed)
    lines = []
    for _ in range(6):
        count = int(torch.randint(2, 40, (), generator=generator))
        step = torch.randn(count, 3, generator=generator) * torch.tensor([2.0, 2.0, 0.2])
        lines.append(torch.randn(3, generator=generator) * torch.tensor([40.0, 40.0, 4.0]) + step.cumsum(0))
    angle = torch.linspace(0, 2 * torch.pi, 41)
    lines.append(torch.stack((10 * angle.cos(), 10 * angle.sin(), torch.zeros(41)), -1))
    lines[0][1:2] = lines[0][:1]
    lines[1][1, :2] = lines[1][0, :2]
    return lines


def nearest_of_all(edges: RoadEdges, points: torch.Tensor) -> torch.Tensor:
    """The first of the segments at the least distance in float32, height stretched, by looking at all of them."""
    x, y, z = (points[:, None] - edges.start).unbind(-1)
    dx, dy, dz = edges.delta.unbind(-1)
    squared = dx * dx + dy * dy
    t = torch.where(squared > 0, (x * dx + y * dy) / squared, 0).clamp(0, 1)
    x, y, z = x - t * dx, y - t * dy, edges.height_stretch * (z - t * dz)
    return (x * x + y * y + z * z).double().sqrt().float().argmin(1)


@given(
    seed=st.integers(0, 10_000),
    origin=st.sampled_from([0.0, 5000.0]),
    steepness=st.sampled_from([0.0, 1.0, 20.0]),
    stretch=st.sampled_from([0.0, 3.0]),
)
@settings(max_examples=30, deadline=None)
def test_culling_finds_the_segment_that_brute_force_finds(
    seed: int, origin: float, steepness: float, stretch: float
) -> None:
    shift, scale = torch.tensor([origin, -origin, 0.0]), torch.tensor([1.0, 1.0, steepness])
    lines = [line * scale + shift for line in random_lines(seed)]
    edges = RoadEdges.from_polylines(lines, height_stretch=stretch)
    generator = torch.Generator().manual_seed(seed + 1)
    near = edges.start[torch.randint(len(edges.start), (300,), generator=generator)]
    near = near + torch.randn(300, 3, generator=generator) * torch.tensor([3.0, 3.0, 1.0])
    far = torch.randn(100, 3, generator=generator) * torch.tensor([200.0, 200.0, 20.0]) + shift
    crowd = near[:1] + torch.randn(300, 3, generator=generator) * torch.tensor([0.3, 0.3, 0.02])
    points = torch.cat((near, far, crowd, edges.start))
    assert torch.equal(edges._nearest_segment(points.T.contiguous()), nearest_of_all(edges, points))


def test_of_segments_that_tie_the_first_one_in_map_order_is_nearest() -> None:
    line = torch.tensor([[0.0, 0, 0], [10, 0, 0]])
    edges = RoadEdges.from_polylines([line + torch.tensor([0.0, y, 0]) for y in (2.0, -2, 2, -2)])
    points = torch.tensor([[1.0, 0, 0], [5, 0, 0], [5, -3, 0]])
    assert edges._nearest_segment(points.T.contiguous()).tolist() == [0, 0, 1]


def test_boxes_that_stand_still_have_the_distance_of_each_on_its_own() -> None:
    edges = RoadEdges.from_polylines(random_lines(3))
    generator = torch.Generator().manual_seed(0)
    position, heading = torch.randn(5, 3, generator=generator) * 20, torch.randn(5, generator=generator)
    extent = torch.rand(5, 3, generator=generator) + 1
    one_by_one = torch.stack([edges.box_offroad_distance(*box) for box in zip(position, heading, extent, strict=True)])
    standing = edges.box_offroad_distance(*(value.repeat_interleave(4, 0) for value in (position, heading, extent)))
    assert torch.equal(standing, one_by_one.repeat_interleave(4))


def test_left_of_an_edge_is_on_the_road() -> None:
    edges = RoadEdges.from_polylines([torch.tensor([[0.0, 0, 0], [10, 0, 0]])])
    distance = edges.signed_distance(torch.tensor([[5.0, 2, 0], [5.0, -2, 0], [13.0, 4, 0]]))
    torch.testing.assert_close(distance, torch.tensor([-2.0, 2.0, -5.0]))


@pytest.mark.parametrize(("turn", "sign"), [(1.0, 1.0), (-1.0, -1.0)])
def test_beyond_a_bend_both_segments_decide_the_side(turn: float, sign: float) -> None:
    corner = torch.tensor([[-10.0, 0, 0], [0, 0, 0], [-10.0, 3 * turn, 0]])
    edges = RoadEdges.from_polylines([corner])
    outside = torch.tensor([[2.0, -0.5 * turn, 0], [2.0, 0.1 * turn, 0]])
    assert torch.sign(edges.signed_distance(outside)).tolist() == [sign, sign]


def test_the_edge_of_a_bridge_does_not_rule_the_road_beneath() -> None:
    ground = torch.tensor([[-50.0, 3, 0], [50.0, 3, 0]])
    bridge = torch.tensor([[-50.0, -1, 6], [50.0, -1, 6]])
    edges = RoadEdges.from_polylines([ground, bridge])
    assert edges.signed_distance(torch.tensor([0.0, 0, 0])).item() == 3.0
    assert edges.signed_distance(torch.tensor([0.0, 0, 6])).item() == -1.0


def test_a_ring_is_closed_only_if_it_is_the_longest_polyline() -> None:
    ring = torch.tensor([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [0, 0, 0]])
    closed = RoadEdges.from_polylines([ring])
    assert closed.previous[0].item() == 3
    assert closed.following[3].item() == 0
    longer = torch.stack((torch.arange(6.0) * 20 + 500, torch.zeros(6), torch.zeros(6)), -1)
    opened = RoadEdges.from_polylines([ring, longer])
    assert opened.previous[0].item() == opened.following[3].item() == -1


def test_a_box_is_as_far_off_the_road_as_its_worst_bottom_corner() -> None:
    edges = RoadEdges.from_polylines([torch.tensor([[-50.0, 0, 0], [50.0, 0, 0]])])
    position = torch.tensor([[0.0, 5.0, 0.8], [0.0, 0.5, 0.8]])
    distance = edges.box_offroad_distance(position, torch.tensor([0.0, torch.pi / 2]), torch.tensor([4.0, 2.0, 1.6]))
    torch.testing.assert_close(distance, torch.tensor([-4.0, 1.5]))


def test_polylines_of_one_point_and_no_queries_are_fine() -> None:
    edges = RoadEdges.from_polylines([torch.zeros(1, 3), torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.zeros(0, 3)])
    assert len(edges.start) == 1
    assert edges.signed_distance(torch.zeros(4, 0, 3)).shape == (4, 0)


def test_no_edge_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="no road edge"):
        RoadEdges.from_polylines([torch.zeros(1, 3)])


def test_a_point_that_is_not_finite_is_refused_with_its_value() -> None:
    edges = RoadEdges.from_polylines([torch.tensor([[0.0, 0, 0], [1, 0, 0]])])
    with pytest.raises(ValueError, match="nan"):
        edges.signed_distance(torch.tensor([0.0, torch.nan, 0.0]))


@pytest.mark.parametrize("case", range(10))
def test_distance_equals_the_official_one(shared, case: int) -> None:
    data = np.load(shared / "realism" / "golden" / "micro" / f"road_edge_{case:02}.npz")
    points, ptr = torch.from_numpy(data["road_edge_xyz"]).float(), data["road_edge_ptr"]
    edges = RoadEdges.from_polylines([points[a:b] for a, b in itertools.pairwise(ptr)])
    distance = edges.signed_distance(torch.from_numpy(data["query"]))
    np.testing.assert_allclose(distance.numpy(), data["signed_distance"], atol=1e-4, rtol=1e-5)
