"""Policies of the zoo do what they did before there were families: tokens to the bit, distances and losses to rounding.

The values are those of commit f82e072 (26 November 2026), in which MotionLM was the only policy.
"""

from __future__ import annotations

import hashlib
from functools import partial

import pytest
import torch

from dpa.losses import NextTokenLoss, token_network
from dpa.models import make_context
from dpa.ranking.transform import RankRollouts
from dpa.rollout import make_collector
from dpa.training.batches import collate_items
from dpa.training.logs import log_item
from envs import keys
from envs.sources.synthetic import straight_road
from recipes.common.models import open_policy

SCENES = [straight_road(3, seed=1), straight_road(7, seed=2)]
BEFORE = {
    "zoo:motionlm-nano-sumo": (
        "e9e0cf2b6f897b12",
        [[10.609, 10.015, 10.468, 8.181], [22.731, 23.024, 28.693, 32.416]],
        1.268054,
    ),
    "zoo:motionlm-paper-sumo": (
        "2cd4970883cd4e78",
        [[11.919, 13.406, 12.022, 9.188], [22.947, 21.4, 23.637, 25.504]],
        1.27058,
    ),
}
"""Digest of the tokens of four rollouts, their distances, and the loss of the logs."""


@pytest.mark.parametrize("name", BEFORE)
def test_rollouts_distances_and_losses_are_those_of_before(name: str) -> None:
    model, episode, _ = open_policy(name)
    digest, distances, nll = BEFORE[name]
    rank, found = partial(RankRollouts, num_rollouts=4), {}
    for groups in make_collector(SCENES, model, num_rollouts=4, options=episode, seed=5, make_postproc=rank):
        found |= {int(group[keys.SCENE]): group for group in groups}
    tokens = torch.cat([found[i][keys.TOKENS][:, : len(SCENES[i].agents.sdc)].flatten() for i in (0, 1)])
    assert hashlib.sha256(tokens.numpy().tobytes()).hexdigest()[:16] == digest
    given = torch.stack([found[i][keys.DISTANCE] for i in (0, 1)])
    torch.testing.assert_close(given, torch.tensor(distances), atol=2e-3, rtol=0, check_dtype=False)
    items = [log_item(make_context(scene, model.featurize, episode), model.tokenizer) for scene in SCENES]
    with torch.no_grad():
        loss = NextTokenLoss(token_network(model))(collate_items(items))
    assert float(loss["loss_next_token"]) == pytest.approx(nll, abs=1e-4)


if __name__ == "__main__":
    pytest.main([__file__])
