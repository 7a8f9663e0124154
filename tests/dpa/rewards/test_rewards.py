"""Rewards of ranked rollouts, by hand and against what they are made of."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from dpa.models.motionlm import MotionLM
from dpa.ranking import DisplacementDistance, PreferenceDistance, log_trajectory
from dpa.realism import realism, realism_of_groups
from dpa.rewards import REWARDS, Outcome, RealismRanking, RewardRollouts, check_horizon, check_rewards
from dpa.rollout.job import RolloutJob, RolloutWorker
from dpa.rollout.plan import RolloutTask
from dpa.tokens import TokenAction, VerletTokenizer
from envs.episode import EpisodeOptions
from envs.scene import CURRENT_STEP, Scene
from envs.sources.synthetic import red_light, straight_road
from envs.traffic import TrafficEnv


def outcome_of(
    scene: Scene, trajectories: Tensor, controlled: Tensor | None = None, stride: int = 5, decisions: int = 16
) -> Outcome:
    distance = PreferenceDistance(stride=stride)
    controlled = torch.ones(trajectories.shape[1], dtype=torch.bool) if controlled is None else controlled
    ranking = distance(scene, trajectories, controlled)
    return Outcome(scene, trajectories, controlled, ranking=ranking, distance=distance, decisions=decisions)


def lagging(scene: Scene, *metres: float, agent: int = 0) -> Tensor:
    """The log, with one agent that falls behind evenly, a rollout for each distance in the end [m]."""
    log = log_trajectory(scene, 80)
    lag = torch.tensor(metres)[:, None, None] * torch.linspace(0, 1, 80)[:, None] * torch.tensor([1.0, 0, 0, 0])
    rollouts = log.repeat(len(metres), 1, 1, 1)
    rollouts[:, agent] -= lag
    return rollouts


@pytest.fixture
def road() -> Outcome:
    """Three rollouts of two vehicles, the first of which keeps to its log, is 4 m and is 9 m behind in the end."""
    scene = straight_road(2)
    return outcome_of(scene, lagging(scene, 0.0, 4.0, 9.0))


def test_the_distance_is_paid_by_scene_and_by_agent(road: Outcome) -> None:
    ranking = road.ranking
    assert torch.equal(REWARDS["distance"](road), -ranking.distance[:, None, None])
    assert torch.equal(REWARDS["agent_distance"](road), -ranking.agent_distance[..., None])
    assert torch.equal(REWARDS["ade"](road), -ranking.ade[:, None, None])
    assert ranking.ade.tolist() == pytest.approx([0, 1, 2.25])
    paid = REWARDS["agent_distance"](road)[..., 0]
    assert (paid[1:, 0] < paid[1:, 1]).all(), "who falls behind pays most"


@pytest.mark.parametrize("stride", [1, 2, 5, 8, 20])
@pytest.mark.parametrize("decisions", [16, 8])
def test_what_follows_the_first_decision_is_the_whole_distance_and_it_only_falls(stride: int, decisions: int) -> None:
    scene = straight_road(2)
    road = outcome_of(scene, lagging(scene, 0.0, 4.0, 9.0), stride=stride, decisions=decisions)
    to_go = -REWARDS["step_distance"](road)
    assert to_go.shape == (3, 2, decisions)
    torch.testing.assert_close(to_go[..., 0], road.ranking.agent_distance)
    assert (to_go.diff(dim=-1) <= 1e-6).all() and (to_go[..., -1] >= 0).all()


def test_what_happens_where_the_log_has_ended_is_not_paid_for() -> None:
    scene = straight_road(2)
    rollouts = log_trajectory(scene, 80)[None].repeat(2, 1, 1, 1)
    scene.agents.valid[0, CURRENT_STEP + 41 :] = False
    rollouts[1, 0, 50:, 1] += 40.0  # beside the road
    assert not REWARDS["offroad"](outcome_of(scene, rollouts)).any()
    assert REWARDS["offroad"](outcome_of(straight_road(2), rollouts))[1, 0] == -1


def test_a_decision_answers_for_what_comes_after_it_alone() -> None:
    scene = straight_road(1)
    late = log_trajectory(scene, 80)[None].clone()
    late[:, :, 75:, 1] += 3.0  # beside its lane in the last decision
    to_go = -REWARDS["step_distance"](outcome_of(scene, late))[0, 0]
    # every step pays 3 m of lateral offset in one of sixteen moments, and what that adds to its speed
    torch.testing.assert_close(to_go, to_go[:1].expand(16))
    early = log_trajectory(scene, 80)[None].clone()
    early[:, :, :5, 1] += 3.0
    to_go = -REWARDS["step_distance"](outcome_of(scene, early))[0, 0]
    assert to_go[0] > 0 and to_go[3:].max() < 0.1 * to_go[0]


def test_realism_pays_who_looks_like_the_log(road: Outcome) -> None:
    paid = REWARDS["realism"](road)
    assert paid.shape == (3, 2, 1)
    assert paid[0, 0] > paid[1, 0] > paid[2, 0]


@pytest.mark.parametrize("metres", [(0.0, 3.0), (1.0, 5.0, 12.0)])
def test_of_one_agent_realism_pays_the_difference_that_a_rollout_makes(metres: tuple[float, ...]) -> None:
    scene = straight_road(1)
    rollouts = lagging(scene, *metres)
    paid = REWARDS["realism"](outcome_of(scene, rollouts))[:, 0, 0]
    whole = realism(scene, rollouts).realism
    others = [torch.cat((rollouts[:k], rollouts[k + 1 :])) for k in range(len(rollouts))]
    assert paid.tolist() == pytest.approx([whole - realism(scene, each).realism for each in others], abs=1e-6)


def test_realism_pays_all_controlled_agents_and_no_other() -> None:
    scene = straight_road(3)
    scene.agents.predict[:], scene.agents.sdc[:] = False, torch.tensor([True, False, False])
    rollouts = torch.cat((lagging(scene, 0.0, 2.0, 5.0, agent=1), lagging(scene, 1.0, agent=2)))
    controlled = torch.tensor([False, True, True])
    paid = REWARDS["realism"](outcome_of(scene, rollouts, controlled))
    assert not paid[:, 0].any() and (paid[:, 1:].std(0) > 0).all()
    assert not scene.agents.predict.any(), "the scene itself is as it was"


def test_an_event_costs_whom_it_happens_to_and_its_mean_is_the_rate_of_the_metric() -> None:
    scene = straight_road(2, seed=1)
    scene.agents.predict[:] = True
    rollouts = log_trajectory(scene, 80)[None].repeat(3, 1, 1, 1)
    rollouts[1, 0, 40:] = rollouts[1, 1, 40:]  # into the other one
    rollouts[2, 0, 60:, 1] += 40.0  # off the road
    road, result = outcome_of(scene, rollouts), realism(scene, rollouts)
    collision, offroad = REWARDS["collision"](road)[..., 0], REWARDS["offroad"](road)[..., 0]
    assert collision.tolist() == [[0, 0], [-1, -1], [0, 0]]
    assert offroad[2].tolist() == [-1, 0] and offroad[:2].sum() == 0
    assert -collision.mean() == pytest.approx(result.collision_rate)
    assert -offroad.mean() == pytest.approx(result.offroad_rate)


def test_a_measure_of_safety_costs_who_does_what_it_is_about() -> None:
    scene = red_light(speed=8.0)
    through = log_trajectory(scene, 80)[None].repeat(2, 1, 1, 1)
    through[1] = through[1, :, :1]  # stands
    assert REWARDS["red_light"](outcome_of(scene, through))[:, 0, 0].tolist() == [-1, 0]
    nowhere = straight_road(1)
    assert not REWARDS["red_light"](outcome_of(nowhere, lagging(nowhere, 0.0, 1.0))).any(), "there is no light"


def test_driving_backwards_and_stopping_dead_cost_the_one_who_does_it() -> None:
    scene = straight_road(2)
    rollouts = log_trajectory(scene, 80)[None].repeat(3, 1, 1, 1)
    rollouts[1, 0, :, :2] = 2 * rollouts[1, 0, :1, :2] - rollouts[1, 0, :, :2]  # as fast as its log, the other way
    rollouts[2, 1, 40:] = rollouts[2, 1, 39]  # stands from one moment to the next
    road = outcome_of(scene, rollouts)
    assert REWARDS["wrong_way"](road)[..., 0].tolist() == [[0, 0], [-1, 0], [0, 0]]
    assert REWARDS["harsh_jerk"](road)[..., 0].tolist() == [[0, 0], [-1, 0], [0, -1]]


def test_passing_closely_costs_both() -> None:
    scene, ahead = straight_road(2), 0.1 * torch.arange(1, 81)
    rollouts = log_trajectory(scene, 80)[None].repeat(2, 1, 1, 1)
    crossed, across = rollouts[1, 0, 39], rollouts[1, 1]  # where the first is after 4 s the second crosses 1.1 s later
    across[:, 0], across[:, 1], across[:, 3] = crossed[0], crossed[1] + 10 * (ahead - 5.1), math.pi / 2
    assert REWARDS["close_pass"](outcome_of(scene, rollouts))[..., 0].tolist() == [[0, 0], [-1, -1]]


@settings(max_examples=20)
@given(st.lists(st.floats(0, 30), min_size=2, max_size=4))
def test_every_reward_is_finite_and_fits_the_group(metres: list[float]) -> None:
    scene = straight_road(2)
    road = outcome_of(scene, lagging(scene, *metres))
    for name, reward in REWARDS.items():
        paid = reward(road)
        assert paid.isfinite().all(), name
        assert paid.expand(len(metres), 2, 16).shape == (len(metres), 2, 16), name


def test_unknown_rewards_none_at_all_and_those_that_a_distance_cannot_tell_are_refused() -> None:
    distance = PreferenceDistance()
    with pytest.raises(ValueError, match="no reward .speed.; choose among distance, agent_distance, step_distance,"):
        check_rewards({"speed": 1.0}, distance)
    with pytest.raises(ValueError, match="all of the rewards ade weigh 0"):
        check_rewards({"ade": 0.0}, distance)
    with pytest.raises(ValueError, match=r"collision weighs -1.0; every reward is the higher the better"):
        check_rewards({"collision": -1.0}, distance)
    with pytest.raises(ValueError, match="the reward realism is of 80 steps of 0.1 s, and the policy rolls 40 out"):
        check_horizon({"distance": 1.0, "realism": 1.0}, 40)
    check_horizon({"distance": 1.0, "realism": 0.0}, 40)
    with pytest.raises(ValueError, match="step_distance needs a distance that couples moments"):
        check_rewards({"step_distance": 1.0}, DisplacementDistance())


def test_the_rewards_of_many_agents_add_up_to_what_a_rollout_adds_to_first_order() -> None:
    scene = straight_road(4, seed=2)
    scene.agents.predict[:] = True
    rollouts = lagging(scene, *torch.linspace(0, 6, 16).tolist(), agent=1)
    paid = REWARDS["realism"](outcome_of(scene, rollouts))[..., 0].sum(1)
    groups = [torch.tensor([other for other in range(16) if other != each]) for each in range(16)]
    whole = realism(scene, rollouts).realism
    exact = torch.tensor([whole - each.realism for each in realism_of_groups(scene, rollouts, groups)])
    assert torch.corrcoef(torch.stack((paid, exact)))[0, 1] > 0.99
    torch.testing.assert_close(paid, exact, atol=0.1 * float(exact.abs().max()), rtol=0)


# --- behind a collector ---------------------------------------------------------------------------------------------
def test_groups_of_scenes_of_other_sizes_have_their_rewards_spread_and_log_probabilities_in_their_rows() -> None:
    scenes, model = [straight_road(2), straight_road(4, seed=1)], MotionLM("nano", VerletTokenizer())
    postproc = partial(RewardRollouts, num_rollouts=3, distance=PreferenceDistance(stride=5),
                       rewards={name: REWARDS[name] for name in ("step_distance", "realism", "ade")})  # fmt: skip
    job = RolloutJob(scenes, model, num_rollouts=3, make_postproc=postproc)
    raw = RolloutWorker(replace(job, make_postproc=None)).run(RolloutTask((0, 1), (range(3),)))
    groups = RolloutWorker(job).run(RolloutTask((0, 1), (range(3),)))
    assert groups["scene"].tolist() == [0, 1]
    likely = raw["agents", "sampling_log_prob"].unflatten(0, (2, 3))  # [S, K, T, A]
    assert torch.equal(groups["sample_log_prob"], likely.movedim(2, -1))
    paid = groups["rewards"]
    assert all(value.shape == (2, 3, 4, 16) for value in paid.values())
    torch.testing.assert_close(-paid["step_distance"][..., 0], groups["agent_distance"])
    assert torch.equal(paid["ade"][1], -groups["ade"][1, :, None, None].expand(3, 4, 16))
    assert not any(value[0, :, 2:].any() for value in paid.values()), "two rows of the first scene are padding"
    last = raw["next", "agents", "recent"][:, -1, :, -1, :2].unflatten(0, (2, 3))  # [S, K, A, 2]
    spread = last.var(1, correction=0).sum(-1).sqrt()
    torch.testing.assert_close(groups["spread"][1], spread[1])
    torch.testing.assert_close(groups["spread"][0, :2], spread[0, :2])
    assert not groups["spread"][0, 2:].any()


def two_rollouts(scene: Scene, **options: str) -> TensorDictBase:
    """By random tokens."""
    env = TrafficEnv([scene], num_scenes=1, num_rollouts=2, **options)
    rolled = TransformedEnv(env, TokenAction(VerletTokenizer())).rollout(16)
    rolled["agents", "sampling_log_prob"] = torch.zeros_like(rolled["agents", "token"], dtype=torch.float32)
    return rolled


def test_where_nobody_is_moved_nobody_is_paid() -> None:
    scene = straight_road(3)
    scene.agents.predict[:] = False
    env = TransformedEnv(
        TrafficEnv([scene], EpisodeOptions(control="predict"), num_scenes=1, num_rollouts=2),
        TokenAction(VerletTokenizer()),
    )
    rolled = env.rollout(16)
    rolled["agents", "sampling_log_prob"] = torch.zeros_like(rolled["agents", "token"], dtype=torch.float32)
    groups = RewardRollouts([scene], 2, rewards=REWARDS)(rolled)
    assert not any(value.any() for value in groups["rewards"].values())


def test_a_reward_of_another_shape_is_refused() -> None:
    scene = straight_road(2)
    mine = {"mine": lambda outcome: outcome.ranking.agent_distance}
    with pytest.raises(ValueError, match=r"the reward mine must be \[K, A, T\], with 1 for what .*, got \[2, 2\]"):
        RewardRollouts([scene], 2, rewards=mine)(two_rollouts(scene))


def test_a_ranking_by_realism_puts_first_what_the_reward_pays_most() -> None:
    scene = straight_road(3)
    rollouts = lagging(scene, 0.0, 4.0, 9.0, 1.0)
    paid = REWARDS["realism"](outcome_of(scene, rollouts))[..., 0]
    ranking = RealismRanking()(scene, rollouts, torch.ones(3, dtype=torch.bool))
    assert ranking.distance.argsort().tolist() == paid.sum(1).argsort(descending=True).tolist()
    assert torch.equal(ranking.agent_distance[:, 0].argsort(), paid[:, 0].argsort(descending=True))
    assert (ranking.agent_distance >= 0).all() and (ranking.agent_distance.amin(0) == 0).all()
    assert ranking.ade.tolist() == pytest.approx([0, 4 / 6, 9 / 6, 1 / 6], rel=1e-3)


def test_a_ranking_by_realism_finds_no_preference_among_equals_and_moves_with_its_group() -> None:
    scene, everybody = straight_road(2), torch.ones(2, dtype=torch.bool)
    alike = RealismRanking()(scene, lagging(scene, 4.0, 4.0, 4.0), everybody)
    assert not alike.distance.any() and not alike.agent_distance.any()
    nobody = RealismRanking()(scene, lagging(scene, 0.0, 4.0), ~everybody)
    assert not nobody.distance.any() and not nobody.agent_ranked.any()


def test_a_ranking_by_realism_refuses_what_the_metric_cannot_score() -> None:
    scene = straight_road(2)
    with pytest.raises(ValueError, match="realism is of 80 steps of 0.1 s, and rollouts have 40"):
        RealismRanking()(scene, lagging(scene, 0.0, 4.0)[:, :, :40])
    with pytest.raises(ValueError, match="one rollout is a group of its own"):
        RealismRanking()(scene, lagging(scene, 0.0))
    with pytest.raises((ValueError, OSError), match="1999"):
        RealismRanking(metric="1999")


if __name__ == "__main__":
    pytest.main([__file__])
