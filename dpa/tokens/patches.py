"""Tokens without a vocabulary: the next poses themselves (BehaviorGPT, arXiv 2405.17372)."""

from __future__ import annotations

import torch
from torch import Tensor

from dpa.tokens.base import MotionTokenizer
from envs.geometry.frames import wrap_angle
from envs.scene import STEP_SECONDS

ALIKE = 0.1
"""Patches that differ by less are one motion [m, rad]."""


class PatchTokenizer(MotionTokenizer):
    """A token is the patch of F poses, three numbers each, in the agent's own frame at its start.

    Nothing is lost, so the log through tokens is the log. There is no vocabulary, hence no probability of a token but
    a density, and no noisy tokenization.

    Args:
        steps: F.

    Raises:
        ValueError: no steps.

    Examples:
        >>> tokenizer = PatchTokenizer(steps=10)
        >>> recent, kind = torch.zeros(1, 11, 3), torch.tensor([1])
        >>> target = torch.rand(1, 10, 3)
        >>> torch.allclose(tokenizer.decode(tokenizer.encode(target, recent, kind), recent, kind), target)
        True
    """

    vocab_size = 0

    def __init__(self, steps: int = 10) -> None:
        super().__init__()
        if steps < 1:
            raise ValueError(f"a patch has 1 pose or more, got steps={steps}.")
        self.steps, self.shape = steps, (3 * steps,)

    def encode(self, target: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The poses as they are, headings from -pi to pi."""
        return torch.cat((target[..., :2], wrap_angle(target[..., 2:])), -1).flatten(-2)

    def decode(self, token: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The poses themselves."""
        return token.unflatten(-1, (self.steps, 3))

    def neighbour(self, token: Tensor, kind: Tensor, drawn: Tensor) -> Tensor:
        """There are none.

        Raises:
            ValueError: always.
        """
        raise ValueError("patches have no neighbours, so there is no noisy tokenization of them; set token_noise=0.")

    def alike(self, one: Tensor, other: Tensor) -> Tensor:
        """Patches that differ by less than :data:`ALIKE` everywhere."""
        return ((one - other).abs() < ALIKE).all(-1)

    def extra_repr(self) -> str:
        """Options, for ``print``."""
        return f"F={self.steps} ({self.steps * STEP_SECONDS:.1f} s)"
