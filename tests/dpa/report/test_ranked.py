"""The nearest and the farthest rollouts stand on one window of the map, with what goes wrong in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from dpa.ranking import log_trajectory
from dpa.report.canvas import blank_figure
from dpa.report.panels import draw_legend
from dpa.report.ranked import incidents, plot_ranked
from envs.scene import Scene
from envs.sources.synthetic import straight_road, two_cars_head_on
from tests.dpa.report.drawings import marks

EVERYBODY = torch.tensor([0, 1])


@pytest.fixture
def scene() -> Scene:
    return straight_road(2, speed=10.0, gap=15.0)


@pytest.fixture
def rollouts(scene: Scene) -> Tensor:
    """``[4, A, 80, 4]``: 0 is the log, 1 hits a stopped car, 2 leaves the road, 3 is a little slow."""
    log = log_trajectory(scene, 80)
    stopped, away, slow = log.clone(), log.clone(), log.clone()
    stopped[0] = stopped[0, :1]
    away[0, :, 1] -= torch.linspace(0, 30, 80)
    slow[0, :, 0] -= torch.linspace(0, 2, 80)
    return torch.stack((log, stopped, away, slow))


def test_the_first_collision_and_the_first_step_off_the_road_are_found(scene: Scene, rollouts: Tensor) -> None:
    found = incidents(scene, rollouts, EVERYBODY)
    assert (found.collision[[0, 2, 3]] == -1).all()
    assert (found.collision[1] >= 0).all() and found.collision[1, 0] == found.collision[1, 1]
    assert (found.offroad[[0, 1, 3]] == -1).all()
    assert found.offroad[2, 0] >= 0 and found.offroad[2, 1] == -1


def test_what_happens_in_the_log_too_is_no_incident() -> None:
    scene = two_cars_head_on()
    log = log_trajectory(scene, 80)
    assert (incidents(scene, log[None], EVERYBODY).collision == -1).all()


def test_rollouts_stand_in_order_of_their_rank_beside_the_log(
    scene: Scene, rollouts: Tensor, tmp_path: Path, drawn: list[Any]
) -> None:
    distance = torch.tensor([0.0, 9.0, 5.0, 1.0])
    plot_ranked(scene, rollouts, distance, EVERYBODY, tmp_path / "r.png", each=2)
    assert [axes.get_title() for axes in drawn[0].axes] == [
        "log",
        "rank 0: distance 0.00 (rollout 0)",
        "rank 1: distance 1.00 (rollout 3)",
        "rank 2: distance 5.00 (rollout 2)",
        "rank 3: distance 9.00 (rollout 1)",
    ]
    windows = {(*axes.get_xlim(), *axes.get_ylim()) for axes in drawn[0].axes}
    assert len(windows) == 1, "all panels show the same piece of the map"
    assert all(axes.get_aspect() == 1 for axes in drawn[0].axes)
    assert (tmp_path / "r.png").is_file()


def test_marks_stand_where_things_happen_and_only_there(
    scene: Scene, rollouts: Tensor, tmp_path: Path, drawn: list[Any]
) -> None:
    plot_ranked(scene, rollouts, torch.tensor([0.0, 9.0, 5.0, 1.0]), EVERYBODY, tmp_path / "r.png", each=2)
    found = incidents(scene, rollouts, EVERYBODY)
    collisions = [marks(axes, "collision") for axes in drawn[0].axes]
    assert [len(points) for points in collisions] == [0, 0, 0, 0, 2]
    at = int(found.collision[1, 0])
    np.testing.assert_allclose(collisions[-1], rollouts[1, :, at, :2], rtol=1e-6)
    assert [len(marks(axes, "off road")) for axes in drawn[0].axes] == [0, 0, 0, 1, 0]
    legend = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert {"path in the log", "collision, not in the log", "off road, not in the log"} < set(legend)


def test_a_mark_that_is_not_used_is_not_explained(
    scene: Scene, rollouts: Tensor, tmp_path: Path, drawn: list[Any]
) -> None:
    plot_ranked(scene, rollouts[[0, 3]], torch.tensor([0.0, 1.0]), EVERYBODY, tmp_path / "r.png", each=1)
    assert not [text for text in drawn[0].legends[0].get_texts() if "not in the log" in text.get_text()]


@pytest.mark.parametrize(("width", "one_row"), [(2.55, False), (4.0, False), (5.1, False), (20.0, True)])
def test_the_legend_is_as_wide_as_the_figure_allows(
    scene: Scene, rollouts: Tensor, width: float, one_row: bool
) -> None:
    figure = blank_figure(width, 4.0)
    figure.subplots()
    draw_legend(figure, [scene], [incidents(scene, rollouts, EVERYBODY)])
    figure.draw_without_rendering()
    (legend,) = figure.legends
    box = legend.get_window_extent()
    assert box.x0 >= 0 and box.x1 <= figure.bbox.width, "nothing is cut off"
    assert (legend._ncols == len(legend.get_texts())) == one_row


@pytest.mark.parametrize("each", [0, 3])
def test_more_rollouts_than_there_are_are_refused(scene: Scene, rollouts: Tensor, tmp_path: Path, each: int) -> None:
    with pytest.raises(ValueError, match=f"each must be 1 to 2, half of the 4 rollouts, got {each}"):
        plot_ranked(scene, rollouts, torch.arange(4.0), EVERYBODY, tmp_path / "r.png", each=each)
    assert not list(tmp_path.iterdir())


if __name__ == "__main__":
    pytest.main([__file__])
