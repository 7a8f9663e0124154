"""A policy that follows the log by its own likely tokens."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from dpa.models import Contexts, make_context
from dpa.models.closest import ClosestActor
from dpa.models.motionlm import MotionLM, SceneContext, featurize
from dpa.tokens import TokenAction, VerletTokenizer
from dpa.training.logs import log_item
from envs import keys
from envs.geometry.boxes import box_corners
from envs.geometry.frames import to_local, to_world
from envs.scene import CURRENT_STEP, Scene
from envs.sources.synthetic import build_scene, straight_road
from envs.traffic import TrafficEnv

TOKENIZER = VerletTokenizer()


def policy() -> MotionLM:
    torch.manual_seed(0)
    return MotionLM("nano", TOKENIZER).eval()


def followed(scenes: list[Scene], candidates: int, num_rollouts: int = 1, recovery: float = 1.0) -> TensorDictBase:
    sizes = {"num_scenes": len(scenes), "num_rollouts": num_rollouts}
    env = TransformedEnv(TrafficEnv(scenes, **sizes), TokenAction(TOKENIZER))
    actor = ClosestActor(policy(), Contexts(scenes, featurize), candidates=candidates, recovery=recovery)
    actor.num_rollouts = num_rollouts
    return env.rollout(16, actor)


def test_among_all_tokens_the_log_is_followed_as_by_its_own_tokens() -> None:
    scene = straight_road(4, seed=3)
    rolled = followed([scene], candidates=169)
    tokens = rolled[keys.TOKEN][0].T
    assert torch.equal(tokens, rolled[keys.LABEL][0].T), "the nearest of all is the label"
    assert torch.equal(tokens, log_item(make_context(scene, featurize), TOKENIZER).tokens[0])


def test_of_one_candidate_the_most_probable_is_taken_and_the_label_still_leads_back() -> None:
    scene = straight_road(2)
    rolled = followed([scene], candidates=1)
    start = make_context(scene, featurize)
    log = (start.episode.logged[:, 4] - start.episode.recent[:, -1])[:, :2].norm(dim=-1)
    ends = TOKENIZER.decode(rolled[keys.LABEL][0, 0], start.episode.recent, start.episode.kind)[:, -1, :2].norm(dim=-1)
    torch.testing.assert_close(ends, log, atol=0.15, rtol=0)
    assert (rolled[keys.TOKEN] != rolled[keys.LABEL]).any()


def apart(context: SceneContext, agent: int, tokens: Tensor) -> Tensor:
    """How far the box of an agent ends from that of the log after its first decision, by hand: ``[n]``."""
    found = []
    for token in tokens:
        end = TOKENIZER.advance(token[None], context.episode.recent[agent][None], context.episode.kind[agent][None])[
            0, -1
        ]
        boxes = (
            torch.cat((pose, context.episode.extent[agent, :2])) for pose in (end, context.episode.logged[agent, 4])
        )
        mine, logs = (box_corners(box) for box in boxes)
        found.append((mine - logs).norm(dim=-1).mean())
    return torch.stack(found)


def test_the_label_is_taken_where_it_is_likely_and_otherwise_the_likely_token_that_ends_nearest() -> None:
    inside = outside = 0
    for seed, candidates in ((0, 20), (1, 20), (0, 120), (1, 120)):
        scene = straight_road(3, seed=seed)
        rolled, context = followed([scene], candidates=candidates), make_context(scene, featurize)
        env = TransformedEnv(TrafficEnv([scene]), TokenAction(TOKENIZER))
        logits = ClosestActor(policy(), Contexts([scene], featurize)).decide(env.reset())[0].logits
        likely = logits.topk(candidates).indices[0]
        for agent in range(3):
            token, label = (rolled[key][0, 0, agent] for key in (keys.TOKEN, keys.LABEL))
            if label in likely[agent]:
                assert token == label
                inside += 1
            else:
                assert token == likely[agent][apart(context, agent, likely[agent]).argmin()]
                outside += 1
    assert inside and outside, "the scenes have both"


def test_a_likely_label_is_taken_though_the_box_of_another_token_ends_nearer() -> None:
    """The tokenizer goes by where the centre ends; the corners of a turning car may say otherwise."""
    scene, context = straight_road(1, seed=0), make_context(straight_road(1, seed=0), featurize)
    context.episode.logged[0, 4, 2] += 0.8  # of the log's last pose, the heading alone
    distances = apart(context, 0, torch.arange(169))
    target = to_local(context.episode.logged[:, :5], context.episode.recent[:, -1:])
    label = TOKENIZER.encode(target, context.episode.recent, context.episode.kind)[0]
    assert distances.argmin() != label, "the case that is meant"
    scene.agents.heading[0, CURRENT_STEP + 5] += 0.8
    assert followed([scene], candidates=169)[keys.TOKEN][0, 0, 0] == label


def test_slow_recovery_aims_at_the_log_moved_by_what_is_left_of_the_offset() -> None:
    """By hand, for the second decision: the target lies beside the log's next pose as the agent lies beside the log."""
    scene, context = straight_road(3, seed=5), make_context(straight_road(3, seed=5), featurize)
    rolled = followed([scene], candidates=2, recovery=0.25)
    for agent in range(3):
        recent, kind = context.episode.recent[agent], context.episode.kind[agent]
        recent = TOKENIZER.advance(rolled[keys.TOKEN][0, 0, agent][None], recent[None], kind[None])[0]
        offset = to_local(recent[-1], context.episode.logged[agent, 4])
        target = to_world(0.75 * offset, context.episode.logged[agent, 5:10])
        label = TOKENIZER.encode(to_local(target, recent[-1])[None], recent[None], kind[None])
        assert rolled[keys.LABEL][0, 1, agent] == label


@pytest.mark.parametrize("recovery", [0.0, 1.5])
def test_a_share_that_cannot_be_made_good_is_refused(recovery: float) -> None:
    with pytest.raises(ValueError, match=rf"recovery must lie in \(0, 1\], got {recovery}"):
        ClosestActor(policy(), Contexts([straight_road(1)], featurize), recovery=recovery)


def test_where_the_log_ends_the_most_probable_token_is_taken_and_there_is_no_label() -> None:
    scene = straight_road(2)
    valid = torch.ones(2, 91, dtype=torch.bool)
    valid[1, 31:] = False  # four decisions after the current step
    scene.agents = build_scene(scene.agents.poses, [(0, torch.zeros(2, 2))], valid=valid).agents
    rolled = followed([scene], candidates=169)
    assert rolled[keys.LABEL_VALID][0].sum(0).tolist() == [16, 4]
    log_prob = rolled[keys.LOG_PROB][0, :, 1]
    env = TransformedEnv(TrafficEnv([scene]), TokenAction(TOKENIZER))
    likeliest = env.rollout(16, ClosestActor(policy(), Contexts([scene], featurize), candidates=1))
    assert (log_prob[4:] > -torch.log(torch.tensor(169.0))).all(), "more probable than the mean"
    assert likeliest[keys.LABEL_VALID][0].sum(0).tolist() == [16, 4]


def test_a_hole_in_the_log_takes_a_label_and_gives_it_back() -> None:
    scene = straight_road(1)
    valid = torch.ones(1, 91, dtype=torch.bool)
    valid[0, 20] = False  # the end of the second decision
    scene.agents = build_scene(scene.agents.poses, [(0, torch.zeros(2, 2))], valid=valid).agents
    there = followed([scene], candidates=169)[keys.LABEL_VALID][0, :, 0]
    assert there.tolist() == [True, False] + [True] * 14


def test_scenes_side_by_side_are_followed_as_alone() -> None:
    scenes = [straight_road(2, seed=1), straight_road(4, seed=2)]
    together = followed(scenes, candidates=12)
    for row, scene in enumerate(scenes):
        agents = len(scene.agents.sdc)
        alone = followed([scene], candidates=12)
        for key in (keys.TOKEN, keys.LABEL, keys.LABEL_VALID):
            assert torch.equal(together[key][row, :, :agents], alone[key][0])
    assert not together[keys.LABEL_VALID][0, :, 2:].any(), "padding has no labels"


def test_several_rollouts_of_a_scene_are_one_and_the_same() -> None:
    rolled = followed([straight_road(2)], candidates=8, num_rollouts=3)[keys.TOKEN]
    assert torch.equal(rolled[0], rolled[1]) and torch.equal(rolled[0], rolled[2])


@pytest.mark.parametrize("candidates", [0, 170])
def test_a_number_of_candidates_that_cannot_be_is_refused(candidates: int) -> None:
    with pytest.raises(ValueError, match=f"candidates must be 1 to 169, the number of tokens, got {candidates}"):
        ClosestActor(policy(), Contexts([straight_road(1)], featurize), candidates=candidates)


if __name__ == "__main__":
    pytest.main([__file__])
