"""Mirrored scenes: the same traffic seen in a mirror."""

from __future__ import annotations

import pytest
import torch

from envs.augment import mirror
from envs.geometry.edges import RoadEdges
from envs.scene import LinkKind, MapKind, Scene, polylines
from envs.sources.synthetic import red_light, straight_road


@pytest.fixture
def scene() -> Scene:
    """One car off the axis of the mirror, a red light, lanes that are neighbours."""
    scene = red_light().clone()
    scene.agents.heading[:] = 0.3
    scene.agents.velocity[..., 1] = 2.0
    scene.road.links = torch.tensor([[1, 2, LinkKind.LEFT], [2, 1, LinkKind.RIGHT], [1, 1, LinkKind.EXIT]])
    return scene


def same(left: Scene, right: Scene) -> bool:
    return all(
        torch.equal(getattr(getattr(left, part), field), getattr(getattr(right, part), field))
        for part in ("agents", "road", "lights")
        for field in getattr(left, part).__dataclass_fields__
    )


def test_a_mirror_of_a_mirror_is_the_scene(scene: Scene) -> None:
    assert same(mirror(mirror(scene)), scene)
    assert not same(mirror(scene), scene)


def test_the_scene_itself_stays_as_it_is(scene: Scene) -> None:
    before = scene.clone()
    mirror(scene)
    assert same(scene, before)


def test_y_headings_and_lateral_speeds_change_sign_and_nothing_else(scene: Scene) -> None:
    agents, mirrored = scene.agents, mirror(scene).agents
    flip = torch.tensor([1.0, -1.0, 1.0])
    assert torch.equal(mirrored.position, agents.position * flip)
    assert torch.equal(mirrored.velocity, agents.velocity * flip[:2])
    assert torch.equal(mirrored.heading, -agents.heading)
    assert torch.equal(mirrored.valid, agents.valid) and torch.equal(mirrored.extent, agents.extent)
    assert torch.equal(mirror(scene).lights.stop_point, scene.lights.stop_point * flip)
    assert torch.equal(mirror(scene).lights.state, scene.lights.state)


def test_left_neighbours_become_right_ones(scene: Scene) -> None:
    assert mirror(scene).road.links.tolist() == [[1, 2, LinkKind.RIGHT], [2, 1, LinkKind.LEFT], [1, 1, LinkKind.EXIT]]


def test_the_drivable_side_stays_on_the_left_of_road_edges() -> None:
    scene = straight_road()
    points = torch.tensor([[0.0, 0.0, 0.0], [10.0, 4.0, 0.0], [10.0, 8.0, 0.0]])
    edges, mirrored_edges = (
        RoadEdges.from_polylines(polylines(s, [MapKind.EDGE_BOUNDARY])) for s in (scene, mirror(scene))
    )
    distance = edges.signed_distance(points)
    mirrored = mirrored_edges.signed_distance(points * torch.tensor([1.0, -1.0, 1.0]))
    torch.testing.assert_close(mirrored, distance)
    assert (distance < 0).tolist() == [True, True, False]


def test_a_mirrored_scene_is_valid(scene: Scene) -> None:
    mirror(scene).validate()


if __name__ == "__main__":
    pytest.main([__file__])
