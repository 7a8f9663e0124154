"""Made-up groups, for tests and documentation."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from dpa.preferences.provenance import Provenance
from dpa.ranking.distance import rank_of
from envs import keys


def example_provenance(num_rollouts: int = 8) -> Provenance:
    """A made-up origin."""
    return Provenance(
        policy="none",
        scenes="none",
        ranking={"weights": {"speed": 1.0, "effort": 1.0}, "aggregate": "sum"},
        sampling={},
        seed=0,
        num_rollouts=num_rollouts,
        horizon=16,
        vocab_size=169,
        tokenizer={"name": "verlet"},
    )


def example_groups(num_scenes: int, first: int = 0, num_rollouts: int = 8) -> TensorDict:
    """Made-up groups of batch size ``[num_scenes]``: scenes have 2 to 4 agents, of all classes."""
    generator, num_agents = torch.Generator().manual_seed(first), 4
    size = (num_scenes, num_rollouts, num_agents)
    agents = 2 + (first + torch.arange(num_scenes)) % (num_agents - 1)
    there = torch.arange(num_agents) < agents[:, None]
    agent_distance = torch.rand(size, generator=generator) * there[:, None]
    distance = agent_distance.sum(-1)
    return TensorDict(
        {
            keys.SCENE: first + torch.arange(num_scenes),
            keys.TOKENS: torch.randint(169, (*size, 16), generator=generator) * there[:, None, :, None],
            keys.TOKEN_VALID: there[..., None].expand(-1, -1, 16).clone(),
            keys.DISTANCE: distance,
            keys.AGENT_DISTANCE: agent_distance,
            keys.ADE: distance + torch.rand(size[:2], generator=generator),
            keys.AGENT_RANKED: there,
            keys.AGENT_KIND: (1 + torch.arange(num_agents) % 3) * there,
            keys.FEATURE_SHARE: torch.rand(*size[:2], 2, generator=generator).softmax(-1),
            keys.RANK: rank_of(distance),
        },
        batch_size=[num_scenes],
    )
