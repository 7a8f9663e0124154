"""Pictures show what the scene holds: the right boxes, in the right colours, at the right place and time."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgb
from numpy.typing import NDArray
from PIL import Image

from envs.render import View, fit_view, pose_tracks, render_frame, render_frames, save_picture, style
from envs.render import __main__ as command_line
from envs.render.picture import legend_handles
from envs.scene import CURRENT_STEP, LOG_STEPS, AgentKind, Scene
from envs.sources.synthetic import red_light, straight_road, two_cars_head_on

HERE = View(0.0, 0.0, 50.0)
PIXELS = 500


def shown(picture: NDArray[np.uint8], color: str) -> NDArray[np.bool_]:
    """``[H, W]``: pixels of exactly this colour."""
    return (picture == np.round(np.array(to_rgb(color)) * 255).astype(np.uint8)).all(-1)


def pixel(x: float, y: float, view: View = HERE) -> tuple[int, int]:
    """Row and column of a point."""
    metre = PIXELS / (2 * view.radius)
    return int((view.radius - (y - view.y)) * metre), int((x - view.x + view.radius) * metre)


def test_log_tracks_are_absent_where_the_log_is_not_valid() -> None:
    scene = straight_road(num_vehicles=2)
    scene.agents.valid[1, 30:40] = False
    tracks = pose_tracks(scene)
    assert tracks.isnan().all(-1)[1].nonzero()[:, 0].tolist() == list(range(30, 40))
    torch.testing.assert_close(tracks[0, :, :2], scene.agents.position[0, :, :2])


@pytest.mark.parametrize("width", [3, 4])
def test_rollouts_replace_the_future_and_only_of_present_agents(width: int) -> None:
    scene = straight_road(num_vehicles=3)
    scene.agents.valid[1, CURRENT_STEP] = False
    rollout = torch.full((2, 80, width), 5.0)
    rollout[..., 2:] = torch.arange(2, width) * 10.0
    tracks = pose_tracks(scene, rollout)
    torch.testing.assert_close(tracks[[0, 2], : CURRENT_STEP + 1], pose_tracks(scene)[[0, 2], : CURRENT_STEP + 1])
    # The last value is the heading, with or without a z before it.
    assert tracks[[0, 2], CURRENT_STEP + 1 :].unique(dim=1).tolist() == [[[5.0, 5.0, (width - 1) * 10.0]]] * 2
    assert tracks[1, CURRENT_STEP:].isnan().all()


def test_a_shorter_rollout_leaves_the_rest_absent() -> None:
    tracks = pose_tracks(straight_road(num_vehicles=1), torch.zeros(1, 20, 3))
    assert tracks[0, :, 0].isfinite().sum() == CURRENT_STEP + 1 + 20


@pytest.mark.parametrize("shape", [(1, 80, 3), (2, 81, 3), (2, 80, 2), (2, 80)])
def test_rollouts_that_do_not_fit_are_refused_with_their_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"A'=2.*" + str(list(shape))[1:-1]):
        pose_tracks(straight_road(num_vehicles=2), torch.zeros(shape))


def test_the_view_holds_the_evaluated_paths_and_centres_on_the_sdc_if_they_are_too_long() -> None:
    near, far = straight_road(num_vehicles=2, speed=5.0), straight_road(num_vehicles=2, speed=40.0)
    view = fit_view(near)
    assert (near.agents.position[..., 0] - view.x).abs().max() <= view.radius
    assert fit_view(far) == View(0.0, -2.5, 90.0)


def test_agents_stand_where_the_scene_puts_them_in_the_colour_of_their_class() -> None:
    scene = straight_road(num_vehicles=3, gap=20.0)
    scene.agents.kind[2] = AgentKind.CYCLIST
    picture = render_frame(scene, view=HERE, trails=False, pixels=PIXELS)
    for x, color in ((0, style.SDC_COLOR), (-20, style.AGENT_COLORS[AgentKind.VEHICLE])):
        # A metre behind the centre: the front carries the light nose.
        assert shown(picture, color)[pixel(x - 1, -2.5)], color
    assert not shown(picture, style.AGENT_COLORS[AgentKind.VEHICLE])[pixel(-41, -2.5)]
    assert shown(picture, style.GROUND_COLOR)[pixel(0, 30)]


def test_an_absent_agent_is_not_drawn() -> None:
    scene = straight_road(num_vehicles=2)
    scene.agents.valid[1, 50] = False
    blue = style.AGENT_COLORS[AgentKind.VEHICLE]
    view = View(30.0, 0.0, 50.0)
    here, gone = (render_frame(scene, step=s, view=view, trails=False, pixels=PIXELS) for s in (49, 50))
    legend = slice(0, 100)  # has a swatch of the class, drawn or not
    here[legend], gone[legend] = 0, 0
    assert shown(here, blue).sum() > 50
    assert not shown(gone, blue).any()


def test_a_rollout_moves_the_boxes_of_the_future_and_not_those_of_the_past() -> None:
    scene = straight_road(num_vehicles=1)
    rollout = torch.tensor([20.0, 20.0, 0.0]).expand(1, 80, 3)
    after = render_frame(scene, rollout, step=30, view=HERE, trails=False, pixels=PIXELS)
    assert shown(after, style.SDC_COLOR)[pixel(19, 20)]
    before = [render_frame(scene, given, step=5, view=HERE, trails=False, pixels=PIXELS) for given in (None, rollout)]
    np.testing.assert_array_equal(*before)


def test_a_red_light_is_drawn_at_its_stop_point_and_only_while_listed() -> None:
    scene = red_light()
    scene.lights.state[0, 40:] = -1
    red = style.LIGHT_STYLE[style.STOP][1]
    at = pixel(20, -2.5)
    assert shown(render_frame(scene, step=0, view=HERE, trails=False, pixels=PIXELS), red)[at]
    assert not shown(render_frame(scene, step=40, view=HERE, trails=False, pixels=PIXELS), red)[at]


def test_frames_of_an_animation_equal_single_pictures() -> None:
    scene = two_cars_head_on()
    for step, frame in zip([0, 90, 30], render_frames(scene, steps=[0, 90, 30], pixels=200), strict=True):
        np.testing.assert_array_equal(frame, render_frame(scene, step=step, pixels=200))


def test_a_step_outside_the_scene_is_refused() -> None:
    with pytest.raises(ValueError, match="0 to 90, got 91"):
        render_frame(straight_road(), step=91)


def test_pictures_are_written_whole_as_png_and_gif(tmp_path: Path) -> None:
    frames = list(render_frames(straight_road(), steps=range(0, 12, 4), pixels=120))
    save_picture(tmp_path / "one.png", frames[:1])
    with Image.open(tmp_path / "one.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture), frames[0])
    save_picture(tmp_path / "all.gif", frames)
    with Image.open(tmp_path / "all.gif") as gif:
        assert (gif.n_frames, gif.info["duration"], gif.size) == (3, 100, (120, 120))
    for name, refused in (("two.png", frames), ("film.avi", frames), ("none.gif", [])):
        with pytest.raises(ValueError, match=name):
            save_picture(tmp_path / name, refused)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["all.gif", "one.png"]


def test_a_film_has_every_frame_in_even_sides(tmp_path: Path) -> None:
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")
    save_picture(tmp_path / "all.mp4", render_frames(straight_road(), steps=range(0, 12, 4), pixels=121))
    assert [file.name for file in tmp_path.iterdir()] == ["all.mp4"]
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "all.mp4")) == (3, pytest.approx(0.3))


def test_a_film_without_its_extra_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"dpa-omf\[video\]"):
        save_picture(tmp_path / "all.mp4", render_frames(straight_road(), steps=[1, 2], pixels=120))
    assert not list(tmp_path.iterdir())


def test_a_gif_keeps_the_colour_of_a_class_that_is_a_few_pixels_large(tmp_path: Path) -> None:
    scene = straight_road(num_vehicles=3)
    scene.agents.kind[1:] = torch.tensor([AgentKind.PEDESTRIAN, AgentKind.CYCLIST])
    scene.agents.extent[1:] = torch.tensor([2.0, 1.0, 1.7])
    save_picture(tmp_path / "x.gif", render_frames(scene, steps=[10, 11], view=HERE, pixels=PIXELS))
    with Image.open(tmp_path / "x.gif") as gif:
        picture = np.asarray(gif.convert("RGB"))
    for x, kind in ((-15, AgentKind.PEDESTRIAN), (-30, AgentKind.CYCLIST)):
        assert shown(picture, style.AGENT_COLORS[kind])[pixel(x - 0.5, -2.5)], kind


@pytest.fixture
def store(tmp_path: Path, write_store: Callable) -> Path:
    """A store with the scenes ``straight_road`` and ``two_cars_head_on``."""
    return write_store(tmp_path / "store", [straight_road(1), two_cars_head_on()])


def test_the_command_finds_a_scene_by_id_and_by_index(store: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    for name in ("two_cars_head_on", "1"):
        command_line.main([str(store), "--scene", name, "--out", str(tmp_path / f"{name}.png"), "--pixels", "120"])
    assert (tmp_path / "1.png").read_bytes() == (tmp_path / "two_cars_head_on.png").read_bytes()
    monkeypatch.chdir(tmp_path)
    command_line.main([str(store), "--scene", "1", "--pixels", "120"])
    assert capsys.readouterr().out.splitlines()[-1] == "two_cars_head_on.png"
    command_line.main([str(store), "--scene", "0", "--out", str(tmp_path / "film.gif"), "--pixels", "80"])
    with Image.open(tmp_path / "film.gif") as gif:
        # Pillow may merge equal frames, but the cars move in every step.
        assert gif.n_frames == LOG_STEPS


@pytest.mark.parametrize(
    "extra",
    [
        ["--scene", "nowhere"],
        ["--scene", "2"],
        ["--scene", "0", "--radius", "-3"],
        ["--scene", "0", "--step", "91"],
        ["--scene", "0", "--out", "scene.svg"],
        ["--scene", "0", "--pixels", "0"],
        ["--scene", "0", "--out", "nowhere/scene.png"],
    ],
)
def test_the_command_refuses_what_it_cannot_draw(
    extra: list[str], store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        command_line.main([str(store), "--out", str(tmp_path / "x.png"), *extra])
    assert extra[-1].strip("-") in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [store]


def test_the_legend_names_lights_and_stop_signs_where_the_scene_has_them() -> None:
    def names(scene: Scene) -> list[str]:
        return [handle.get_label() for handle in legend_handles(scene)]

    assert names(straight_road(2)) == ["SDC", "Vehicle"]
    assert names(red_light())[-1] == "Light: stop"


if __name__ == "__main__":
    pytest.main([__file__])
