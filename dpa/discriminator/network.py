"""The discriminator itself: a recurrent network over one agent's steps; a scene's score is the mean over its agents."""

from __future__ import annotations

import torch
from scipy.stats import rankdata
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits

LARGEST = 5.0
"""Standardised inputs are cut here: one wild acceleration must not decide a batch."""


class Discriminator(nn.Module):
    """Says of an agent's motion how much rather it comes from a log than from a rollout.

    Args:
        num_features: D.
        width: of the recurrent state.

    Examples:
        >>> net = Discriminator(num_features=3)
        >>> values, valid = torch.randn(4, 2, 16, 3), torch.ones(2, 16, dtype=torch.bool)
        >>> net(values, valid).shape, net.score(values, valid).shape
        (torch.Size([4, 2]), torch.Size([4]))
    """

    def __init__(self, num_features: int, width: int = 32) -> None:
        super().__init__()
        self.register_buffer("centre", torch.zeros(num_features))
        self.register_buffer("scale", torch.ones(num_features))
        self.enter = nn.Sequential(nn.Linear(num_features, width), nn.ReLU())
        self.recur = nn.GRU(width, width, batch_first=True)
        self.leave = nn.Linear(width, 1)

    def standardise(self, values: Tensor) -> None:
        """Take the centre and the scale of the inputs from examples ``[N, D]``; a constant input becomes 0."""
        self.centre.copy_(values.mean(0))
        scale = values.std(0)
        self.scale.copy_(torch.where(scale > 0, scale, torch.inf))

    def forward(self, values: Tensor, valid: Tensor) -> Tensor:
        """Logit of each agent: the mean over its valid steps, each of which knows the steps before it.

        Args:
            values: ``[*, T, D]``.
            valid: ``[*, T]`` bool, broadcast against the values.

        Returns:
            ``[*]``: positive where a log is more likely; 0 for an agent without a valid step.
        """
        valid = valid.expand(values.shape[:-1])
        inputs = ((values - self.centre) / self.scale).clamp(-LARGEST, LARGEST)
        inputs = torch.where(valid[..., None], inputs, 0.0)
        state, _ = self.recur(self.enter(inputs).flatten(end_dim=-3))
        logits = self.leave(state)[..., 0].view(valid.shape)
        return (logits * valid).sum(-1) / valid.sum(-1).clamp(min=1)

    def score(self, values: Tensor, valid: Tensor) -> Tensor:
        """Score of each rollout of a scene: the mean over the agents that have a valid step.

        Args:
            values: ``[R, E, T, D]``.
            valid: ``[E, T]`` bool.

        Returns:
            ``[R]``; 0 where no agent has a valid step.
        """
        counted = valid.any(-1)
        return self(values, valid)[:, counted].sum(-1) / counted.sum().clamp(min=1)


def discriminator_loss(net: Discriminator, log: Tensor, rollout: Tensor, valid: Tensor, weight: Tensor) -> Tensor:
    """Binary cross-entropy of agents, log = 1 and rollout = 0: as many of one as of the other.

    Args:
        net: the discriminator.
        log: ``[N, T, D]`` agents as logged.
        rollout: ``[N, T, D]`` the same agents in a rollout.
        valid: ``[N, T]`` bool, the same for both sides.
        weight: ``[N]`` of each agent; one over the agents of its scene lets every scene count the same.

    Returns:
        scalar [nats]; log 2 for a network that cannot tell them apart.

    Examples:
        >>> net = Discriminator(3)
        >>> same = torch.randn(5, 16, 3)
        >>> valid, weight = torch.ones(5, 16, dtype=torch.bool), torch.ones(5)
        >>> bool(discriminator_loss(net, same, same, valid, weight) >= 0.6931)
        True
    """
    logits = net(torch.stack((log, rollout)), valid)
    labels = torch.stack((torch.ones_like(logits[0]), torch.zeros_like(logits[1])))
    each = binary_cross_entropy_with_logits(logits, labels, reduction="none").mean(0)
    return (each * weight).sum() / weight.sum()


def auc(positive: Tensor, negative: Tensor) -> float:
    """Chance that one of the positives scores higher than one of the negatives; a tie is half of one.

    Args:
        positive: ``[N]``.
        negative: ``[M]``.

    Raises:
        ValueError: one of them is empty.

    Examples:
        >>> auc(torch.tensor([2.0, 3.0]), torch.tensor([1.0, 2.0]))
        0.875
    """
    n, m = len(positive), len(negative)
    if not n or not m:
        raise ValueError(f"an AUC compares positives with negatives, got {n} and {m} of them.")
    ranks = rankdata(torch.cat((positive, negative)).numpy())
    return float((ranks[:n].sum() - n * (n + 1) / 2) / (n * m))
