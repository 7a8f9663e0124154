"""Rollouts for the player: those of the collector, ranked, with the likelihood that the policy itself gives them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dpa.models import Decoding, collate_contexts, make_context
from dpa.models.motionlm import featurize
from dpa.ranking import PreferenceDistance, rank_of
from dpa.ranking.rival import DisplacementDistance
from dpa.report.player import PlayerScene, pack_players
from dpa.rollout import make_collector
from envs import keys
from envs.store import SceneStore
from recipes.common.models import open_policy
from recipes.common.rolled import rolled
from recipes.play import log_likelihood, roll_out

K, DISTANCE = 12, PreferenceDistance(stride=5)


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    folder = tmp_path_factory.mktemp("play")
    assert run("pretrain", *options("pretrain", f"output={folder}", "pretraining.steps=2")).status == 0
    return folder / "policy.pt"


@pytest.fixture(scope="module")
def scenes(stores: Path) -> SceneStore:
    return SceneStore(stores / "eval")


@pytest.fixture(scope="module")
def players(policy: Path, scenes: SceneStore) -> list[PlayerScene]:
    decoding = {"sharp": Decoding(top_p=0.5), "wide": Decoding(top_p=1.0)}
    policies = {"sharp": policy, "wide": policy}
    return roll_out(policies, scenes, [2, 0], decoding=decoding, num_rollouts=K, kept=4, distance=DISTANCE, seed=3)


def sampled(policy: Path, scenes: SceneStore, index: int) -> tuple:
    """All rollouts of a scene, once more: of the collector, and scene by scene."""
    model, episode, _ = open_policy(policy)
    (batch,) = make_collector(
        scenes, model, num_rollouts=K, indices=[index], decoding=Decoding(top_p=1.0), options=episode, seed=3
    )
    return model, episode, batch, next(rolled([batch], scenes, K))


def test_the_likelihood_of_a_rollout_is_that_of_its_tokens_teacher_forced(policy: Path, scenes: SceneStore) -> None:
    model, options, batch, each = sampled(policy, scenes, 2)
    tokens = batch[keys.TOKEN].movedim(1, 2)[None]
    valid = each.controlled[None, None, :, None].expand(1, K, -1, tokens.shape[-1])
    with torch.no_grad():
        context = collate_contexts([make_context(scenes[2], featurize, options)])
        logits = model(context, tokens, valid[:, :1])
    nats = logits.log_softmax(-1).gather(-1, tokens[..., None])[..., 0]
    torch.testing.assert_close(log_likelihood(batch, K), (nats * valid).sum((2, 3)) / valid.sum((2, 3)))


def test_agents_that_the_log_replays_do_not_count(policy: Path, scenes: SceneStore) -> None:
    _, _, batch, _ = sampled(policy, scenes, 2)
    batch = batch.clone()
    batch[keys.CONTROLLED][..., 1:] = False
    torch.testing.assert_close(log_likelihood(batch, K)[0], batch[keys.LOG_PROB][..., 0].mean(1))


def test_the_most_likely_of_all_rollouts_is_kept_and_ranks_are_among_all(
    players: list[PlayerScene], policy: Path, scenes: SceneStore
) -> None:
    _, _, batch, each = sampled(policy, scenes, 2)
    nats, distance = log_likelihood(batch, K)[0], DISTANCE(each.scene, each.trajectories, each.controlled).distance
    kept = players[0].rollouts["wide"]
    first = int(kept.likelihood_rank.argmin())
    assert int(kept.number[first]) == int(nats.argmax()) and int(kept.likelihood_rank[first]) == 0
    assert kept.sampled == K and 4 <= len(kept.number) <= 5
    torch.testing.assert_close(kept.log_likelihood, nats[kept.number])
    torch.testing.assert_close(kept.distance, distance[kept.number])
    assert torch.equal(kept.distance_rank, rank_of(distance)[kept.number])
    assert {0, K - 1} <= set(kept.distance_rank.tolist())
    torch.testing.assert_close(kept.poses, each.trajectories[kept.number][..., [0, 1, 3]])


def test_scenes_come_in_the_order_wanted_with_every_policy_in_its_own_decoding(players: list[PlayerScene]) -> None:
    assert [player.scene.scene_id.split("_")[-1] for player in players] == ["102", "100"]
    for player in players:
        assert list(player.rollouts) == ["sharp", "wide"]
        sharp, wide = (player.rollouts[name].log_likelihood.mean() for name in ("sharp", "wide"))
        assert sharp > wide
    assert json.dumps(pack_players(players), allow_nan=False)


def test_a_policy_without_a_decoding_and_a_distance_that_couples_nothing_are_refused(
    policy: Path, scenes: SceneStore
) -> None:
    with pytest.raises(ValueError, match="policy 'a' has no decoding; there are some for b"):
        roll_out({"a": policy}, scenes, [0], decoding={"b": Decoding()}, num_rollouts=2)
    with pytest.raises(ValueError, match="DisplacementDistance.*couples nothing; give kind: preference"):
        roll_out({"a": policy}, scenes, [0], decoding=Decoding(), num_rollouts=2, distance=DisplacementDistance())


def test_the_recipe_says_how_many_it_rolled_out_and_kept(
    run: Callable, options: Callable, policy: Path, tmp_path: Path
) -> None:
    page = tmp_path / "play.html"
    more = ("show=[0]", "num_rollouts=5", "kept=2", "ranking.stride=5", f"output={page}")
    outcome = run("play", *options("play", f"policies={policy}", *more))
    assert outcome.status == 0, outcome.err
    text = page.read_text(encoding="utf-8")
    assert "5 of each scene" in text and '"sampled":5' in text


if __name__ == "__main__":
    pytest.main([__file__])
