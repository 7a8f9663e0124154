"""The picture of a coupling holds the numbers of the preference distance, and each feature's part of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgba
from PIL import Image
from torch import Tensor

from dpa.ranking import FEATURE_SETS, FEATURES, PreferenceDistance, log_trajectory
from dpa.report import coupling
from dpa.report.coupling import AgentCoupling, agent_name, couple_agent, coupled_values, plot_coupling
from envs.scene import Scene
from envs.sources.synthetic import straight_road

COARSE = PreferenceDistance(stride=5)


@pytest.fixture
def scene() -> Scene:
    return straight_road(3, seed=4)


@pytest.fixture
def braking(scene: Scene) -> Tensor:
    """``[A, 80, 4]``: everybody brakes and drifts to the left."""
    log = log_trajectory(scene, 80)
    time = torch.linspace(0, 1, 80)
    return log + torch.stack((-12 * time**2, 3 * time, torch.zeros(80), torch.zeros(80)), -1)


def with_hole(scene: Scene) -> Scene:
    scene.agents.valid[1, 30:50] = False
    return scene


# --- numbers --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("hole", [False, True])
@pytest.mark.parametrize(
    "distance",
    [
        COARSE,
        PreferenceDistance(),
        PreferenceDistance(features=["speed", "clearance"], weights={"speed": 3.0}, clips={"clearance": (0.0, 5.0)}),
        PreferenceDistance(method="time_aligned", stride=2),
    ],
)
def test_an_agent_is_coupled_as_the_distance_couples_it(
    scene: Scene, braking: Tensor, distance: PreferenceDistance, hole: bool
) -> None:
    scene = with_hole(scene) if hole else scene
    ranked = distance(scene, braking[None]).agent_distance[0]
    coupled = [couple_agent(distance, scene, braking, agent) for agent in range(3)]
    np.testing.assert_allclose([one.distance for one in coupled], ranked, rtol=1e-6)
    for one in coupled:
        assert one.distance <= one.time_aligned + 1e-6
        paid = torch.where(one.coupling > 0, one.coupling * one.cost, 0).sum()
        assert float(paid) == pytest.approx(one.distance, rel=1e-5)
        assert float(one.parts.sum()) == pytest.approx(one.distance, rel=1e-5)
        assert (one.cost.isnan() == ~(one.valid[:, None] & one.valid)).all()


def test_seconds_are_those_of_the_measured_steps(scene: Scene, braking: Tensor) -> None:
    coupled = couple_agent(COARSE, scene, braking, 0)
    np.testing.assert_allclose(coupled.seconds, np.arange(1, 17) * 0.5, rtol=1e-6)


def test_the_log_itself_costs_nothing(scene: Scene) -> None:
    coupled = couple_agent(COARSE, scene, log_trajectory(scene, 80), 0)
    assert coupled.distance == coupled.time_aligned == 0
    assert (coupled.parts == 0).all()


def test_an_agent_that_the_log_loses_at_once_is_refused(scene: Scene, braking: Tensor) -> None:
    scene.agents.valid[1, 11:] = False
    with pytest.raises(ValueError, match=r"agent 1 of scene .* has no valid step in the log; choose another agent"):
        couple_agent(COARSE, scene, braking, 1)


def test_a_step_of_the_log_that_two_steps_share_is_weighed_by_mass() -> None:
    coupled = AgentCoupling(
        names=("speed",),
        seconds=torch.tensor([0.1, 0.2, 0.3]),
        valid=torch.tensor([True, True, False]),
        rollout=torch.zeros(3, 1),
        log=torch.tensor([[2.0], [6.0], [100.0]]),
        cost=torch.zeros(3, 3),
        coupling=torch.tensor([[0.375, 0.125, 0], [0, 0.5, 0], [0, 0, 0]]),
        parts=torch.zeros(1),
        distance=0.0,
        time_aligned=0.0,
    )
    np.testing.assert_allclose(coupled_values(coupled)[:, 0], [3.0, 6.0, np.nan])


# --- picture --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("hole", [False, True])
def test_the_matrix_shows_the_coupling_and_the_cost(
    scene: Scene, braking: Tensor, tmp_path: Path, drawn: list[Any], hole: bool
) -> None:
    scene = with_hole(scene) if hole else scene
    coupled = couple_agent(COARSE, scene, braking, 1)
    plot_coupling(scene, braking, 1, coupled, tmp_path / "a.png", title="one agent")
    tracks, matrix, parts = drawn[0].axes[:3]
    np.testing.assert_allclose(matrix.images[0].get_array().filled(np.nan), coupled.cost)
    log, rollout = np.rint(matrix.collections[0].get_offsets() / 0.5).astype(int).T - 1
    shown = np.zeros((16, 16))
    shown[rollout, log] = 1 / len(log)
    np.testing.assert_allclose(shown, coupled.coupling, rtol=1e-6)
    assert matrix.get_xlabel() == "time in the log [s]" and matrix.get_ylabel() == "time in the rollout [s]"
    assert f"distance {coupled.distance:.2f}, time-aligned {coupled.time_aligned:.2f}" in matrix.get_title()
    assert tracks.get_aspect() == 1
    np.testing.assert_allclose([bar.get_width() for bar in parts.patches], coupled.parts, rtol=1e-6)
    assert drawn[0].get_suptitle() == "one agent"
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.format == "PNG"


def test_each_feature_has_a_panel_with_its_unit(
    scene: Scene, braking: Tensor, tmp_path: Path, drawn: list[Any]
) -> None:
    coupled = couple_agent(COARSE, scene, braking, 0)
    plot_coupling(scene, braking, 0, coupled, tmp_path / "a.png", title="one agent")
    panels = [axes for axes in drawn[0].axes if axes.get_xlabel() == "time [s]"]
    titles = [axes.get_title() for axes in panels]
    assert titles == ["collision", "road edge [m]", "clearance [m]", "effort [m/s²]", "speed [m/s]"]
    log, partner, rollout = (line.get_ydata() for line in panels[-1].lines)
    np.testing.assert_allclose(log, coupled.log[:, -1])
    np.testing.assert_allclose(rollout, coupled.rollout[:, -1])
    np.testing.assert_allclose(sorted(partner), sorted(log), rtol=1e-6, err_msg="a coupling permutes the log")


def test_differences_that_cost_nothing_are_not_blown_up(scene: Scene, tmp_path: Path, drawn: list[Any]) -> None:
    log = log_trajectory(scene, 80)
    plot_coupling(scene, log, 0, couple_agent(COARSE, scene, log, 0), tmp_path / "a.png", title="the log")
    ranges = [np.ptp(axes.get_ylim()) for axes in drawn[0].axes if axes.get_xlabel() == "time [s]"]
    least = [0.999 * coupling.LEAST_RANGE * np.ptp(FEATURES[name].clip) for name in FEATURE_SETS["full"]]
    assert (np.array(ranges) >= least).all() and ranges[0] > 1


def test_both_tracks_lie_in_the_window(scene: Scene, braking: Tensor, tmp_path: Path, drawn: list[Any]) -> None:
    coupled = couple_agent(COARSE, scene, braking, 2)
    plot_coupling(scene, braking, 2, coupled, tmp_path / "a.png", title="one agent")
    axes = drawn[0].axes[0]
    rims = [c for c in axes.collections if len(c.get_linewidth()) and c.get_linewidth()[0] == coupling.RIM]
    colors = [tuple(c.get_color()[0]) for c in rims]
    assert colors == [to_rgba(coupling.LOG_COLOR), to_rgba(coupling.ROLLOUT_COLOR)]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    for rim in rims:
        points = np.concatenate(rim.get_segments())
        assert ((points > (left, low)) & (points < (right, high))).all()


def test_more_features_than_fit_a_row_go_into_two(
    scene: Scene, braking: Tensor, tmp_path: Path, drawn: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coupling, "FEATURES_IN_A_ROW", 3)
    plot_coupling(scene, braking, 0, couple_agent(COARSE, scene, braking, 0), tmp_path / "a.png", title="five features")
    assert len([axes for axes in drawn[0].axes if axes.axison]) == 3 + 1 + 5


def test_an_agent_is_named_by_row_class_and_id(scene: Scene) -> None:
    scene.agents.track_id[:] = torch.tensor([70, 80, 90])
    scene.agents.valid[0, 10] = False
    assert agent_name(scene, 0) == "agent 0 (vehicle, id 80)"
    scene.agents.sdc[2] = True
    assert agent_name(scene, 1) == "agent 1 (SDC, id 90)"


def test_a_file_that_is_no_png_is_refused(scene: Scene, braking: Tensor, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must end in .png"):
        plot_coupling(scene, braking, 0, couple_agent(COARSE, scene, braking, 0), tmp_path / "a.pdf", title="")


if __name__ == "__main__":
    pytest.main([__file__])
