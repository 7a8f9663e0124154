"""Scenes: what is refused, how they are padded, and what is read off them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from envs.scene import (
    CURRENT_STEP,
    LightState,
    MapKind,
    Scene,
    SceneError,
    SceneSource,
    collate,
    polylines,
    select_agents,
)
from envs.sources.synthetic import build_scene, red_light, straight_road, two_cars_head_on


@pytest.mark.parametrize("make", [straight_road, two_cars_head_on, red_light])
def test_synthetic_scenes_are_valid(make: Callable[[], Scene]) -> None:
    scene = make()
    assert scene.validate() is scene


def second_sdc(scene: Scene) -> None:
    scene.agents.sdc[:] = True


def nobody_now(scene: Scene) -> None:
    scene.agents.valid[:, CURRENT_STEP] = False


def sdc_away(scene: Scene) -> None:
    scene.agents.valid[0, CURRENT_STEP] = False


def nan_heading(scene: Scene) -> None:
    scene.agents.heading[1, 40] = torch.nan


def infinite_position(scene: Scene) -> None:
    scene.agents.position[1, 40, 1] = torch.inf


def flat_box(scene: Scene) -> None:
    scene.agents.extent[1, 1] = 0.0


def nan_map_point(scene: Scene) -> None:
    scene.road.points[3, 0] = torch.nan


def no_edges(scene: Scene) -> None:
    scene.road.kind[:] = int(MapKind.LANE_SURFACE_STREET)


def half_the_log(scene: Scene) -> None:
    scene.agents.valid = scene.agents.valid[:, :50]
    scene.agents.position = scene.agents.position[:, :50]


def beyond_the_earth(scene: Scene) -> None:
    scene.agents.position[1, 40, 1] = 1e8


def unknown_kind(scene: Scene) -> None:
    scene.road.kind[0] = 4


def negative_count(scene: Scene) -> None:
    scene.road.count[0], scene.road.count[1] = -1, scene.road.count[:2].sum() + 1
    scene.road.start = scene.road.count.cumsum(0) - scene.road.count


def one_kind_too_few(scene: Scene) -> None:
    scene.agents.kind = scene.agents.kind[:1]


def other_type(scene: Scene) -> None:
    scene.agents.track_id = scene.agents.track_id.int()


def lost_origin(scene: Scene) -> None:
    scene.origin[0] = torch.nan


def unknown_lack(scene: Scene) -> None:
    scene.lacks.fill_(4096)


@pytest.mark.parametrize("scene_id", ["two\nlines", "\ud800", "x" * 201, b"bytes", [{"x": 1.5}] * 99])
def test_an_id_that_no_terminal_can_show_is_refused(scene_id: object) -> None:
    scene = straight_road().clone()
    scene.scene_id = scene_id
    with pytest.raises(
        SceneError, match="train.json, record 3: scenario_id is .*; must be text of at most 200"
    ) as caught:
        scene.validate("train.json, record 3")
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (second_sdc, "2 agents are marked as SDC; mark exactly one"),
        (nobody_now, "no agent is valid at the current step 10"),
        (sdc_away, "the SDC is not valid at the current step 10"),
        (nan_heading, "track 2 has heading nan .* not finite; mark it invalid"),
        (infinite_position, "track 2 has position inf"),
        (flat_box, "track 2 has the extent .* must be positive"),
        (nan_map_point, r"map feature \d has the point .* not finite"),
        (no_edges, "no road edge"),
        (beyond_the_earth, "track 2 has position 1e.08 at step 40 .* larger than 1e.07"),
        (unknown_kind, "road.kind holds 4, which is no MapKind"),
        (negative_count, "points of the polylines must lie behind each other"),
        (one_kind_too_few, r"agents.kind is torch.int64 of shape \(1,\); must be torch.int64 of shape \(2,\)"),
        (other_type, "agents.track_id is torch.int32 of shape .*; must be torch.int64"),
        (lost_origin, r"the origin is \[nan, .*must be finite numbers"),
        (unknown_lack, "lacks is 4096; must be flags of Lacks"),
        (half_the_log, r"91 steps of 0.1 s, got positions of shape \(2, 50, 3\)"),
    ],
)
def test_a_scene_that_cannot_be_used_is_refused(spoil: Callable[[Scene], None], message: str) -> None:
    scene = straight_road(2).clone()
    spoil(scene)
    with pytest.raises(SceneError, match=f"^train.json, record 3 .scene straight_road_2_None.: .*{message}"):
        scene.validate("train.json, record 3")


def test_values_at_invalid_steps_do_not_matter() -> None:
    scene = straight_road(2).clone()
    scene.agents.valid[1, 40] = False
    nan_heading(scene)
    scene.validate()


def test_a_list_of_scenes_is_a_source() -> None:
    assert isinstance([straight_road()], SceneSource)


def test_collating_pads_agents_polylines_and_lights_invalid() -> None:
    plain, lit = straight_road(3), red_light()
    batch = collate([plain, lit])
    assert batch.batch_size == (2,)
    assert batch.scene_id == [plain.scene_id, lit.scene_id]
    assert torch.equal(batch.agents.position[0], plain.agents.position)
    assert torch.equal(batch.agents.position[1, :1], lit.agents.position)
    assert not batch.agents.valid[1, 1:].any() and not batch.agents.sdc[1, 1:].any()
    assert (batch.agents.track_id[1, 1:] == -1).all()
    assert batch.lights.lane_id.tolist() == [[-1], [1]]
    assert (batch.lights.state[0] == LightState.ABSENT).all()


def test_collated_maps_keep_every_polyline_where_it_was() -> None:
    short = build_scene(torch.zeros(1, 91, 3), [(MapKind.EDGE_MEDIAN, torch.rand(4, 2))])
    batch = collate([short, straight_road()])
    assert batch.road.count[0].tolist() == [4, 0, 0, 0, 0]
    assert batch.road.feature_id[0].tolist() == [1, -1, -1, -1, -1]
    for row, scene in enumerate((short, straight_road())):
        for line, (start, count) in enumerate(zip(scene.road.start.tolist(), scene.road.count.tolist(), strict=True)):
            padded = batch.road[row]
            assert padded.start[line] == start and padded.count[line] == count
            assert torch.equal(padded.points[start : start + count], scene.road.points[start : start + count])


def test_agents_are_selected_by_index_in_the_order_given_or_by_mask() -> None:
    scene = straight_road(3)
    assert select_agents(scene, torch.tensor([2, 0])).agents.track_id.tolist() == [3, 1]
    assert select_agents(scene, torch.tensor([False, True, True])).agents.track_id.tolist() == [2, 3]
    assert scene.agents.track_id.tolist() == [1, 2, 3]


def test_polylines_of_a_kind_come_in_map_order() -> None:
    left_out, right, left = straight_road().road.points[102:153], *polylines(straight_road(), [MapKind.EDGE_BOUNDARY])
    assert right[0].tolist() == [-200.0, -5.0, 0.0] and left[0].tolist() == [300.0, 5.0, 0.0]
    assert not any(torch.equal(line, left_out) for line in (right, left))


def test_recent_poses_are_those_of_the_log() -> None:
    agents = straight_road(2, speed=10.0).agents
    recent = agents.recent(5)
    assert recent.shape == (2, 6, 3)
    torch.testing.assert_close(recent[0, :, 0], torch.tensor([-5.0, -4.0, -3.0, -2.0, -1.0, 0.0]), atol=1e-5, rtol=0)


def test_holes_in_recent_poses_are_carried_back_at_constant_velocity() -> None:
    scene = straight_road(1, speed=10.0)
    full = scene.agents.recent(5)
    valid = scene.agents.valid.clone()
    valid[0, [5, 7, 8]] = False
    holed = build_scene(scene.agents.poses, [(MapKind.EDGE_BOUNDARY, torch.rand(2, 2))], valid=valid)
    torch.testing.assert_close(holed.agents.recent(5), full, atol=1e-5, rtol=0)


def test_evaluated_agents_are_the_sdc_and_those_to_predict() -> None:
    scene = straight_road(4).clone()
    scene.agents.predict[:] = torch.tensor([False, True, False, True])
    assert scene.agents.evaluated.tolist() == [True, True, False, True]


if __name__ == "__main__":
    pytest.main([__file__])
