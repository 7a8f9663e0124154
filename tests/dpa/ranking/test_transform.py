"""Ranking behind a collector, on hand-made rollouts and on those of the environment."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from dpa.ranking import PreferenceDistance, Ranking, log_trajectory
from dpa.ranking.transform import RankRollouts
from envs import keys
from envs.scene import CURRENT_STEP, AgentKind, Scene
from envs.sources.synthetic import straight_road

K, A, T, F = 3, 4, 16, 5
LOG_ROLLOUT = 1
"""Which of the K hand-made rollouts is the log."""


@pytest.fixture
def scenes() -> list[Scene]:
    """Two scenes with one agent that is absent at the current step, so rows are not indices."""
    scenes = [straight_road(4, seed=0), straight_road(3, seed=1)]
    for scene in scenes:
        scene.agents.valid[1, : CURRENT_STEP + 5] = False
    return scenes


def poses_of(scene: Scene, shift: float) -> torch.Tensor:
    """``[A, T, F + 1, 3]``: the log, moved sideways by ``shift``, as an environment records it, padded with zeros."""
    agents, present = scene.agents, scene.agents.present
    poses = torch.cat((agents.position[present][..., :2], agents.heading[present][..., None]), -1)[:, CURRENT_STEP:]
    poses[:, 1:, 1] += shift
    recent = poses.unfold(1, F + 1, F).transpose(-1, -2)
    return torch.cat((recent, torch.zeros(A - len(recent), T, F + 1, 3)))


def hand_made(scenes: list[Scene], order: tuple[int, ...] = (1, 0)) -> TensorDict:
    """Rollouts ``[S * K, T]`` of the scenes in some order; rollout k is shifted by |k - LOG_ROLLOUT| / 2 metres."""
    rows = [(i, poses_of(scenes[i], abs(k - LOG_ROLLOUT) / 2)) for i in order for k in range(K)]
    batch = [len(rows), T]
    present = [int(scenes[i].agents.present.sum()) for i, _ in rows]
    rollouts = TensorDict(batch_size=batch)
    rollouts[keys.SCENE] = torch.tensor([i for i, _ in rows])[:, None].expand(batch)
    rollouts[keys.STEP] = torch.arange(T)[:, None].expand(*batch, 1)
    rollouts[keys.TOKEN] = torch.arange(len(rows) * T * A).view(*batch, A) % 169
    rollouts[keys.CONTROLLED] = (torch.arange(A) < torch.tensor(present)[:, None])[:, None].expand(*batch, A)
    rollouts["next", *keys.RECENT] = torch.stack([recent for _, recent in rows]).transpose(1, 2)
    return rollouts


def test_groups_have_the_documented_shapes_and_the_log_ranks_first(scenes: list[Scene]) -> None:
    groups = RankRollouts(scenes, K)(hand_made(scenes))
    assert groups.batch_size == (2,)
    assert groups[keys.SCENE].tolist() == [1, 0]
    assert groups[keys.TOKENS].shape == (2, K, A, T)
    assert groups[keys.TOKEN_VALID].shape == (2, A, T)
    assert groups[keys.AGENT_DISTANCE].shape == (2, K, A)
    assert groups[keys.RANK].tolist() == [[1, 0, 2]] * 2
    torch.testing.assert_close(groups[keys.DISTANCE][:, LOG_ROLLOUT], torch.zeros(2), atol=1e-4, rtol=0)
    torch.testing.assert_close(groups[keys.ADE], torch.tensor([[0.5, 0, 0.5]] * 2), atol=1e-4, rtol=0)
    assert groups[keys.AGENT_RANKED].tolist() == [[True, True, False, False], [True, True, True, False]]
    assert torch.equal(groups[keys.TOKEN_VALID][..., 0], groups[keys.AGENT_RANKED])
    share = groups[keys.FEATURE_SHARE]
    assert share.shape == (2, K, 5)
    torch.testing.assert_close(share.sum(-1), (groups[keys.DISTANCE] > 0).float())


def test_the_kinds_of_the_agents_go_along(scenes: list[Scene]) -> None:
    scenes[0].agents.kind[:] = torch.tensor([AgentKind.CYCLIST, AgentKind.OTHER, AgentKind.PEDESTRIAN, 1])  # 1 absent
    groups = RankRollouts(scenes, K)(hand_made(scenes))
    assert groups[keys.AGENT_KIND].tolist() == [[1, 1, 0, 0], [AgentKind.CYCLIST, AgentKind.PEDESTRIAN, 1, 0]]
    assert groups[keys.AGENT_KIND].dtype == torch.int64


def test_a_function_of_ones_own_ranks(scenes: list[Scene]) -> None:
    def straying(scene: Scene, trajectories: torch.Tensor, controlled: torch.Tensor) -> Ranking:
        """How far agents stray from their log sideways; it knows no features."""
        agent = (trajectories - log_trajectory(scene, trajectories.shape[2]))[..., 1].abs().mean(-1)
        distance = (agent * controlled).sum(-1)
        return Ranking(distance, agent, distance, controlled, agent.new_zeros(len(agent), 0))

    groups = RankRollouts(scenes, K, straying)(hand_made(scenes))
    assert groups[keys.RANK].tolist() == [[1, 0, 2]] * 2
    assert groups[keys.FEATURE_SHARE].shape == (2, K, 0)


def test_distances_are_those_of_the_trajectories(scenes: list[Scene]) -> None:
    distance = PreferenceDistance(stride=5, aggregate="mean")
    groups = RankRollouts(scenes, K, distance)(hand_made(scenes))
    log = log_trajectory(scenes[0], 80)
    rollouts = torch.stack([log + torch.tensor([0, abs(k - LOG_ROLLOUT) / 2, 0, 0]) for k in range(K)])
    want = distance(scenes[0], rollouts)
    torch.testing.assert_close(groups[keys.DISTANCE][1], want.distance, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(groups[keys.AGENT_DISTANCE][1, :, :3], want.agent_distance, atol=1e-4, rtol=1e-4)


def test_tokens_keep_their_place(scenes: list[Scene]) -> None:
    rollouts = hand_made(scenes)
    groups = RankRollouts(scenes, K)(rollouts)
    for scene, rollout, agent, step in ((0, 0, 0, 0), (1, 2, 3, 15), (0, 1, 2, 7)):
        assert (
            groups[keys.TOKENS][scene, rollout, agent, step] == rollouts[keys.TOKEN][scene * K + rollout, step, agent]
        )


def test_only_controlled_agents_count(scenes: list[Scene]) -> None:
    rollouts = hand_made(scenes)
    rollouts[keys.CONTROLLED] = rollouts[keys.CONTROLLED] & (torch.arange(A) == 1)
    groups = RankRollouts(scenes, K)(rollouts)
    assert groups[keys.TOKEN_VALID].sum() == 2 * T
    torch.testing.assert_close(groups[keys.DISTANCE], groups[keys.AGENT_DISTANCE][..., 1])


def test_a_short_horizon_ranks_the_steps_that_there_are(scenes: list[Scene]) -> None:
    groups = RankRollouts(scenes, K)(hand_made(scenes)[:, :4])
    assert groups[keys.TOKENS].shape == (2, K, A, 4)
    assert groups[keys.RANK].tolist() == [[1, 0, 2]] * 2


def test_a_batch_that_is_not_made_of_groups_is_refused_with_the_fix(scenes: list[Scene]) -> None:
    with pytest.raises(ValueError, match="num_rollouts of the environment"):
        RankRollouts(scenes, K)(hand_made(scenes)[:5])
    with pytest.raises(ValueError, match="group 1 have different scenes"):
        RankRollouts(scenes, 2)(hand_made(scenes))


def test_a_batch_that_starts_within_an_episode_is_refused(scenes: list[Scene]) -> None:
    with pytest.raises(ValueError, match="reset_at_each_iter"):
        RankRollouts(scenes, K)(hand_made(scenes)[:, 2:6])


def test_other_scenes_than_those_of_the_environment_are_refused(scenes: list[Scene]) -> None:
    with pytest.raises(ValueError, match="has 6 agents and the rollouts have 4"):
        RankRollouts([straight_road(6)] * 2, K)(hand_made(scenes))


def test_a_collector_gives_groups(scenes: list[Scene]) -> None:
    from torchrl.collectors import Collector
    from torchrl.envs import TransformedEnv

    from dpa.tokens import TokenAction, VerletTokenizer
    from envs.traffic import TrafficEnv

    env = TransformedEnv(TrafficEnv(scenes, num_scenes=2, num_rollouts=K), TokenAction(VerletTokenizer()))
    collector = Collector(
        env,
        env.rand_action,
        frames_per_batch=2 * K * T,
        total_frames=4 * K * T,
        reset_at_each_iter=True,
        postproc=RankRollouts(scenes, K, PreferenceDistance(stride=5)),
        auto_register_policy_transforms=False,
    )
    batches = list(collector)
    collector.shutdown()
    assert [groups.batch_size for groups in batches] == [(2,), (2,)]
    assert all((groups[keys.DISTANCE] > 0).all() for groups in batches)
