"""How tokens are drawn from logits, and the numbers by which they are drawn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from envs.seeding import make_generator


@dataclass(frozen=True)
class Decoding:
    """A sampling distribution made from that of the model: first the temperature, then top-k, then top-p.

    Attributes:
        top_p: keep the smallest set of tokens with at least this probability (nucleus); 1 keeps all.
        temperature: divides the logits.
        top_k: keep the k most probable tokens; 0 keeps all.

    Raises:
        ValueError: a value that makes no distribution.

    Examples:
        >>> logits = torch.tensor([0.5, 0.3, 0.2]).log()
        >>> Decoding(top_p=0.6).log_probs(logits).exp()
        tensor([0.6250, 0.3750, 0.0000])
        >>> Decoding(top_p=1.0, top_k=1).log_probs(logits).exp()
        tensor([1., 0., 0.])
    """

    top_p: float = 0.95
    temperature: float = 1.0
    top_k: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.top_p <= 1:
            raise ValueError(f"top_p must lie in (0, 1], got {self.top_p}.")
        if not self.temperature > 0:
            raise ValueError(f"temperature must be positive, got {self.temperature}.")
        if self.top_k < 0:
            raise ValueError(f"top_k must be 0 (all tokens) or more, got {self.top_k}.")

    def log_probs(self, logits: Tensor) -> Tensor:
        """Log-probabilities ``[..., V]`` of the distribution that is drawn from; minus infinity where nothing is."""
        log_probs = (logits / self.temperature).log_softmax(-1)
        if self.top_p >= 1 and not self.top_k:
            return log_probs
        kept = log_probs >= self._least(log_probs)
        return log_probs.masked_fill(~kept, -torch.inf).log_softmax(-1)

    def _least(self, log_probs: Tensor) -> Tensor:
        """``[..., 1]``: the least log-probability of a token that is kept."""
        ordered = _descending(log_probs)
        if self.top_k:
            ordered = ordered[..., : self.top_k]
        mass = ordered.exp()
        mass = mass / mass.sum(-1, keepdim=True)
        # A token is kept when those before it have not reached top_p yet; the first one always is.
        count = (mass.cumsum(-1) - mass < self.top_p).sum(-1, keepdim=True).clamp(min=1)
        return ordered.gather(-1, count - 1)


def _descending(values: Tensor) -> Tensor:
    if values.device.type == "cpu":  # ten times as fast as torch's sort of short rows
        return torch.from_numpy(np.sort(values.detach().numpy(), -1)).flip(-1)
    return values.sort(-1, descending=True).values


def draw(log_probs: Tensor, uniform: Tensor) -> Tensor:
    """Draw by inversion: the token at which the cumulative distribution passes a number.

    Args:
        log_probs: ``[..., V]``.
        uniform: ``[...]`` in [0, 1).

    Returns:
        ``[...]`` int64 tokens, none of probability 0.

    Examples:
        >>> draw(torch.tensor([0.25, 0.0, 0.75]).log(), torch.tensor(0.3))
        tensor(2)
    """
    reached = log_probs.float().exp().cumsum(-1)
    passed = reached <= uniform[..., None] * reached[..., -1:]
    # Rounding may pass the last token; those behind the last one of any probability are as far.
    last = (reached < reached[..., -1:]).sum(-1)
    return torch.minimum(passed.sum(-1), last)


def rollout_noise(seed: int, scene_id: str, rollout: int, episode: int, shape: tuple[int, int]) -> Tensor:
    """The numbers in [0, 1) that decide the tokens of one rollout.

    They depend on what is named and on nothing else, so a rollout is the same whatever batch it is part of, and
    whoever rolls it out.

    Args:
        seed: of the sampling.
        scene_id: of the scene.
        rollout: k, its number among the rollouts of the scene.
        episode: how often the rollout was begun before.
        shape: ``(T, A)``.

    Returns:
        ``[T, A]``.

    Examples:
        >>> rollout_noise(0, "a scene", rollout=3, episode=0, shape=(16, 2)).shape
        torch.Size([16, 2])
    """
    return torch.rand(shape, generator=make_generator(seed, "rollout", scene_id, rollout, episode))
