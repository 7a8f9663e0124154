"""Geometry on a device: all pairs instead of the few that a CPU looks at, the same values, and nobody waits."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from envs.devices import of_rows, require
from envs.geometry import boxes, edges, ground
from envs.geometry.boxes import nearest_box_distance
from envs.geometry.edges import RoadEdges
from envs.geometry.following import time_to_collision
from envs.geometry.ground import Ground, lift
from recipes.benchmark.pretended import DEVICE, Pretended

MAP = [
    torch.tensor([[0.0, 0, 0], [10, 0, 0], [10, 10, 1], [0, 10, 1], [0, 0, 0]]),
    torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, -5, 0]]),
    torch.tensor([[-20.0, 3, 4], [20, 3, 4]]),
]
"""A ring, a line that begins with a segment without length and touches it, and a bridge."""


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("ego", [None, torch.tensor([2, 0])], ids=["all", "some"])
@pytest.mark.parametrize("at_once", [1 << 22, 10])
def test_the_nearest_of_all_boxes_is_that_of_the_candidates(
    ego: Tensor | None, at_once: int, there: Pretended, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(boxes, "_PAIRS_ON_DEVICE", at_once)
    placed = random(4, 7, 6, 5) * torch.tensor([30.0, 30.0, 6.0, 5.0, 3.0])
    valid = random(4, 7, 6, seed=1) < 0.6
    want = nearest_box_distance(placed, valid, ego)
    given = placed.to(DEVICE), valid.to(DEVICE), None if ego is None else ego.to(DEVICE)
    there.reset()
    got = nearest_box_distance(*given)
    assert not there.read_backs and there.uploads == 0
    torch.testing.assert_close(got.cpu(), want, rtol=1e-6, atol=1e-5)
    assert torch.equal(got.cpu() == boxes.NOBODY, want == boxes.NOBODY)


def test_nobody_is_nearest_where_there_is_nobody(there: Pretended) -> None:
    none = nearest_box_distance(torch.zeros(0, 3, 5, device=DEVICE), torch.zeros(0, 3, dtype=torch.bool, device=DEVICE))
    assert none.shape == (0, 3)


@pytest.mark.parametrize("at_once", [1 << 25, 1000])
@pytest.mark.parametrize("options", [{}, {"every_ring": True}, {"height_stretch": 0.0}], ids=str)
def test_the_nearest_of_all_segments_is_that_of_the_boxes(
    options: dict, at_once: int, there: Pretended, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(edges, "_PAIRS_ON_DEVICE", at_once)
    grid = torch.cartesian_prod(torch.arange(-6.0, 17, 1.5), torch.arange(-6.0, 17, 1.5), torch.tensor([0.0, 3.0]))
    here = RoadEdges.from_polylines(MAP, **options)
    want = here.signed_distance(grid), *here.nearest(grid)
    road, points = here.to(DEVICE), grid.to(DEVICE)
    there.reset()
    got = road.signed_distance(points), *road.nearest(points)
    assert not there.read_backs and there.uploads == 0
    for mine, theirs in zip(got, want, strict=True):
        assert torch.equal(mine.cpu(), theirs)


def test_lines_on_a_device_make_the_same_edges_and_are_asked_once(there: Pretended) -> None:
    lines = [line.to(DEVICE) for line in MAP]
    there.reset()
    made = RoadEdges.from_polylines(lines)
    assert there.read_backs == {"_to_copy": 1}
    here = RoadEdges.from_polylines(MAP)
    assert all(torch.equal(getattr(made, name).cpu(), getattr(here, name)) for name in ("start", "previous", "line"))


def test_boxes_are_as_far_off_the_road(there: Pretended) -> None:
    position, heading = random(5, 9, 3) * torch.tensor([20.0, 20, 1]), 6 * random(5, 9)
    position[:, 4] = position[:, 3]  # who stands is looked up once on a CPU
    extent, road = torch.tensor([4.0, 2.0, 1.5]), RoadEdges.from_polylines(MAP)
    want = road.box_offroad_distance(position, heading, extent)
    road, given = road.to(DEVICE), [value.to(DEVICE) for value in (position, heading, extent)]
    there.reset()
    got = road.box_offroad_distance(*given)
    assert not there.read_backs and there.uploads == 0
    assert torch.equal(got.cpu(), want)


@pytest.mark.parametrize("at_once", [1 << 24, 50])
def test_the_ground_is_as_high(at_once: int, there: Pretended, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground, "_PAIRS_ON_DEVICE", at_once)
    points = random(40, 3) * torch.tensor([50.0, 50.0, 8.0])
    poses = random(2, 3, 12, 3, seed=1) * torch.tensor([50.0, 50.0, 3.0])
    start = torch.cat((poses[0, :, 0, :2], torch.tensor([[0.7], [2.0], [6.0]])), -1)
    want = lift(poses, start, points)
    given = [value.to(DEVICE) for value in (poses, start, points)]
    there.reset()
    got = lift(*given)
    assert not there.read_backs and there.uploads == 0
    assert torch.equal(got.cpu(), want)
    places = Ground(given[2])
    assert places.height(given[1][0, :2], given[1][0, 2]).shape == ()


def test_leaders_are_reached_as_soon(there: Pretended) -> None:
    position, heading, speed = 20 * random(2, 5, 4, 2), 0.3 * random(2, 5, 4), 9 * random(2, 5, 4)
    extent, valid, ego = 1 + 3 * random(2, 5, 3), random(2, 5, 4) < 0.8, torch.tensor([3, 1])
    want = time_to_collision(position, heading, speed, extent, valid, ego)
    given = [value.to(DEVICE) for value in (position, heading, speed, extent, valid, ego)]
    there.reset()
    got = time_to_collision(*given)
    assert not there.read_backs and there.uploads == 0 and (want < 5).any()
    assert torch.equal(got.cpu(), want)


def test_values_of_rows_that_are_not_there_are_0_on_both(there: Pretended) -> None:
    value, here = random(3, 4, 2), random(3, 4) < 0.5

    def twice(rows: Tensor) -> Tensor:
        return 2 * rows

    want = of_rows(here, twice, value)
    assert torch.equal(want, 2 * value * here[..., None])
    assert torch.equal(of_rows(here.to(DEVICE), twice, value.to(DEVICE)).cpu(), want)


def test_a_value_that_is_refused_stops_the_device_and_says_why_on_the_host(there: Pretended) -> None:
    with pytest.raises(ValueError, match="not so"):
        require(torch.tensor(False), lambda: "not so")
    with pytest.raises(RuntimeError, match="run the same on the CPU"):
        require(torch.tensor(False, device=DEVICE), lambda: "not so")
    there.reset()
    require(torch.tensor(True, device=DEVICE), lambda: "not so")
    assert not there.read_backs


if __name__ == "__main__":
    pytest.main([__file__])
