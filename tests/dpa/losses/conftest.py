"""A network whose logits are its parameters, so that every loss can be written down by hand."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.objectives import LossModule

from dpa.losses import token_network
from dpa.models import collate_contexts, make_context
from dpa.models.motionlm import SceneContext, featurize
from envs.sources.synthetic import straight_road

TOKENS = 5


class Table(nn.Module):
    """The same logits ``[A, T, V]`` for every scene and rollout."""

    def __init__(self, logits: Tensor) -> None:
        super().__init__()
        self.logits = nn.Parameter(logits)

    def forward(self, context: SceneContext, tokens: Tensor, token_valid: Tensor) -> Tensor:
        return (1 * self.logits).expand(*tokens.shape[:2], *self.logits.shape)


def table(agents: int = 2, horizon: int = 3, seed: int = 0) -> Table:
    generator = torch.Generator().manual_seed(seed)
    return Table(torch.randn(agents, horizon, TOKENS, generator=generator))


def pairs(
    agents: int = 2, horizon: int = 3, scenes: int = 1, num: int = 2, seed: int = 1, num_unpreferred: int | None = None
) -> TensorDict:
    """Sides of random rollouts; the last agent leaves after the first decision."""
    generator = torch.Generator().manual_seed(seed)
    shape, other = (scenes, num, agents, horizon), (scenes, num_unpreferred or num, agents, horizon)
    valid = torch.ones(scenes, 1, agents, horizon, dtype=torch.bool)
    valid[:, :, -1, 1:] = False
    return TensorDict(
        {
            "context": collate_contexts([make_context(straight_road(agents), featurize)] * scenes),
            "preferred": torch.randint(TOKENS, shape, generator=generator),
            "unpreferred": torch.randint(TOKENS, other, generator=generator),
            "token_valid": valid,
        },
        batch_size=[scenes],
    )


@pytest.fixture
def network():
    """The table as the network of a loss, and its logits."""
    module = table()
    return token_network(module), module.logits.detach().clone()


@pytest.fixture
def trained(network: tuple) -> Callable[[LossModule], Tensor]:
    """Moves the logits of a loss's policy, as some training does, and gives the new ones."""

    def train(loss: LossModule) -> Tensor:
        now = network[1] + torch.randn(network[1].shape, generator=torch.Generator().manual_seed(3))
        with torch.no_grad():
            loss.actor_network_params["module", "logits"].copy_(now)
        return now

    return train


@pytest.fixture
def make_batch() -> Callable[..., TensorDict]:
    """:func:`pairs`."""
    return pairs


@pytest.fixture
def batch() -> TensorDict:
    """One scene, two pairs, two agents, three decisions."""
    return pairs()
