"""Augmented scenes: the same traffic in a mirror, turned, or with fewer agents."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from envs.augment import Augmentation, drop_agents, mirror, rotate
from envs.geometry.edges import RoadEdges
from envs.geometry.frames import wrap_angle
from envs.scene import EDGE_KINDS, LANE_KINDS, LightState, LinkKind, MapKind, Scene, polylines
from envs.sources.synthetic import build_scene, red_light, straight_road
from envs.sources.womd import read_womd

ANGLES = st.floats(-math.pi, math.pi)
SETTINGS = settings(max_examples=15, deadline=None)


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


def all_points(scene: Scene) -> Tensor:
    """Valid positions, map points and present stop points, behind each other: ``[n, 3]``."""
    agents, lights = scene.agents, scene.lights
    present = lights.state != LightState.ABSENT
    return torch.cat((agents.position[agents.valid], scene.road.points, lights.stop_point[present]))


def heading_to_lane(scene: Scene) -> Tensor:
    """Heading of every valid state against every segment of the first lane: ``[n, segments]`` [rad]."""
    lane = polylines(scene, LANE_KINDS)[0]
    along = lane[1:] - lane[:-1]
    return wrap_angle(scene.agents.heading[scene.agents.valid][:, None] - torch.atan2(along[:, 1], along[:, 0]))


def assert_close(left: Scene, right: Scene, tolerance: float) -> None:
    for part in ("agents", "road", "lights"):
        for field in getattr(left, part).__dataclass_fields__:
            ours, theirs = getattr(getattr(left, part), field), getattr(getattr(right, part), field)
            difference = wrap_angle(ours - theirs) if field == "heading" else ours.double() - theirs.double()
            assert not len(difference) or float(difference.abs().max()) <= tolerance, field


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


@SETTINGS
@given(angle=ANGLES, seed=st.integers(0, 1000))
def test_turning_back_gives_the_scene_back(angle: float, seed: int) -> None:
    scene = curved_road(seed)
    before = scene.clone()
    turned = rotate(scene, angle)
    assert same(scene, before)
    assert_close(rotate(turned, -angle), scene, 1e-4)
    assert torch.equal(turned.origin, scene.origin) and turned.scene_id == scene.scene_id


def test_a_quarter_turn_takes_x_to_y() -> None:
    scene = red_light()
    turned = rotate(scene, math.pi / 2)
    x, y, z = scene.agents.position.unbind(-1)
    torch.testing.assert_close(turned.agents.position, torch.stack((-y, x, z), -1))
    torch.testing.assert_close(turned.agents.velocity, scene.agents.velocity.flip(-1))
    torch.testing.assert_close(turned.agents.heading, torch.full((1, 91), math.pi / 2))
    torch.testing.assert_close(turned.lights.stop_point[0, 0], torch.tensor([2.5, 20.0, 0.0]))


@SETTINGS
@given(angle=ANGLES, seed=st.integers(0, 1000))
def test_turning_keeps_distances_heights_and_headings_to_the_lane(angle: float, seed: int) -> None:
    scene = curved_road(seed)
    turned = rotate(scene, angle)
    here, there = all_points(scene), all_points(turned)
    assert torch.equal(here[:, 2], there[:, 2])
    torch.testing.assert_close(
        torch.cdist(there.double(), there.double()), torch.cdist(here.double(), here.double()), rtol=0, atol=1e-4
    )
    torch.testing.assert_close(turned.agents.velocity.norm(dim=-1), scene.agents.velocity.norm(dim=-1))
    assert float(wrap_angle(heading_to_lane(turned) - heading_to_lane(scene)).abs().max()) < 1e-4


@SETTINGS
@given(angle=ANGLES, seed=st.integers(0, 1000))
def test_a_turned_scene_is_in_the_format(angle: float, seed: int) -> None:
    agents, lights = (turned := rotate(curved_road(seed), angle).validate()).agents, turned.lights
    assert not any(values[~agents.valid].any() for values in (agents.position, agents.velocity, agents.heading))
    assert not lights.stop_point[lights.state == LightState.ABSENT].any()
    assert float(agents.heading.abs().max()) <= torch.tensor(math.pi)


def test_headings_end_at_plus_pi() -> None:
    scene = straight_road(1)
    assert rotate(scene, math.pi).agents.heading[0, 0] == pytest.approx(math.pi)
    assert rotate(scene, -math.pi).agents.heading[0, 0] == pytest.approx(math.pi)
    assert rotate(scene, 1.5 * math.pi).agents.heading[0, 0] == pytest.approx(-math.pi / 2)


def edge_distances(scene: Scene) -> Tensor:
    agents = scene.agents
    return RoadEdges.from_polylines(polylines(scene, EDGE_KINDS)).signed_distance(agents.position[agents.valid])


@pytest.mark.parametrize("change", [mirror, partial(rotate, angle=0.7), partial(rotate, angle=-2.9)])
@pytest.mark.parametrize("seed", range(3))
def test_the_distance_to_the_road_edge_stays(change: Callable[[Scene], Scene], seed: int) -> None:
    scene = curved_road(seed)
    distance = edge_distances(scene)
    assert (distance > 0).any() and (distance < 0).any()
    torch.testing.assert_close(edge_distances(change(scene)), distance, rtol=0, atol=2e-4)


@pytest.mark.parametrize("change", [mirror, partial(rotate, angle=0.7)])
def test_the_distance_to_the_road_edge_stays_in_real_scenes(shared: Path, change: Callable[[Scene], Scene]) -> None:
    (scene,) = read_womd(shared / "scenes/womd/womd_scenario_input.tfrecord")
    distance, changed = edge_distances(scene), edge_distances(change(scene))
    torch.testing.assert_close(changed, distance, rtol=0, atol=1e-3)


def test_those_who_are_evaluated_stay_and_the_rest_keeps_its_order() -> None:
    scene = curved_road(num_agents=6)
    before = scene.clone()
    assert drop_agents(scene, torch.ones(6, dtype=torch.bool)).agents.track_id.tolist() == [1, 2]
    drop = torch.tensor([True, False, True, False, True, False])
    dropped = drop_agents(scene, drop)
    assert dropped.agents.track_id.tolist() == [1, 2, 4, 6]
    assert torch.equal(dropped.agents.position, scene.agents.position[[0, 1, 3, 5]])
    assert same(scene, before)


def draw(augment: Augmentation, scene: Scene, seed: int) -> Scene:
    return augment(scene, torch.Generator().manual_seed(seed))


def test_the_default_changes_nothing() -> None:
    scene = curved_road()
    assert same(draw(Augmentation(), scene, 0), scene)


def test_the_seed_decides_and_the_scene_itself_stays() -> None:
    scene = curved_road(num_agents=20)
    before = scene.clone()
    augment = Augmentation(rotation=1.0, mirror=0.5, agent_drop=0.3)
    assert same(draw(augment, scene, 3), draw(augment, scene, 3))
    assert not same(draw(augment, scene, 3), draw(augment, scene, 4))
    assert same(scene, before)
    draw(augment, scene, 3).validate()


def test_draws_have_the_stated_chances() -> None:
    scene = straight_road(10)
    scene.agents.predict[:] = False
    augment = Augmentation(rotation=0.5, mirror=0.3, agent_drop=0.2)
    shown = [draw(augment, scene, seed) for seed in range(400)]
    angles = torch.stack([s.agents.heading[0, 0] for s in shown])
    assert angles.abs().max() <= 0.5 and angles.min() < -0.45 and angles.max() > 0.45
    assert abs(float(angles.mean())) < 0.05
    # The road's two lanes run along and against x; in the mirror the one of the cars lies on their left.
    mirrored = torch.stack([rotate(s, -float(s.agents.heading[0, 0])).agents.position[0, 0, 1] > 0 for s in shown])
    assert float(mirrored.float().mean()) == pytest.approx(0.3, abs=0.08)
    assert sum(len(s.agents.sdc) - 1 for s in shown) / 400 / 9 == pytest.approx(0.8, abs=0.03)
    assert all(int(s.agents.sdc.sum()) == 1 for s in shown)


def test_one_option_does_not_change_what_another_draws() -> None:
    scene = curved_road(num_agents=20)
    for seed in range(5):
        alone = draw(Augmentation(agent_drop=0.5), scene, seed).agents.track_id
        assert torch.equal(draw(Augmentation(1.0, 0.5, agent_drop=0.5), scene, seed).agents.track_id, alone)


@pytest.mark.parametrize(
    ("field", "value"),
    [("rotation", -0.1), ("rotation", 180), ("mirror", 1.5), ("agent_drop", -1), ("rotation", math.nan)],
)
def test_values_out_of_range_are_quoted(field: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"{field} .*{value}"):
        Augmentation(**{field: value})


if __name__ == "__main__":
    pytest.main([__file__])
