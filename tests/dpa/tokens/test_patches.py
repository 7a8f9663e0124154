"""Patches: tokens that are the poses themselves."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from dpa.tokens import PatchTokenizer, TokenAction
from dpa.tokens.patches import AHEAD, STILL, TURNED
from envs import keys
from envs.episode import EpisodeOptions, make_episode
from envs.geometry.frames import to_local, to_world, wrap_angle
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


@pytest.mark.parametrize("steps", [2, 10])
def test_what_is_too_little_to_be_a_motion_is_standing_still(steps: int) -> None:
    tokenizer, seconds = PatchTokenizer(steps), 0.1 * steps
    little, turn = torch.zeros(4, steps, 3), STILL[1] * seconds
    little[0, -1, 0], little[1, -1, 0] = 0.9 * STILL[0] * seconds, 1.1 * STILL[0] * seconds
    little[2, -1, 2], little[3, -1, 2] = 0.9 * turn, 1.1 * turn
    patches = tokenizer.encode(little, torch.zeros(4, steps + 1, 3), torch.ones(4, dtype=torch.int64))
    assert patches.any(-1).tolist() == [False, True, False, True]
    torch.testing.assert_close(patches[1::2], little[1::2].flatten(-2))  # any other motion is itself


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


def test_noise_ends_a_little_elsewhere_and_labels_lead_back() -> None:
    tokenizer, options = PatchTokenizer(), EpisodeOptions(decision_steps=10, horizon=8)
    episode = make_episode(straight_road(6, seed=3), options)
    drawn = torch.rand(6, 8, 3, generator=torch.Generator().manual_seed(0))
    given = (episode.logged, episode.logged_valid, episode.recent, episode.kind)
    exact, noisy = tokenizer.encode_tracks(*given), tokenizer.encode_tracks(*given, noise=1.0, drawn=drawn)
    ends = tokenizer.decode(noisy.tokens, noisy.tokens, episode.kind)[..., -1, :]
    wanted = tokenizer.decode(noisy.labels, noisy.labels, episode.kind)[..., -1, :]
    apart = (ends - wanted)[..., :2].norm(dim=-1)
    assert 0.05 < apart.mean() < AHEAD + 0.3 and apart.max() < 1.0
    assert (ends - wanted)[..., 2].abs().max() <= TURNED + 1e-5
    first, later = exact.tokens, noisy.labels
    assert torch.equal(first[:, 0], later[:, 0]) and not torch.allclose(first[:, 1:], later[:, 1:])
    # The label of each decision ends where the log does, from wherever the noise has led.
    reached = torch.cat((episode.recent[:, None, -1], noisy.poses.unflatten(1, (8, 10))[:, :-1, -1]), 1)
    back = to_world(wanted, reached)
    torch.testing.assert_close(back[..., :2], episode.logged.unflatten(1, (8, 10))[:, :, -1, :2], atol=1e-3, rtol=0)


def test_a_label_that_comes_back_is_no_jump() -> None:
    tokenizer, options = PatchTokenizer(), EpisodeOptions(decision_steps=10, horizon=8)
    episode = make_episode(straight_road(6, seed=3), options)
    drawn = torch.rand(6, 8, 3, generator=torch.Generator().manual_seed(0))
    given = (episode.logged, episode.logged_valid, episode.recent, episode.kind)
    for recovery in (0.25, 1.0):
        noisy = tokenizer.encode_tracks(*given, noise=1.0, recovery=recovery, drawn=drawn)
        labels = tokenizer.decode(noisy.labels, noisy.labels, episode.kind)[:, 1:]
        reached = torch.cat((episode.recent[:, None, 1:], noisy.poses.unflatten(1, (8, 10))[:, :-1]), 1)[:, 1:]
        before = to_local(reached[..., -2:, :], reached[..., -1:, :])
        accelerations = torch.cat((before, labels), -2)[..., :2].diff(dim=-2).diff(dim=-2).norm(dim=-1) / 0.01
        assert accelerations.max() < 8.0


def test_a_patch_that_stands_is_not_turned() -> None:
    tokenizer = PatchTokenizer()
    still = torch.zeros(50, 30)
    moved = tokenizer.decode(tokenizer.neighbour(still, torch.ones(50), torch.rand(50, 2)), still, torch.ones(50))
    assert not moved[..., 1:].any() and moved[..., 0].any()


def test_a_patch_without_poses_is_refused() -> None:
    with pytest.raises(ValueError, match="steps=0"):
        PatchTokenizer(0)


if __name__ == "__main__":
    pytest.main([__file__])
