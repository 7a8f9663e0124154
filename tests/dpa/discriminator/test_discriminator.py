"""What a discriminator sees, how masks hide what it must not see, and the measures beside it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dpa.discriminator import (
    OWN,
    ROAD,
    Discriminator,
    auc,
    discriminator_loss,
    mean_squared_jerk,
    observed_motion,
    until_first_hole,
    width_of,
)
from dpa.ranking import log_trajectory
from envs.geometry.frames import rotate
from envs.scene import CURRENT_STEP, MapKind, Scene
from envs.sources.synthetic import build_scene, straight_road

TIME = (torch.arange(91) - CURRENT_STEP) * 0.1


def turned(scene: Scene, angle: float, shift: Tensor) -> Scene:
    """The whole scene turned and moved."""
    moved = scene.clone()
    turn = torch.tensor(angle)
    moved.agents.position[..., :2] = rotate(scene.agents.position[..., :2], turn) + shift
    moved.agents.heading = scene.agents.heading + turn
    moved.road.points[..., :2] = rotate(scene.road.points[..., :2], turn) + shift
    return moved


def of_log(scene: Scene, **options) -> tuple[Tensor, Tensor]:
    values, valid = observed_motion(scene, log_trajectory(scene, 80)[None], **options)
    return values[0], valid


# --- what is seen ---------------------------------------------------------------------------------------------------
def test_of_a_log_through_tokens_the_decision_with_the_hole_is_not_seen() -> None:
    scene = straight_road(1, speed=10.0)
    scene.agents.valid[0, CURRENT_STEP + 8] = False
    seen = [int(of_log(scene, stride=1, decision_steps=steps)[1].sum()) for steps in (1, 5)]
    assert seen == [7, 5]


def test_own_motion_is_speed_turn_and_acceleration_in_the_own_frame() -> None:
    accelerating = torch.stack((2 * TIME + TIME**2, torch.full_like(TIME, 1.0), torch.zeros_like(TIME)), -1)[None]
    lane = torch.tensor([[-100.0, 1.0], [200.0, 1.0]])
    scene = build_scene(accelerating, [(MapKind.EDGE_BOUNDARY, lane + 5), (MapKind.LANE_SURFACE_STREET, lane)])
    own = of_log(scene)[0][0, :, : len(OWN)]
    ends = 0.5 * torch.arange(1, 17)
    mean_speed = 2 + 2 * (ends - 0.25)
    assert torch.allclose(own[:, 0], mean_speed, atol=1e-3) and torch.allclose(own[:, 2], mean_speed, atol=1e-3)
    assert torch.allclose(own[:, 4], torch.full((16,), 2.0), atol=1e-2)
    assert own[:, [1, 3, 5]].abs().max() < 1e-3


def test_a_turning_agent_turns_at_its_rate() -> None:
    angle = 0.4 * TIME
    circle = torch.stack((20 * angle.sin(), 20 * (1 - angle.cos()), angle), -1)[None]
    edge = torch.tensor([[-100.0, -50.0], [100.0, -50.0]])
    scene = build_scene(circle, [(MapKind.EDGE_BOUNDARY, edge)])
    own = of_log(scene, road=("road_edge",))[0][0, :, : len(OWN)]
    assert torch.allclose(own[:, 3], torch.full((16,), 0.4), atol=1e-3)
    # The chord of a step lies half a step's turn to the left.
    assert torch.allclose(torch.atan2(own[:, 1], own[:, 0]), torch.full((16,), 0.1), atol=1e-3)


def test_where_a_scene_lies_and_how_it_is_turned_is_not_seen() -> None:
    scene = straight_road(4, seed=1)
    values, valid = of_log(scene)
    again, same = of_log(turned(scene, 1.1, torch.tensor([300.0, -40.0])))
    assert torch.equal(valid, same) and torch.allclose(values, again, atol=2e-2)


def test_neighbours_come_from_near_to_far_and_empty_places_are_zero() -> None:
    scene = straight_road(3, gap=15.0)  # the first one leads
    neighbours = of_log(scene)[0][0, 0, len(OWN) + 3 : -len(ROAD)].view(-1, 5)
    assert torch.allclose(neighbours[0], torch.tensor([-15.0, 0, 1, 0, 1]), atol=1e-3)
    assert torch.allclose(neighbours[1, :2], torch.tensor([-30.0, 0]), atol=1e-3)
    assert not neighbours[2:].any()


def test_rollouts_are_seen_one_by_one() -> None:
    scene = straight_road(3, seed=2)
    rollouts = log_trajectory(scene, 80)[None] + torch.randn(11, 3, 80, 1) * torch.tensor([0.5, 0.5, 0, 0.02])
    together = observed_motion(scene, rollouts)[0]
    assert torch.allclose(together, torch.cat([observed_motion(scene, each[None])[0] for each in rollouts]), atol=1e-5)
    assert together.shape == (11, 3, 16, width_of())


@given(hole=st.integers(CURRENT_STEP + 1, 90), noise=st.floats(1, 50))
def test_nothing_from_the_first_hole_of_a_log_on_is_seen(hole: int, noise: float) -> None:
    scene = straight_road(3, seed=3)
    scene.agents.valid[1, hole] = False
    log = log_trajectory(scene, 80)[None]
    wild = log.clone()
    wild[:, 1, hole - CURRENT_STEP - 1 :, :2] += noise
    values, valid = observed_motion(scene, torch.cat((log, wild)))
    assert torch.equal(values[0], values[1]), "neither by the agent itself nor by its neighbours"
    assert int(valid[1].sum()) == (hole - CURRENT_STEP - 1) // 5
    assert not until_first_hole(scene).agents.valid[1, hole:].any()


def test_what_cannot_be_seen_is_refused() -> None:
    scene = straight_road(2)
    with pytest.raises(ValueError, match=r"stride must be 1 to 10 \(the history of a scene\), got 11"):
        of_log(scene, stride=11)
    with pytest.raises(ValueError, match="unknown features .'sky'."):
        of_log(scene, road=("sky",))


# --- the network ----------------------------------------------------------------------------------------------------
def test_steps_that_are_not_valid_change_no_logit() -> None:
    torch.manual_seed(0)
    net, values, valid = Discriminator(5), torch.randn(4, 3, 16, 5), torch.rand(3, 16) < 0.6
    valid[2] = False
    other = torch.where(valid[..., None], values, 1e6)
    assert torch.equal(net(values, valid), net(other, valid))
    assert torch.equal(net(values, valid)[:, 2], torch.zeros(4))
    assert torch.allclose(net.score(values, valid), net(values, valid)[:, :2].mean(-1))


def test_a_constant_input_is_not_seen() -> None:
    net, values = Discriminator(2), torch.randn(1, 3, 16, 2)
    values[..., 1] = 7.0
    net.standardise(values.flatten(0, -2))
    other = values.clone()
    other[..., 1] = -3.0
    valid = torch.ones(3, 16, dtype=torch.bool)
    assert torch.equal(net(values, valid), net(other, valid))


def test_the_loss_is_the_mean_cross_entropy_of_both_sides() -> None:
    torch.manual_seed(0)
    net, log, rollout = Discriminator(4), torch.randn(6, 8, 4), torch.randn(6, 8, 4)
    valid, weight = torch.ones(6, 8, dtype=torch.bool), torch.rand(6)
    found = discriminator_loss(net, log, rollout, valid, weight)
    chance = torch.stack((net(log, valid).sigmoid(), 1 - net(rollout, valid).sigmoid()))
    assert torch.allclose(found, -(chance.log().mean(0) * weight).sum() / weight.sum())
    untold = discriminator_loss(net, log, log, valid, weight)
    assert untold >= math.log(2)


@given(st.lists(st.integers(0, 5), min_size=1, max_size=8), st.lists(st.integers(0, 5), min_size=1, max_size=8))
def test_the_auc_is_that_of_all_pairs(positive: list[int], negative: list[int]) -> None:
    wins = [(p > n) + (p == n) / 2 for p in positive for n in negative]
    assert auc(torch.tensor(positive).float(), torch.tensor(negative).float()) == pytest.approx(np.mean(wins))


def test_an_auc_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="got 0 and 2 of them"):
        auc(torch.zeros(0), torch.zeros(2))


# --- smoothness -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("stride", [1, 5])
def test_the_jerk_of_a_sine_is_that_of_its_third_derivative(stride: int) -> None:
    scene = straight_road(1)
    scene.agents.position[0, :, 1] = torch.sin(TIME)
    found = mean_squared_jerk(scene, log_trajectory(scene, 80)[None], stride=stride).item()
    assert found == pytest.approx(torch.cos(TIME).square().mean().item(), rel=0.1)


def test_only_logged_steps_of_the_agents_asked_for_count() -> None:
    scene = straight_road(2)
    scene.agents.valid[0, 50:] = False
    log = log_trajectory(scene, 80)[None]
    wild = log.clone()
    wild[:, 0, 39:, 0] += 10 * torch.randn(41)
    wild[:, 1, :, 0] += torch.randn(80)
    found = mean_squared_jerk(scene, torch.cat((log, wild)), ego=torch.tensor([0]))
    assert found.abs().max() < 1e-2
    assert mean_squared_jerk(scene, wild)[0] > 100


@pytest.mark.parametrize("stride", [0, 27, 90])
def test_a_stride_that_leaves_no_third_difference_is_refused(stride: int) -> None:
    scene = straight_road(1)
    with pytest.raises(ValueError, match=f"stride must be 1 or more, and 4 poses .* of 80 steps .*, got {stride}"):
        mean_squared_jerk(scene, log_trajectory(scene, 80)[None], stride=stride)
    assert mean_squared_jerk(scene, log_trajectory(scene, 80)[None], stride=26).isfinite().all()


if __name__ == "__main__":
    pytest.main([__file__])
