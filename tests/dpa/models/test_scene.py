"""Contexts: map pieces, lights and histories in frames of their own."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest
import torch
from torch import Tensor

from dpa.models import collate_contexts, make_context
from dpa.models.context import keep_agents
from dpa.models.motionlm import ContextOptions, featurize
from dpa.models.scene import PIECE_POINTS
from envs.episode import HISTORY, EpisodeOptions
from envs.geometry.frames import to_world
from envs.scene import CURRENT_STEP, LightState, MapKind, Scene
from envs.sources.synthetic import build_scene, red_light, straight_road

FEATURES = ("map_points", "map_kind", "map_light", "map_valid", "light_state", "light_valid")
OF_AGENTS = ("history_valid", "extent")


def test_what_is_seen_does_not_depend_on_where_the_scene_lies(
    scene: Callable[..., Scene], move: Callable[[Scene, Tensor], Scene]
) -> None:
    motion = torch.tensor([120.0, -45.0, 2.1])
    here, there = make_context(scene(), featurize), make_context(move(scene(), motion), featurize)
    for name in FEATURES:
        torch.testing.assert_close(getattr(there, name), getattr(here, name), atol=1e-3, rtol=0)
    for name in OF_AGENTS:
        torch.testing.assert_close(getattr(there.episode, name), getattr(here.episode, name), atol=1e-3, rtol=0)
    torch.testing.assert_close(there.episode.history[..., :2], here.episode.history[..., :2], atol=1e-3, rtol=0)
    poses = [(each.map_pose, each.light_pose, each.episode.recent) for each in (here, there)]
    for mine, theirs in zip(*poses, strict=True):
        expected = to_world(mine, motion)
        torch.testing.assert_close(theirs[..., :2], expected[..., :2], atol=1e-3, rtol=0)
        torch.testing.assert_close(theirs[..., 2].cos(), expected[..., 2].cos(), atol=1e-3, rtol=0)


def test_pieces_lie_on_their_polylines_and_have_the_length_asked_for() -> None:
    scene = straight_road()
    context = make_context(scene, partial(featurize, options=ContextOptions(piece_length=25.0)))
    points = to_world(torch.nn.functional.pad(context.map_points, (0, 1)), context.map_pose[:, None])[..., :2]
    lengths = torch.diff(points, dim=1).norm(dim=-1).sum(1)
    assert ((lengths > 15) & (lengths < 35)).all()
    for kind, y in ((MapKind.LINE_BROKEN_YELLOW, 0.0), (MapKind.LANE_SURFACE_STREET, 2.5)):
        on_line = points[context.map_kind == kind]
        torch.testing.assert_close(on_line[..., 1].abs(), torch.full(on_line.shape[:-1], y), atol=1e-4, rtol=0)
    assert sum(context.map_kind == MapKind.LINE_BROKEN_YELLOW) == 20, "500 m in pieces of 25 m"


def test_map_features_without_points_have_no_pieces_wherever_they_stand() -> None:
    lines = [(MapKind.DRIVEWAY, torch.zeros(0, 2)), (MapKind.EDGE_BOUNDARY, torch.tensor([[0.0, 5.0], [10.0, 5.0]]))]
    poses = torch.zeros(1, 91, 3)
    alone = make_context(build_scene(poses, lines[1:]), featurize)
    for each in (lines, lines[::-1]):
        context = make_context(build_scene(poses, each), featurize)
        assert torch.equal(context.map_points, alone.map_points) and torch.equal(context.map_kind, alone.map_kind)
    assert len(make_context(build_scene(poses, lines[:1]), featurize).map_kind) == 0


def test_a_decision_longer_than_the_history_is_refused() -> None:
    with pytest.raises(ValueError, match="decision_steps must be at most the 10 steps of 0.1 s of the history, got 16"):
        EpisodeOptions(decision_steps=16, horizon=5)


def test_pieces_point_along_their_lane() -> None:
    context = make_context(straight_road(), featurize)
    y, heading = context.map_pose[:, 1], context.map_pose[:, 2]
    torch.testing.assert_close(heading[y == -2.5].cos(), torch.ones(int((y == -2.5).sum())))
    torch.testing.assert_close(heading[y == 2.5].cos(), -torch.ones(int((y == 2.5).sum())))


def test_the_pieces_along_which_agents_may_move_are_kept() -> None:
    """Two cars at x = 0 and -15 drive at 10 m/s: what they may reach in 8 s lies between -15 and 80."""
    few = make_context(straight_road(2, speed=10.0), partial(featurize, options=ContextOptions(max_pieces=40)))
    assert len(few.map_kind) == 40
    assert ((few.map_pose[:, 0] > -40) & (few.map_pose[:, 0] < 105)).all()
    standing = make_context(straight_road(2, speed=0.0), partial(featurize, options=ContextOptions(max_pieces=20)))
    assert (standing.map_pose[:, 0].abs() < 50).all()


def test_where_agents_really_go_has_no_say_in_what_is_seen() -> None:
    scene = straight_road(2).clone()
    before = make_context(scene, partial(featurize, options=ContextOptions(max_pieces=20)))
    scene.agents.position[:, CURRENT_STEP + 1 :] += 50.0
    scene.agents.velocity[:, CURRENT_STEP + 1 :] *= -1.0
    after = make_context(scene, partial(featurize, options=ContextOptions(max_pieces=20)))
    for name in ("map_pose", "map_points", "map_kind"):
        assert torch.equal(getattr(after, name), getattr(before, name)), name
    for name in ("history", "recent", "extent"):
        assert torch.equal(getattr(after.episode, name), getattr(before.episode, name)), name


def test_polylines_of_one_point_are_pieces_too() -> None:
    lines = [(MapKind.STOP_SIGN, torch.tensor([[3.0, 4.0]])), (MapKind.EDGE_MEDIAN, torch.rand(5, 2))]
    context = make_context(build_scene(torch.zeros(1, 91, 3), lines), featurize)
    sign = context.map_kind == MapKind.STOP_SIGN
    assert sign.sum() == 1
    assert context.map_pose[sign].tolist() == [[3.0, 4.0, 0.0]]
    assert (context.map_points[sign] == 0).all() and context.map_points.shape[1] == PIECE_POINTS


def test_lights_stand_at_their_stop_points_and_colour_their_lanes() -> None:
    scene = red_light()
    context = make_context(scene, featurize)
    torch.testing.assert_close(context.light_pose, torch.tensor([[20.0, -2.5, 0.0]]))
    assert (context.light_state == LightState.STOP + 1).all() and context.light_state.shape == (1, HISTORY)
    assert context.light_valid.tolist() == [True]
    own_lane = context.map_pose[:, 1] == -2.5
    assert (context.map_light[own_lane] == LightState.STOP + 1).all()
    assert (context.map_light[~own_lane] == 0).all()


def test_the_future_of_a_light_is_not_seen() -> None:
    scene = red_light().clone()
    before = make_context(scene, featurize)
    scene.lights.state[:, CURRENT_STEP + 1 :] = int(LightState.GO)
    assert (make_context(scene, featurize) == before).all()


def test_a_light_that_is_not_listed_now_is_not_seen() -> None:
    scene = red_light().clone()
    scene.lights.state[:, CURRENT_STEP] = int(LightState.ABSENT)
    context = make_context(scene, featurize)
    assert not context.light_valid.any() and (context.map_light == 0).all()


def test_histories_are_seen_from_now_and_end_in_the_origin() -> None:
    context = make_context(straight_road(2, speed=10.0), featurize)
    torch.testing.assert_close(context.episode.history[0, :, 0], torch.arange(-10.0, 1.0), atol=1e-4, rtol=0)
    assert (context.episode.history[:, -1] == 0).all()


def test_steps_that_the_log_misses_are_zero_and_invalid(scene: Callable[..., Scene]) -> None:
    context = make_context(scene(), featurize)
    assert context.episode.history_valid[0].tolist() == [False] * 4 + [True] * 7
    assert (context.episode.history[0, :4] == 0).all()
    assert not context.episode.logged_valid[-1, 29:49].any() and context.episode.logged_valid[-1, 49:].all()


def test_only_agents_that_are_there_now_take_part(scene: Callable[..., Scene]) -> None:
    away = scene(3).clone()
    away.agents.valid[1, CURRENT_STEP] = False
    context = make_context(away, featurize)
    assert context.episode.kind.tolist() == away.agents.kind[[0, 2]].tolist()
    assert context.episode.valid.all() and len(context.episode.recent) == 2


def test_options_bound_the_controlled_agents_and_the_horizon() -> None:
    context = make_context(straight_road(3), featurize, EpisodeOptions(max_controlled=1, horizon=4))
    assert context.episode.controlled.tolist() == [True, False, False]
    assert context.episode.logged.shape == (3, 20, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_pieces": 0}, "max_pieces must be positive, got 0"),
        ({"piece_length": -1.0}, "piece_length must be positive, got -1.0"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ContextOptions(**options)


def test_collated_contexts_are_padded_with_what_is_invalid(scene: Callable[..., Scene]) -> None:
    small, large = make_context(straight_road(1), featurize), make_context(scene(4), featurize)
    batch = collate_contexts([small, large])
    assert batch.batch_size == (2,)
    assert batch.episode.valid.tolist() == [[True, False, False, False], [True] * 4]
    assert not batch.episode.controlled[0, 1:].any() and not batch.episode.logged_valid[0, 1:].any()
    assert batch.map_valid.sum(1).tolist() == [len(small.map_kind), len(large.map_kind)]
    assert not batch.light_valid[0].any()
    assert torch.equal(batch.episode.recent[1], large.episode.recent)


def test_agents_can_be_left_out_of_a_context(scene: Callable[..., Scene]) -> None:
    context = make_context(scene(4), featurize)
    kept = keep_agents(context, torch.tensor([0, 3]))
    assert torch.equal(kept.episode.history, context.episode.history[[0, 3]]) and torch.equal(
        kept.map_pose, context.map_pose
    )
    assert len(context.episode.kind) == 4


if __name__ == "__main__":
    pytest.main([__file__])
