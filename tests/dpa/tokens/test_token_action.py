"""TokenAction: tokens on the action path, and nothing else changed."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from dpa.tokens import TokenAction, VerletTokenizer
from envs import keys
from envs.episode import EpisodeOptions
from envs.geometry.frames import to_world
from envs.sources.synthetic import straight_road, two_cars_head_on
from envs.traffic import TrafficEnv


def token_env() -> TransformedEnv:
    scenes = [two_cars_head_on(), straight_road(3)]
    return TransformedEnv(
        TrafficEnv(scenes, EpisodeOptions(horizon=4), num_scenes=2, num_rollouts=2), TokenAction(VerletTokenizer())
    )


def test_the_action_is_a_token_for_each_agent() -> None:
    spec = token_env().full_action_spec
    assert list(spec.keys(True, True)) == [keys.TOKEN]
    assert spec[keys.TOKEN].shape == (4, 3) and spec[keys.TOKEN].n == 169
    assert spec[keys.TOKEN].dtype == torch.int64


def test_observations_rewards_and_ends_stay_as_they_are() -> None:
    env = token_env()
    for spec in ("observation_spec", "full_reward_spec", "full_done_spec"):
        assert getattr(env, spec) == getattr(env.base_env, spec)


def test_a_token_moves_agents_where_the_tokenizer_says() -> None:
    env = token_env()
    state = env.rand_action(env.reset())
    poses = env.transform.tokenizer.decode(state[keys.TOKEN], state[keys.RECENT], state[keys.KIND])
    expected = to_world(poses, state[keys.RECENT][..., -1:, :])
    after = env.step(state)["next", *keys.RECENT]
    controlled = state[keys.CONTROLLED]
    assert controlled.sum(-1).tolist() == [2, 2, 3, 3]
    torch.testing.assert_close(after[controlled][:, 1:], expected[controlled])


def test_the_token_is_kept_beside_the_state() -> None:
    assert token_env().rollout(4)[keys.TOKEN].shape == (4, 4, 3)


def test_token_environments_can_be_run_side_by_side() -> None:
    env = SerialEnv(2, token_env)
    check_env_specs(env, break_when_any_done="both")
    assert env.rollout(4)[keys.TOKEN].shape == (2, 4, 4, 3)


def test_a_tokenizer_of_another_length_is_refused() -> None:
    env = TransformedEnv(TrafficEnv([straight_road()]), TokenAction(VerletTokenizer(steps=10)))
    with pytest.raises(ValueError, match=r"takes 5 poses .* gives 10; say EpisodeOptions\(decision_steps=10\)"):
        env.full_action_spec  # noqa: B018 - specs are made when they are read


if __name__ == "__main__":
    pytest.main([__file__])
