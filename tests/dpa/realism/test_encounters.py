"""How agents met whom they collided with first."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dpa.realism import Encounter, RealismConfig, class_rates, compare, encounters, measure
from dpa.realism.encounters import encounter_of
from envs.geometry.frames import rotate
from envs.scene import CURRENT_STEP, MapKind, Scene
from envs.sources.synthetic import build_scene, straight_road

METRIC = RealismConfig.load("2024")
CAR = (4.0, 2.0)


def met(scene: Scene, trajectories: Tensor) -> Tensor:
    comparison = compare(scene, trajectories, METRIC)
    return encounters(comparison.tracks, measure([comparison], METRIC)[0], METRIC)


def parked(*places: tuple[float, float]) -> Scene:
    """Cars that stand headed along x."""
    poses = torch.tensor(places)[:, None].expand(-1, 91, -1)
    poses = torch.cat((poses, torch.zeros_like(poses[..., :1])), -1)
    return build_scene(poses, [(MapKind.EDGE_BOUNDARY, torch.tensor([[250.0, 30.0], [-50.0, 30.0]]))])


def logged(scene: Scene) -> Tensor:
    """``[1, A, 80, 4]``."""
    agents = scene.agents
    return agents.trajectory[None, :, CURRENT_STEP + 1 :].clone()


@pytest.mark.parametrize(
    ("place", "heading", "told"),
    [
        ((0.5, 1.8), 0.1, Encounter.BESIDE),
        ((-1.5, -1.8), -0.7, Encounter.BESIDE),
        ((3.8, 0.5), 0.0, Encounter.IN_LINE),
        ((-3.8, -1.0), 0.2, Encounter.IN_LINE),
        ((2.5, 0.0), math.pi / 2, Encounter.CROSSING),
        ((2.5, 1.0), -2.0, Encounter.CROSSING),
        ((3.5, 0.0), math.pi, Encounter.ONCOMING),
        ((0.0, 1.5), -3.0, Encounter.ONCOMING),
    ],
)
def test_an_encounter_is_told_by_where_the_other_is_and_where_it_heads(
    place: tuple[float, float], heading: float, told: Encounter
) -> None:
    own, other = torch.tensor([[0.0, 0.0, 0.0, *CAR]]), torch.tensor([[*place, heading, *CAR]])
    assert encounter_of(own, other).item() == told


@given(turn=st.floats(-math.pi, math.pi), x=st.floats(-3, 3), y=st.floats(-1.5, 1.5), heading=st.floats(-3, 3))
def test_an_encounter_does_not_depend_on_where_north_is(turn: float, x: float, y: float, heading: float) -> None:
    own, other = torch.tensor([[0.0, 0.0, 0.0, *CAR]]).double(), torch.tensor([[x, y, heading, *CAR]]).double()
    edges = (abs(abs(heading) - edge) for edge in (math.pi / 4, 3 * math.pi / 4))
    if min(*edges, abs((4 - abs(x)) - (2 - abs(y)))) < 1e-6:
        return  # on the border of two, rounding decides
    turned = [box.clone() for box in (own, other)]
    for box in turned:
        box[:, :2] = rotate(box[:, :2], torch.tensor([turn]).double()) + 7.0
        box[:, 2] += turn
    assert encounter_of(*turned).item() == encounter_of(own, other).item()


def test_the_first_collision_of_an_agent_counts() -> None:
    """The car at the origin is pushed aside into its neighbour, and later back and forwards into the one ahead."""
    scene = parked((0.0, 0.0), (0.0, 4.0), (12.0, 0.0))
    driven = logged(scene).repeat(2, 1, 1, 1)
    driven[0, 0, 20:40, 1], driven[0, 0, 40:, 0] = 3.0, 8.0
    driven[1, 0, 20:, 0] = 8.0
    found = met(scene, driven)
    assert found[0].tolist() == [Encounter.NONE] * 3, "the log"
    assert found[1].tolist() == [Encounter.BESIDE, Encounter.BESIDE, Encounter.IN_LINE]
    assert found[2].tolist() == [Encounter.IN_LINE, Encounter.NONE, Encounter.IN_LINE]


def test_who_has_left_in_its_log_collides_no_more() -> None:
    scene = parked((0.0, 0.0), (0.0, 4.0))
    scene.agents.valid[0, CURRENT_STEP + 11 :] = False
    driven = logged(scene)
    driven[0, 0, 20:, 1] = 3.0
    assert met(scene, driven)[1].tolist() == [Encounter.NONE, Encounter.BESIDE]


def test_as_many_meet_somebody_as_the_collision_rate_counts() -> None:
    for seed in range(3):
        scene = straight_road(6, seed=seed)
        noise = torch.randn(8, 6, 1, 4, generator=torch.Generator().manual_seed(seed)) * torch.tensor([9.0, 2, 0, 0.5])
        comparison = compare(scene, logged(scene) + noise, METRIC)
        measured = measure([comparison], METRIC)[0]
        found = encounters(comparison.tracks, measured, METRIC)
        share = (found[1:] != Encounter.NONE).float().mean().item()
        assert 0 < share == pytest.approx(class_rates(measured, METRIC)["vehicle_collision"])


if __name__ == "__main__":
    pytest.main([__file__])
