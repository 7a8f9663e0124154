"""Likelihood of logged values under a distribution that is estimated from rollouts (SPEC section 6)."""

from __future__ import annotations

import torch
from torch import Tensor

from dpa.realism.config import Histogram, Indicator


def histogram_log_likelihood(log: Tensor, simulated: Tensor, config: Histogram) -> Tensor:
    """Score each logged value against one histogram for each agent, of all its simulated values.

    Values outside the range fall into the end bins. A value that is NaN falls into the last bin, as in the official
    code: the differences at the end of a rollout are NaN, and they are counted.

    Args:
        log: ``[E, T]``.
        simulated: ``[R, E, T]``.
        config: range and bins.

    Returns:
        ``[E, T]`` [nats].

    Examples:
        >>> config = Histogram(low=0.0, high=2.0, bins=2, pseudocount=0.1, weight=1.0)
        >>> score = histogram_log_likelihood(torch.tensor([[0.5, 1.5]]), torch.tensor([[[0.2, 0.3]]]), config)
        >>> score.exp().round(decimals=4)
        tensor([[0.9545, 0.0455]])
    """
    num_agents = log.shape[0]
    # every agent has its own row of bins in one flat count
    offset = torch.arange(num_agents, device=log.device)[:, None] * config.bins
    log_bin = _bin(log, config) + offset
    simulated_bin = _bin(simulated, config) + offset
    count = torch.bincount(simulated_bin.flatten(), minlength=num_agents * config.bins).to(log.dtype)
    samples = simulated.shape[0] * simulated.shape[2]
    probability = (count + config.pseudocount) / (samples + config.bins * config.pseudocount)
    return probability.log()[log_bin]


def indicator_log_likelihood(log: Tensor, simulated: Tensor, config: Indicator) -> Tensor:
    """Score whether an event happened in the log against how often it happens in the rollouts.

    Args:
        log: ``[E]`` bool.
        simulated: ``[R, E]`` bool.
        config: pseudocount.

    Returns:
        ``[E]`` [nats].

    Examples:
        >>> config = Indicator(pseudocount=0.0, weight=1.0)
        >>> indicator_log_likelihood(torch.tensor([True]), torch.tensor([[True], [False]]), config).exp()
        tensor([0.5000])
    """
    true = simulated.sum(0).float()
    count = torch.where(log, true, simulated.shape[0] - true)
    return ((count + config.pseudocount) / (simulated.shape[0] + 2 * config.pseudocount)).log()


def _bin(value: Tensor, config: Histogram) -> Tensor:
    """Index of the bin ``[left, right)`` of each value; the last bin is closed and takes NaN."""
    edges = histogram_edges(config).to(value.device)
    index = torch.bucketize(value.contiguous(), edges, right=True) - 1
    return torch.where(value.isnan(), config.bins - 1, index.clamp(0, config.bins - 1))


def histogram_edges(config: Histogram) -> Tensor:
    """``[bins + 1]`` float32; computed step by step in float32 like the official ones, equal to them bit for bit."""
    low, high = torch.tensor(config.low), torch.tensor(config.high)
    edges = low + torch.arange(config.bins + 1) * ((high - low) / config.bins)
    edges[-1] = high
    return edges
