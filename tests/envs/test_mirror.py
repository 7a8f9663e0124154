"""Mirrored scenes: the same traffic on the other side of the road."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from envs.geometry.edges import RoadEdges
from envs.mirror import mirror
from envs.scene import EDGE_KINDS, LightState, LinkKind, MapKind, Scene, polylines
from envs.sources.synthetic import build_scene, red_light, straight_road
from envs.sources.womd import read_womd


@pytest.fixture
def scene() -> Scene:
    """One car off the axis of the mirror, a red light, lanes that are neighbours."""
    scene = red_light().clone()
    scene.agents.heading[:] = 0.3
    scene.agents.velocity[..., 1] = 2.0
    scene.road.links = torch.tensor([[1, 2, LinkKind.LEFT], [2, 1, LinkKind.RIGHT], [1, 1, LinkKind.EXIT]])
    return scene


def curved_road(seed: int = 0, num_agents: int = 4) -> Scene:
    """Agents with gaps in their tracks on a bent, rising road far from the frame's zero; a light that goes off."""
    generator = torch.Generator().manual_seed(seed)
    bend = torch.linspace(0, 2, 40)
    turn = torch.rand((), generator=generator) * 6

    def line(radius: float, backward: bool = False) -> Tensor:
        points = torch.stack((radius * (bend + turn).cos() + 300, radius * (bend + turn).sin() - 200, 3 * bend), -1)
        return points.flip(0) if backward else points

    lines = [
        (MapKind.LANE_SURFACE_STREET, line(50)),
        (MapKind.EDGE_BOUNDARY, line(56)),
        (MapKind.EDGE_MEDIAN, line(44, backward=True)),
    ]
    poses = torch.rand(num_agents, 91, 3, generator=generator) * torch.tensor([120.0, 120.0, 2 * math.pi])
    poses += torch.tensor([240.0, -260.0, -math.pi])
    valid = torch.rand(num_agents, 91, generator=generator) > 0.3
    valid[:, 10] = True
    scene = build_scene(poses, lines, valid=valid, scene_id=f"curved_road_{seed}")
    scene.agents.position[..., 2] = torch.rand(num_agents, 91, generator=generator) * valid
    scene.agents.velocity = torch.randn(num_agents, 91, 2, generator=generator) * 10 * valid[..., None]
    scene.agents.predict = torch.arange(num_agents) == 1
    scene.lights = red_light().lights
    scene.lights.state[:, 40:] = LightState.ABSENT
    scene.lights.stop_point[:, 40:] = 0
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


def edge_distances(scene: Scene) -> Tensor:
    agents = scene.agents
    return RoadEdges.from_polylines(polylines(scene, EDGE_KINDS)).signed_distance(agents.position[agents.valid])


@pytest.mark.parametrize("seed", range(3))
def test_the_distance_to_the_road_edge_stays(seed: int) -> None:
    scene = curved_road(seed)
    distance = edge_distances(scene)
    assert (distance > 0).any() and (distance < 0).any()
    torch.testing.assert_close(edge_distances(mirror(scene)), distance, rtol=0, atol=2e-4)


def test_the_distance_to_the_road_edge_stays_in_real_scenes(shared: Path) -> None:
    (scene,) = read_womd(shared / "scenes/womd/womd_scenario_input.tfrecord")
    distance, changed = edge_distances(scene), edge_distances(mirror(scene))
    torch.testing.assert_close(changed, distance, rtol=0, atol=1e-3)


if __name__ == "__main__":
    pytest.main([__file__])
