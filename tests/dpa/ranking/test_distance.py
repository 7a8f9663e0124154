"""The preference distance of whole rollouts."""

from __future__ import annotations

import json

import pytest
import torch
from torch import Tensor

from dpa.ranking import PreferenceDistance, log_trajectory, rank_of
from envs.scene import CURRENT_STEP, Scene, select_agents
from envs.sources.synthetic import straight_road


def shaken(scene: Scene, num: int, scale: float = 1.0, seed: int = 0) -> Tensor:
    """Rollouts ``[num, A, 80, 4]``: the log plus smooth noise."""
    log = log_trajectory(scene, 80)
    noise = torch.randn(num, *log.shape, generator=torch.Generator().manual_seed(seed)).cumsum(2) * 0.05 * scale
    noise[..., 2:] = 0
    return log + noise


def scene_with_holes() -> Scene:
    """Three vehicles; the second has a hole, the third ends early."""
    scene = straight_road(3, seed=1)
    scene.agents.valid[1, 40:45] = False
    scene.agents.valid[2, 60:] = False
    scene.agents.position[~scene.agents.valid] = 0
    return scene


def test_the_log_is_at_distance_zero_and_ranks_first_by_both_measures() -> None:
    scene = scene_with_holes()
    rollouts = torch.cat((shaken(scene, 3), log_trajectory(scene, 80)[None]))
    ranking = PreferenceDistance()(scene, rollouts)
    assert ranking.distance[3] == 0
    assert ranking.ade[3] == 0
    assert (ranking.distance[:3] > 0).all()
    assert rank_of(ranking.distance)[3] == rank_of(ranking.ade)[3] == 0
    torch.testing.assert_close(ranking.distance, ranking.agent_distance.sum(-1))


def test_more_noise_is_farther() -> None:
    scene = scene_with_holes()
    rollouts = torch.cat([shaken(scene, 1, scale) for scale in (3.0, 1.0, 2.0)])
    assert rank_of(PreferenceDistance()(scene, rollouts).distance).tolist() == [2, 0, 1]


def test_invalid_agent_steps_do_not_change_the_distance() -> None:
    scene = scene_with_holes()
    rollouts = shaken(scene, 2)
    want = PreferenceDistance()(scene, rollouts)
    future = scene.agents.valid[:, CURRENT_STEP + 1 :]
    garbage = torch.where(future[..., None], rollouts, 77.0)
    got = PreferenceDistance()(scene, garbage)
    for name in ("distance", "agent_distance", "ade"):
        torch.testing.assert_close(getattr(got, name), getattr(want, name))


def test_an_agent_without_a_logged_future_is_not_ranked() -> None:
    scene = straight_road(3)
    scene.agents.valid[1, CURRENT_STEP + 1 :] = False
    ranking = PreferenceDistance()(scene, shaken(scene, 2))
    assert ranking.agent_ranked.tolist() == [True, False, True]
    assert not ranking.agent_distance[:, 1].any()


def test_agents_that_are_not_controlled_are_not_ranked() -> None:
    scene = straight_road(3)
    controlled = torch.tensor([True, False, False])
    ranking = PreferenceDistance()(scene, shaken(scene, 2), controlled)
    assert ranking.agent_ranked.tolist() == [True, False, False]
    torch.testing.assert_close(ranking.distance, ranking.agent_distance[:, 0])


def test_evaluated_ranks_fewer_agents_and_nobody_left_gives_zero() -> None:
    scene = straight_road(3)
    scene.agents.predict[1:] = False
    distance = PreferenceDistance(agents="evaluated")
    assert distance(scene, shaken(scene, 2)).agent_ranked.tolist() == [True, False, False]
    nobody = distance(scene, shaken(scene, 2), torch.tensor([False, True, True]))
    assert not nobody.agent_ranked.any()
    assert nobody.distance.tolist() == nobody.ade.tolist() == [0, 0]


def test_the_order_of_agents_does_not_matter() -> None:
    scene = scene_with_holes()
    rollouts, order = shaken(scene, 2), torch.tensor([2, 0, 1])
    want = PreferenceDistance()(scene, rollouts)
    got = PreferenceDistance()(select_agents(scene, order), rollouts[:, order])
    torch.testing.assert_close(got.agent_distance, want.agent_distance[:, order])
    torch.testing.assert_close(got.distance, want.distance)


def test_moving_scene_and_rollouts_together_does_not_matter() -> None:
    scene, shift = scene_with_holes(), torch.tensor([128.0, -64.0, 4.0])
    rollouts = shaken(scene, 2)
    want = PreferenceDistance()(scene, rollouts).distance
    scene.agents.position = torch.where(scene.agents.valid[..., None], scene.agents.position + shift, 0)
    scene.road.points = scene.road.points + shift
    rollouts[..., :3] += shift
    torch.testing.assert_close(PreferenceDistance()(scene, rollouts).distance, want, atol=2e-3, rtol=1e-3)


def test_aggregates_of_a_hand_case() -> None:
    scene = straight_road(2)
    rollouts = log_trajectory(scene, 80).repeat(3, 1, 1, 1)
    rollouts[1, 0, :, 1] += 1.0
    rollouts[2, 1, :, 1] += 2.0
    by = {name: PreferenceDistance(["road_edge"], aggregate=name)(scene, rollouts) for name in ("sum", "mean", "max")}
    per_agent = by["sum"].agent_distance
    torch.testing.assert_close(by["sum"].distance, per_agent.sum(-1))
    torch.testing.assert_close(by["mean"].distance, per_agent.mean(-1))
    torch.testing.assert_close(by["max"].distance, per_agent.amax(-1))
    mean_rank = PreferenceDistance(["road_edge"], aggregate="mean_rank")(scene, rollouts)
    assert mean_rank.distance.tolist() == [1.5, 2.25, 2.25]


def test_a_coarser_stride_ranks_alike() -> None:
    scene = straight_road(4, seed=3)
    rollouts = torch.cat([shaken(scene, 1, scale, seed=scale) for scale in (1, 3, 5, 7)])
    fine, coarse = (PreferenceDistance(stride=stride)(scene, rollouts).distance for stride in (1, 5))
    assert torch.equal(rank_of(fine), rank_of(coarse))


def test_shares_sum_to_one_and_a_weight_of_zero_takes_a_feature_out() -> None:
    scene = straight_road(3)
    rollouts = shaken(scene, 2)
    shares = PreferenceDistance().shares(scene, rollouts)
    assert sum(shares.values()) == pytest.approx(1, abs=1e-5)
    without = PreferenceDistance(weights={"effort": 0.0}).shares(scene, rollouts)
    assert shares["effort"] > 0 == without["effort"]


def test_options_are_described_for_json_and_threads_are_left_out() -> None:
    described = PreferenceDistance(weights={"speed": 2.0}, threads=2).describe()
    assert json.loads(json.dumps(described)) == described
    assert described["weights"] == {"collision": 10, "road_edge": 5, "clearance": 2, "effort": 1, "speed": 2}
    assert described == PreferenceDistance(weights={"speed": 2.0}).describe()


@pytest.mark.parametrize(
    "options",
    [
        {"features": "all"},
        {"weights": {"jerk": 1.0}},
        {"clips": {"jerk": (0, 1)}},
        {"method": "sinkhorn"},
        {"aggregate": "median"},
        {"agents": "vehicles"},
    ],
)
def test_unknown_options_are_refused_when_the_distance_is_made(options: dict) -> None:
    with pytest.raises(ValueError, match=r"all|jerk|sinkhorn|median|vehicles"):
        PreferenceDistance(**options)
