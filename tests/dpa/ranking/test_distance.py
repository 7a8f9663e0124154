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
    names = ("sum", "mean", "median", "max")
    by = {name: PreferenceDistance(["road_edge"], aggregate=name)(scene, rollouts) for name in names}
    per_agent = by["sum"].agent_distance
    torch.testing.assert_close(by["sum"].distance, per_agent.sum(-1))
    torch.testing.assert_close(by["mean"].distance, per_agent.mean(-1))
    torch.testing.assert_close(by["max"].distance, per_agent.amax(-1))
    torch.testing.assert_close(by["median"].distance, per_agent.mean(-1))  # of two
    mean_rank = PreferenceDistance(["road_edge"], aggregate="mean_rank")(scene, rollouts)
    assert mean_rank.distance.tolist() == [1.5, 2.25, 2.25]


def test_the_median_does_not_follow_one_agent() -> None:
    scene = straight_road(3)
    rollouts = log_trajectory(scene, 80).repeat(2, 1, 1, 1)
    rollouts[:, 1:, :, 1] += 0.5
    rollouts[1, 0, :, 1] += 30.0
    distance = PreferenceDistance(["road_edge"], aggregate="median")(scene, rollouts).distance
    assert 0 < distance[1] <= 2 * distance[0]


def test_a_coarser_stride_ranks_alike() -> None:
    scene = straight_road(4, seed=3)
    rollouts = torch.cat([shaken(scene, 1, scale, seed=scale) for scale in (1, 3, 5, 7)])
    fine, coarse = (PreferenceDistance(stride=stride)(scene, rollouts).distance for stride in (1, 5))
    assert torch.equal(rank_of(fine), rank_of(coarse))


def test_feature_shares_sum_to_one_and_a_weight_of_zero_takes_a_feature_out() -> None:
    scene = scene_with_holes()
    rollouts = torch.cat((shaken(scene, 2), log_trajectory(scene, 80)[None]))
    shares = PreferenceDistance()(scene, rollouts).feature_share
    torch.testing.assert_close(shares.sum(-1), torch.tensor([1.0, 1.0, 0.0]))
    without = PreferenceDistance(weights={"effort": 0.0})(scene, rollouts).feature_share
    assert (shares[:2, 3] > 0).all() and not without[:, 3].any()


def test_a_feature_share_is_its_part_of_the_distances_of_all_ranked_agents() -> None:
    scene = straight_road(3)
    rollouts = shaken(scene, 2)
    rollouts[:, 1:] += torch.tensor([0, 0.5, 0, 0])
    both = PreferenceDistance(["road_edge", "speed"], aggregate="max")(scene, rollouts)
    controlled = torch.tensor([True, False, True])
    some = PreferenceDistance(["road_edge", "speed"])(scene, rollouts, controlled)
    last = PreferenceDistance(["road_edge", "speed"])(scene, rollouts, torch.tensor([False, True, False]))
    summed = some.feature_share * some.distance[:, None] + last.feature_share * last.distance[:, None]
    torch.testing.assert_close(both.feature_share, summed / both.agent_distance.sum(-1, keepdim=True))


def test_a_window_is_in_seconds_whatever_the_stride() -> None:
    scene = straight_road(2)
    rollouts = shaken(scene, 2)
    for stride, apart in ((1, 0.05), (5, 0.4)):
        aligned = PreferenceDistance(stride=stride, method="time_aligned")(scene, rollouts)
        windowed = PreferenceDistance(stride=stride, method="windowed", solver={"window": apart})(scene, rollouts)
        torch.testing.assert_close(windowed.distance, aligned.distance)
    exact, wide = (PreferenceDistance(method=method)(scene, rollouts).distance for method in ("exact", "windowed"))
    narrow = PreferenceDistance(method="windowed", solver={"window": 0.4})(scene, rollouts).distance
    aligned = PreferenceDistance(method="time_aligned")(scene, rollouts).distance
    assert (exact <= wide).all() and (wide < narrow).all() and (narrow < aligned).all()


def test_options_are_described_for_json_and_threads_are_left_out() -> None:
    described = PreferenceDistance(weights={"speed": 2.0}, threads=2).describe()
    assert json.loads(json.dumps(described)) == described
    assert described["weights"] == {"collision": 10, "road_edge": 5, "clearance": 2, "effort": 1, "speed": 2}
    assert described == PreferenceDistance(weights={"speed": 2.0}).describe()


def test_all_options_of_a_solver_that_decide_are_described() -> None:
    described = PreferenceDistance(method="sinkhorn", solver={"epsilon": 0.1, "compile": True}).describe()
    assert described["solver"] == {"epsilon": 0.1, "start": 1.0, "iterations": 1000, "tolerance": 0.01}
    assert PreferenceDistance(method="windowed").describe()["solver"] == {"window": 2.0}
    assert PreferenceDistance().describe()["solver"] == {}


@pytest.mark.parametrize(
    "options",
    [
        {"features": "all"},
        {"weights": {"jerk": 1.0}},
        {"clips": {"jerk": (0, 1)}},
        {"method": "nearest"},
        {"method": "windowed", "solver": {"reach": 3}},
        {"aggregate": "mode"},
        {"agents": "vehicles"},
    ],
)
def test_unknown_options_are_refused_when_the_distance_is_made(options: dict) -> None:
    with pytest.raises(ValueError, match=r"all|jerk|nearest|reach|mode|vehicles"):
        PreferenceDistance(**options)
