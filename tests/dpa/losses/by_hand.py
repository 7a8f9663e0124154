"""Scores of the conftest's batches in plain Python, one token at a time."""

from __future__ import annotations

import math

from torch import Tensor

VALID = [(0, 0), (0, 1), (0, 2), (1, 0)]
"""(agent, decision) of a batch's valid tokens."""
TOKENS_OF_A_ROLLOUT, AGENTS = len(VALID), 2
SHARE = {"sum": 1.0, "agent_mean": 1 / AGENTS, "token_mean": 1 / TOKENS_OF_A_ROLLOUT}
"""What a score keeps of a sum over tokens."""


def log_softmax(row: list[float]) -> list[float]:
    total = math.log(sum(math.exp(x) for x in row))
    return [x - total for x in row]


def log_likelihood(logits: Tensor, tokens: Tensor, agent: int | None = None) -> float:
    """Of the valid tokens ``[A, T]`` of one rollout, or of one agent in it."""
    return sum(log_softmax(logits[i, t].tolist())[tokens[i, t]] for i, t in VALID if agent is None or i == agent)


def gain(now: Tensor, start: Tensor | None, tokens: Tensor, agent: int | None = None) -> float:
    """Log-likelihood, minus that under the reference where there is one."""
    return log_likelihood(now, tokens, agent) - (0.0 if start is None else log_likelihood(start, tokens, agent))


def divergence(now: Tensor, start: Tensor) -> float:
    """KL from the reference, summed over the valid tokens of a rollout; a table's is the same for every rollout."""
    total = 0.0
    for i, t in VALID:
        ours, theirs = log_softmax(now[i, t].tolist()), log_softmax(start[i, t].tolist())
        total += sum(math.exp(x) * (x - y) for x, y in zip(ours, theirs, strict=True))
    return total


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))
