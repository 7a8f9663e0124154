"""Patches: tokens that are the poses themselves."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from dpa.tokens import PatchTokenizer, TokenAction
from envs import keys
from envs.episode import EpisodeOptions, make_episode
from envs.geometry.frames import wrap_angle
from envs.sources.synthetic import straight_road, two_cars_head_on
from envs.traffic import TrafficEnv


@pytest.mark.parametrize("steps", [1, 5, 10])
def test_the_log_through_patches_is_the_log(steps: int) -> None:
    tokenizer = PatchTokenizer(steps)
    episode = make_episode(straight_road(5, seed=3), EpisodeOptions(decision_steps=steps, horizon=80 // steps))
    given = (episode.logged, episode.logged_valid, episode.recent, episode.kind)
    tracks = tokenizer.encode_tracks(*given)
    assert tracks.tokens.shape == (5, 80 // steps, 3 * steps)
    again = tokenizer.decode_tracks(tracks.tokens, episode.recent, episode.kind)
    for poses in (tracks.poses, again):
        off = poses - episode.logged
        off = torch.cat((off[..., :2], wrap_angle(off[..., 2:])), -1)
        assert off[episode.logged_valid].abs().max() < 1e-3


def test_an_environment_takes_patches() -> None:
    scenes = [two_cars_head_on(), straight_road(3)]
    options = EpisodeOptions(decision_steps=10, horizon=3)
    env = TransformedEnv(TrafficEnv(scenes, options, num_scenes=2), TokenAction(PatchTokenizer()))
    assert env.full_action_spec[keys.TOKEN].shape == (2, 3, 30)
    check_env_specs(env)
    assert env.rollout(3)[keys.TOKEN].dtype == torch.float32


def test_motions_are_alike_within_a_decimetre() -> None:
    tokenizer = PatchTokenizer(2)
    one, other = torch.zeros(3, 6), torch.tensor([0.0, 0.09, 0.11])[:, None].expand(3, 6)
    assert tokenizer.alike(one, other).tolist() == [True, True, False]


def test_a_patch_without_poses_is_refused() -> None:
    with pytest.raises(ValueError, match="steps=0"):
        PatchTokenizer(0)


if __name__ == "__main__":
    pytest.main([__file__])
