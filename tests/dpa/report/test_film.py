"""The most likely rollouts in motion: as many frames as a scene has, and marks from the moment on."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from PIL import Image

from dpa.report.film import HELD, _moment, _panels, film_likely
from dpa.report.player import PlayerScene
from envs.scene import CURRENT_STEP
from tests.dpa.report.made_rollouts import COLLISION, OFFROAD, made_players

FRAMES = 41 + HELD


def alike() -> list[PlayerScene]:
    """Two scenes with rollouts of the one policy that both have."""
    return [PlayerScene(each.scene, {"reference": each.rollouts["reference"]}) for each in made_players()]


@pytest.mark.parametrize("scenes", [1, 2])
def test_scenes_follow_each_other_eight_seconds_each(scenes: int, tmp_path: Path) -> None:
    film_likely(alike()[:scenes], tmp_path / "likely.gif")
    with Image.open(tmp_path / "likely.gif") as film:
        total = sum(_duration(film, frame) for frame in range(film.n_frames))
        assert film.size[0] > 1.5 * film.size[1], "two panels, side by side"
    assert total == pytest.approx(200 * FRAMES * scenes)


def _duration(film: Image.Image, frame: int) -> int:
    film.seek(frame)  # equal frames are stored once, and shown for longer
    return film.info["duration"]


def marks_at(step: int) -> dict[str, int]:
    """Marks in the panels of the first scene at a simulated step."""
    player = made_players()[0]
    places = Figure().subplots(1, 1 + len(player.rollouts))
    panels = _panels(player, places)
    return {
        name: sum(
            len(artist.get_offsets())
            for artist in _moment(panel, player.scene, CURRENT_STEP + 1 + step)
            if isinstance(artist, PathCollection)
        )
        for name, panel in zip(("log", *player.rollouts), panels, strict=True)
    }


def test_an_agent_is_marked_from_the_moment_on_that_it_collides_or_leaves_the_road() -> None:
    assert marks_at(COLLISION.start - 1) == {"log": 0, "reference": 0, "DPA-OMF": 0}
    assert marks_at(COLLISION.start) == {"log": 0, "reference": 2, "DPA-OMF": 0}
    assert marks_at(COLLISION.stop + 1)["reference"] == 2, "it is not forgotten"
    assert marks_at(OFFROAD.start)["reference"] == 3


def test_no_scene_and_scenes_of_different_policies_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no scene to film"):
        film_likely([], tmp_path / "likely.gif")
    with pytest.raises(ValueError, match="need the same policies"):
        film_likely(made_players(), tmp_path / "likely.gif")
    assert not list(tmp_path.iterdir())


def test_a_film_that_is_none_is_refused_before_any_work(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must end in .gif or .mp4, got .*likely.png"):
        film_likely(alike(), tmp_path / "likely.png")
