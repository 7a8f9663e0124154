"""Trajectories out of a collector's batch."""

from __future__ import annotations

import torch

from dpa.models.motionlm import MotionLM
from dpa.rollout import Subset, lifted, make_collector, simulated_poses
from envs import keys
from envs.scene import CURRENT_STEP, Scene
from envs.sources.synthetic import straight_road


def test_simulated_poses_are_what_the_tokens_decode_to(model: MotionLM, scenes: list[Scene]) -> None:
    (batch,) = make_collector(scenes, model, num_rollouts=2, indices=[0, 3])
    poses = simulated_poses(batch, 2)
    assert poses.shape == (2, 2, 2, 80, 3)
    for row, index in enumerate((0, 3)):
        agents = scenes[index].agents
        for rollout in range(2):
            tokens = batch[keys.TOKEN][2 * row + rollout].T
            expected = model.tokenizer.decode_tracks(tokens, agents.recent(5), agents.kind)
            torch.testing.assert_close(poses[row, rollout], expected)


def test_lifted_rollouts_drop_padding_and_have_the_height_of_the_road() -> None:
    scene = straight_road(2).clone()
    scene.road.points[:, 2] = 7.0
    scene.agents.position[..., 2] = 8.0
    poses = scene.agents.poses[:, CURRENT_STEP + 1 :].expand(3, -1, -1, -1)
    trajectories = lifted(scene, torch.nn.functional.pad(poses, (0, 0, 0, 0, 0, 2)))
    assert trajectories.shape == (3, 2, 80, 4)
    torch.testing.assert_close(trajectories[..., [0, 1, 3]], poses)
    torch.testing.assert_close(trajectories[..., 2], torch.full((3, 2, 80), 8.0), atol=0.1, rtol=0)


def test_a_subset_is_a_source(scenes: list[Scene]) -> None:
    part = Subset(scenes, [2, 0])
    assert len(part) == 2
    assert [part[i].scene_id for i in range(2)] == [scenes[2].scene_id, scenes[0].scene_id]
