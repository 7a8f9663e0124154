"""Likelihood of logged values under a distribution that is estimated from rollouts (realism.md section 6)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dpa.realism.config import Histogram, Indicator, Kernel


def log_likelihood(
    log: Tensor, simulated: Tensor, config: Histogram | Kernel, counted: Tensor | None = None, *, keep_nan: bool = True
) -> Tensor:
    """Score each logged value against a distribution of simulated values.

    By default each agent has one distribution of all its steps in all rollouts; ``config.pooled`` shares it among
    agents and ``config.per_step`` gives each step one of its own (realism.md section 6).

    Args:
        log: ``[E, T]``.
        simulated: ``[R, E, T]``.
        config: of the estimator.
        counted: ``[E, T]`` bool, which simulated values take part; all by default, as in the official code.
        keep_nan: a simulated NaN is a sample of the last bin, as in the official code; without, it is none. A kernel
            density never has it.

    Returns:
        ``[E, T]`` [nats]; NaN where a distribution has no sample and no pseudocount.

    Examples:
        >>> config = Histogram(low=0.0, high=2.0, bins=2, pseudocount=0.1, weight=1.0)
        >>> score = log_likelihood(torch.tensor([[0.5, 1.5]]), torch.tensor([[[0.2, 0.3]]]), config)
        >>> score.exp().round(decimals=4)
        tensor([[0.9545, 0.0455]])
    """
    group = _groups(log, config)
    sample = torch.ones_like(simulated, dtype=torch.bool) if counted is None else counted.expand(simulated.shape)
    if not keep_nan or isinstance(config, Kernel):
        sample = sample & ~simulated.isnan()
    estimate = _histogram if isinstance(config, Histogram) else _kernel
    return estimate(log, group, simulated[sample], group.expand(simulated.shape)[sample], config)


def _groups(log: Tensor, config: Histogram | Kernel) -> Tensor:
    """Which distribution each value belongs to, ``[E, T]`` int64 from 0."""
    agents, steps = log.shape
    agent = torch.zeros(agents, 1, dtype=torch.int64, device=log.device)
    if not config.pooled:
        agent = torch.arange(agents, device=log.device)[:, None]
    if config.per_step:
        return agent * steps + torch.arange(steps, device=log.device)
    return agent.expand(-1, steps)


def _histogram(log: Tensor, group: Tensor, samples: Tensor, sample_group: Tensor, config: Histogram) -> Tensor:
    """Log of the smoothed share of samples in the bin of each logged value (realism.md section 6)."""
    groups = (1 if config.pooled else log.shape[0]) * (log.shape[1] if config.per_step else 1)
    # every distribution has its own row of bins in one flat count
    count = torch.bincount(_bin(samples, config) + sample_group * config.bins, minlength=groups * config.bins)
    count = count.to(log.dtype).view(groups, config.bins)
    total = count.sum(1, keepdim=True) + config.bins * config.pseudocount
    return ((count + config.pseudocount) / total).log()[group, _bin(log, config)]


def _kernel(log: Tensor, group: Tensor, samples: Tensor, sample_group: Tensor, config: Kernel) -> Tensor:
    """Log of the mean kernel between the samples and each logged value; 0 at most (realism.md section 6)."""
    score = torch.full_like(log, torch.nan)
    for each in group.unique():
        own, values = group == each, samples[sample_group == each]
        distance = (log[own, None] - values) / config.bandwidth
        score[own] = torch.logsumexp(-distance.square() / 2, -1) - math.log(max(1, len(values)))
    return score


def indicator_log_likelihood(log: Tensor, simulated: Tensor, config: Indicator) -> Tensor:
    """Score whether an event happened in the log against how often it happens in the rollouts.

    Args:
        log: ``[E]`` bool.
        simulated: ``[R, E]`` bool.
        config: pseudocount; ``pooled`` shares one probability among agents.

    Returns:
        ``[E]`` [nats].

    Examples:
        >>> config = Indicator(pseudocount=0.0, weight=1.0)
        >>> indicator_log_likelihood(torch.tensor([True]), torch.tensor([[True], [False]]), config).exp()
        tensor([0.5000])
    """
    true, samples = simulated.sum(0).float(), simulated.shape[0]
    if config.pooled:
        true, samples = true.sum().expand_as(true), simulated.numel()
    count = torch.where(log, true, samples - true)
    return ((count + config.pseudocount) / (samples + 2 * config.pseudocount)).log()


def _bin(value: Tensor, config: Histogram) -> Tensor:
    """Index of the bin ``[left, right)`` of each value; the end bins take what lies beyond, the last one NaN."""
    edges = histogram_edges(config).to(value.device)
    index = torch.bucketize(value.contiguous(), edges, right=True) - 1
    return torch.where(value.isnan(), config.bins - 1, index.clamp(0, config.bins - 1))


def histogram_edges(config: Histogram) -> Tensor:
    """``[bins + 1]`` float32; computed step by step in float32 like the official ones, equal to them bit for bit."""
    low, high = torch.tensor(config.low), torch.tensor(config.high)
    edges = low + torch.arange(config.bins + 1) * ((high - low) / config.bins)
    edges[-1] = high
    return edges
