"""The policy sees the agents that the environment simulates, whoever is controlled and whoever arrives."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import TransformedEnv

from dpa.models import collate_contexts, make_context
from dpa.models.motionlm import MotionLM, featurize
from dpa.ranking.transform import RankRollouts
from dpa.tokens import TokenAction
from dpa.training.logs import log_item
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import CURRENT_STEP, Scene
from envs.traffic import TrafficEnv


@torch.no_grad()
def test_an_arrival_is_seen_from_its_first_decision_on_and_not_before(model: MotionLM, arriving: list[Scene]) -> None:
    options = EpisodeOptions(arrivals=True)
    seen, unseen = (make_context(scene, featurize, options) for scene in (arriving[0], arriving[0].clone()))
    late = int((~seen.episode.valid).nonzero()[0])
    first = int(seen.episode.logged_valid[late].int().argmax()) // 5
    unseen.episode.logged_valid[late] = False
    tokens, valid = torch.full((1, 1, len(seen.episode.kind), 16), 84), torch.ones(1, 1, 1, 16, dtype=torch.bool)
    left, right = (
        model(collate_contexts([each]), tokens, valid)[0, 0, seen.episode.controlled] for each in (seen, unseen)
    )
    differs = (left - right).abs().amax((0, 2)) > 0
    assert first == 2, "at step 23, in the decision that begins with step 21 and ends with step 25"
    assert not differs[: first + 1].any() and differs[first + 1]


def test_arrivals_take_nothing_from_the_context_of_those_who_are_there(arriving: list[Scene]) -> None:
    without, with_them = (
        make_context(arriving[0], featurize),
        make_context(arriving[0], featurize, EpisodeOptions(arrivals=True)),
    )
    present = len(without.episode.kind)
    assert len(with_them.episode.kind) == present + 2
    for name in ("map_pose", "map_points", "light_pose"):
        assert torch.equal(getattr(with_them, name), getattr(without, name))
    for name in ("history", "recent", "logged", "controlled", "valid"):
        assert torch.equal(getattr(with_them.episode, name)[:present], getattr(without.episode, name))


def test_arrivals_are_no_labels(model: MotionLM, arriving: list[Scene]) -> None:
    item = log_item(make_context(arriving[2], featurize, EpisodeOptions(arrivals=True)), model.tokenizer)
    assert item.context.episode.logged_valid[-1].any() and not item.token_valid[-2:].any()
    assert not arriving[2].agents.valid[[2, 4], CURRENT_STEP].any()


def test_arrivals_take_no_part_in_the_ranking(model: MotionLM, arriving: list[Scene]) -> None:
    ranked = []
    for arrivals in (False, True):
        env = TrafficEnv(arriving, EpisodeOptions(arrivals=arrivals), num_scenes=3, num_rollouts=2)
        env = TransformedEnv(env, TokenAction(model.tokenizer))
        generator, state, steps = torch.Generator().manual_seed(0), env.reset(), []
        for _ in range(16):
            token = torch.zeros_like(state[keys.VALID], dtype=torch.int64)
            token[:, :4] = torch.randint(70, 100, (6, 4), generator=generator)
            step, state = env.step_and_maybe_reset(state.set(keys.TOKEN, token))
            steps.append(step)
        ranked.append(RankRollouts(arriving, num_rollouts=2)(torch.stack(steps, 1)))
    without, with_them = ranked
    assert with_them[keys.AGENT_RANKED].shape[1] > without[keys.AGENT_RANKED].shape[1]
    for key in (keys.DISTANCE, keys.ADE):
        torch.testing.assert_close(with_them[key], without[key])


def test_a_control_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"control must be one of \['all', 'sdc', 'predict'\] .*, got 'ego'"):
        EpisodeOptions(control="ego")


if __name__ == "__main__":
    pytest.main([__file__])
