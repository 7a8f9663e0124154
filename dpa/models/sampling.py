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

    Tokens of equal probability are kept or cut together.

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
        log_probs = (logits if self.temperature == 1 else logits / self.temperature).log_softmax(-1)
        if self.top_p >= 1 and not self.top_k:
            return log_probs
        least, mass = self._cut(log_probs)
        return torch.where(log_probs >= least, log_probs - mass.log(), -torch.inf)

    def _cut(self, log_probs: Tensor) -> tuple[Tensor, Tensor]:
        """``[..., 1]`` each: the least log-probability of a token that is kept, and the probability of all that are."""
        ordered = _descending(log_probs)
        reached = ordered.exp().cumsum(-1)
        most = reached[..., : self.top_k or None]
        # A token is kept when those before it have not reached top_p yet; the first one always is.
        later = (most[..., :-1] < self.top_p * most[..., -1:]).sum(-1, keepdim=True)
        least = ordered.gather(-1, later)
        last = (ordered >= least).sum(-1, keepdim=True) - 1  # equals of the least one are kept as well
        return least, reached.gather(-1, last)


def _descending(values: Tensor) -> Tensor:
    if values.device.type == "cpu" and not values.requires_grad:  # ten times as fast as torch's sort of short rows
        return torch.from_numpy(np.sort(values.numpy(), -1)).flip(-1)
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
    most = reached[..., -1:]
    # Rounding may reach the end, where tokens of no probability may follow the last one that has some.
    place = torch.minimum(uniform[..., None] * most, most.nextafter(torch.zeros_like(most)))
    return torch.searchsorted(reached, place, right=True)[..., 0]


def rollout_noise(seed: int, scene_id: str, rollout: int, episode: int, shape: tuple[int, ...]) -> Tensor:
    """The numbers in [0, 1) that decide the tokens of one rollout.

    They depend on what is named and on nothing else, so a rollout is the same whatever batch it is part of, and
    whoever rolls it out.

    Args:
        seed: of the sampling.
        scene_id: of the scene.
        rollout: k, its number among the rollouts of the scene.
        episode: how often the rollout was begun before.
        shape: ``(T, A, numbers of a draw)``.

    Returns:
        of that shape.

    Examples:
        >>> rollout_noise(0, "a scene", rollout=3, episode=0, shape=(16, 2, 1)).shape
        torch.Size([16, 2, 1])
    """
    return torch.rand(shape, generator=make_generator(seed, "rollout", scene_id, rollout, episode))
