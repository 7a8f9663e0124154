"""Signed distances between boxes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon

from envs.geometry.boxes import NOBODY, box_corners, nearest_box_distance, signed_box_distance

CAR = torch.tensor([0.0, 0.0, 0.0, 4.0, 2.0])


def random_boxes(*shape: int, seed: int, spread: float = 15.0) -> torch.Tensor:
    unit = torch.rand(*shape, 5, generator=torch.Generator().manual_seed(seed))
    low = torch.tensor([-spread, -spread, -7.0, 0.3, 0.3])
    high = torch.tensor([spread, spread, 7.0, 12.0, 3.0])
    return low + unit * (high - low)


def test_corners_run_counter_clockwise_from_the_front_left_one() -> None:
    turned = torch.tensor([1.0, 2.0, math.pi / 2, 4.0, 2.0])
    expected = torch.tensor([[0.0, 4.0], [0.0, 0.0], [2.0, 0.0], [2.0, 4.0]])
    torch.testing.assert_close(box_corners(turned), expected)


@settings(max_examples=20, deadline=None)
@given(x=st.floats(-50, 50), y=st.floats(-50, 50), heading=st.floats(-4, 4), length=st.floats(0.5, 20))
def test_a_box_has_its_size_its_centre_and_turns_left(x: float, y: float, heading: float, length: float) -> None:
    corners = box_corners(torch.tensor([x, y, heading, length, 1.5])).double()
    torch.testing.assert_close(corners.mean(0), torch.tensor([x, y], dtype=torch.float64), atol=1e-4, rtol=0)
    nxt = corners.roll(-1, 0)
    area = ((corners[:, 0] * nxt[:, 1] - corners[:, 1] * nxt[:, 0]).sum() / 2).item()
    assert area == pytest.approx(1.5 * length, abs=0.02)
    front = (corners[0] + corners[3]) / 2 - corners.mean(0)
    assert (front @ torch.tensor([math.cos(heading), math.sin(heading)], dtype=torch.float64)).item() == pytest.approx(
        length / 2, abs=1e-4
    )


def test_gap_of_boxes_in_file_is_the_distance_between_bumpers() -> None:
    ahead = torch.tensor([7.0, 0.3, 0.0, 4.0, 2.0])
    assert signed_box_distance(CAR, ahead).item() == pytest.approx(3.0)


def test_rounding_cuts_the_corners_of_boxes_that_are_diagonal_to_each_other() -> None:
    diagonal = torch.tensor([5.0, 3.0, 0.0, 4.0, 2.0])
    sharp, rounded = (signed_box_distance(CAR, diagonal, rounding).item() for rounding in (0.0, 0.7))
    assert sharp == pytest.approx(math.hypot(1, 1), abs=1e-6)
    assert rounded == pytest.approx(math.hypot(2.4, 2.4) - 1.4, abs=1e-6)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_sharp_distance_equals_that_of_polygons(seed: int) -> None:
    boxes = random_boxes(12, seed=seed, spread=6.0)
    shapes = [Polygon(corners) for corners in box_corners(boxes).tolist()]
    for i in range(0, 12, 2):
        distance = signed_box_distance(boxes[i], boxes[i + 1], rounding=0.0).item()
        if distance > 0:
            assert distance == pytest.approx(shapes[i].distance(shapes[i + 1]), abs=1e-4)
        else:
            assert shapes[i].intersects(shapes[i + 1])


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_negative_distance_is_the_shortest_move_that_parts_two_boxes(seed: int) -> None:
    first, second = random_boxes(2, 1, seed=seed, spread=1.5)
    depth = -signed_box_distance(first, second)
    if depth <= 0:
        return
    direction = torch.linspace(0, 2 * math.pi, 721)
    way = torch.stack((direction.cos(), direction.sin()), -1)

    def after(move: torch.Tensor) -> torch.Tensor:
        moved = second.expand(len(way), 5).clone()
        moved[:, :2] += way * move
        return signed_box_distance(first, moved)

    assert (after(0.98 * depth) < 0).all()
    assert (after(1.02 * depth) > -1e-4).any()


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_distance_is_symmetric_and_does_not_depend_on_the_frame(seed: int) -> None:
    first, second = random_boxes(2, 32, seed=seed)
    distance = signed_box_distance(first, second)
    torch.testing.assert_close(signed_box_distance(second, first), distance, atol=1e-4, rtol=0)
    shift = torch.tensor([13.0, -7.0, 0.0, 0.0, 0.0])
    torch.testing.assert_close(signed_box_distance(first + shift, second + shift), distance, atol=1e-4, rtol=0)


@given(seed=st.integers(0, 10_000), spread=st.sampled_from([3.0, 30.0, 300.0]))
@settings(max_examples=20, deadline=None)
def test_nearest_distance_equals_the_minimum_over_all_pairs(seed: int, spread: float) -> None:
    boxes = random_boxes(3, 4, 20, seed=seed, spread=spread)
    valid = torch.rand(3, 4, 20, generator=torch.Generator().manual_seed(seed)) > 0.3
    ego = torch.tensor([4, 0, 19])
    every = signed_box_distance(boxes[..., ego, None, :], boxes[..., None, :, :])
    counts = valid[..., ego, None] & valid[..., None, :] & (ego[:, None] != torch.arange(20))
    expected = torch.where(counts, every, NOBODY).amin(-1)
    assert torch.equal(nearest_box_distance(boxes, valid, ego), expected)


def test_nobody_is_near_a_lone_or_invalid_box() -> None:
    boxes = random_boxes(3, seed=0)
    assert nearest_box_distance(boxes[:1], torch.tensor([True])).tolist() == [NOBODY]
    distance = nearest_box_distance(boxes, torch.tensor([True, False, False]))
    assert distance.tolist() == [NOBODY] * 3


def test_an_invalid_agent_changes_nothing() -> None:
    boxes = random_boxes(2, 6, seed=1)
    valid = torch.ones(2, 6, dtype=torch.bool)
    more = torch.cat((boxes, boxes[:, :1]), 1)
    more_valid = torch.cat((valid, torch.zeros(2, 1, dtype=torch.bool)), 1)
    assert torch.equal(nearest_box_distance(more, more_valid)[:, :6], nearest_box_distance(boxes, valid))


def test_wrong_mask_is_refused_with_both_shapes() -> None:
    with pytest.raises(ValueError, match=r"\(2, 3\).*\(3, 2\)"):
        nearest_box_distance(torch.zeros(2, 3, 5), torch.ones(3, 2, dtype=torch.bool))


@pytest.mark.parametrize("case", range(10))
def test_distance_equals_the_official_one(shared, case: int) -> None:
    data = np.load(shared / "realism" / "golden" / "micro" / f"boxes_{case:02}.npz")
    boxes = torch.from_numpy(np.stack([data[name] for name in ("x", "y", "heading", "length", "width")], -1))
    valid = torch.from_numpy(data["valid"])
    ego = torch.arange(int(data["n_eval"]))
    distance = nearest_box_distance(boxes.transpose(0, 1), valid.T, ego).T
    np.testing.assert_allclose(distance.numpy(), data["distance_to_nearest_object"], atol=2e-3, rtol=2e-3)
