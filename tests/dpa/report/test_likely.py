"""The most likely rollout of each policy stands beside the log, with what goes wrong in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpa.report.likely import plot_likely
from dpa.report.panels import MARKS
from dpa.report.player import PlayerScene
from envs.sources.synthetic import two_cars_head_on
from tests.dpa.report.drawings import marks
from tests.dpa.report.made_rollouts import COLLISION, OFFROAD, judged, made_players, slower, with_mishaps


def test_every_scene_shows_its_log_and_the_most_likely_rollout_of_each_policy(drawn: list[Any], tmp_path: Path) -> None:
    players = made_players()
    plot_likely(players, tmp_path / "likely.png")
    shown = [axes.get_title().split(", distance")[0] for axes in drawn[0].axes if axes.axison]
    road, light = (player.scene.scene_id for player in players)
    assert shown == [
        f"log of {road}", "reference\n-1.00 nats per token", "DPA-OMF\n-0.50 nats per token",
        f"log of {light}", "reference\n-1.25 nats per token",
    ]  # fmt: skip
    assert (tmp_path / "likely.png").stat().st_size > 10_000


def test_the_first_collision_and_departure_of_each_agent_are_marked(drawn: list[Any], tmp_path: Path) -> None:
    players = made_players()[:1]
    plot_likely(players, tmp_path / "likely.png")
    poses = with_mishaps(players[0].scene).numpy()
    log, reference, aligned = drawn[0].axes
    np.testing.assert_allclose(marks(reference, "collision"), poses[:2, COLLISION.start, :2], rtol=1e-6)
    np.testing.assert_allclose(marks(reference, "off road"), poses[2:, OFFROAD.start, :2], rtol=1e-6)
    assert not any(len(marks(axes, name)) for axes in (log, aligned) for name in MARKS)
    told = {text.get_text() for text in drawn[0].legends[0].get_texts()}
    assert {"collision, not in the log", "off road, not in the log"} < told


def test_who_collides_in_the_log_as_well_is_not_marked(drawn: list[Any], tmp_path: Path) -> None:
    scene = two_cars_head_on()
    player = PlayerScene(scene, {"reference": judged(scene, [slower(scene, 0.0)], [-1.0])})
    assert player.rollouts["reference"].collides.any()
    plot_likely([player], tmp_path / "likely.png")
    assert not any(len(marks(axes, name)) for axes in drawn[0].axes for name in MARKS)
    assert not [text for text in drawn[0].legends[0].get_texts() if "not in the log" in text.get_text()]


def test_no_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no scene to draw"):
        plot_likely([], tmp_path / "likely.png")
    assert not list(tmp_path.iterdir())


if __name__ == "__main__":
    pytest.main([__file__])
