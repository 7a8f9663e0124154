"""Tokens without a vocabulary: the next poses themselves (BehaviorGPT, arXiv 2405.17372)."""

from __future__ import annotations

import torch
from torch import Tensor

from dpa.tokens.base import MotionTokenizer
from envs.geometry.frames import beside, rotate, wrap_angle
from envs.scene import STEP_SECONDS

STILL = (0.02, 0.02)
"""An agent stands whose patch stays within this for each second of it [m, rad]."""
ALIKE = 0.1
"""Patches that differ by less are one motion [m, rad]."""
AHEAD, TURNED = 0.3, 0.05
"""How far noise moves the end of a patch along [m], and turns it [rad]; by less where it covers less than the next."""
FULL_TURN = 3.0
"""[m]"""


class PatchTokenizer(MotionTokenizer):
    """A token is the patch of F poses, three numbers each, in the agent's own frame at its start.

    Nothing is lost but what is too little to be a motion (:data:`STILL`), so the log through tokens is the log to two
    centimetres. There is no vocabulary, hence no probability of a token but a density. Noisy tokenization draws motions
    that end a little elsewhere.

    Args:
        steps: F.

    Raises:
        ValueError: no steps.

    Examples:
        >>> tokenizer = PatchTokenizer(steps=10)
        >>> recent, kind = torch.zeros(1, 11, 3), torch.tensor([1])
        >>> target = torch.rand(1, 10, 3)
        >>> again = tokenizer.decode(tokenizer.encode(target, recent, kind), recent, kind)
        >>> torch.allclose(again, target, atol=1e-5)
        True
    """

    vocab_size = 0

    def __init__(self, steps: int = 10) -> None:
        super().__init__()
        if steps < 1:
            raise ValueError(f"a patch has 1 pose or more, got steps={steps}.")
        self.steps, self.shape = steps, (3 * steps,)

    def encode(self, target: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The poses as they are, headings from -pi to pi; zeros where the agent stands."""
        place, heading, seconds = target[..., :2], wrap_angle(target[..., 2:]), self.steps * STEP_SECONDS
        moves = (place.norm(dim=-1) > STILL[0] * seconds) | (heading[..., 0].abs() > STILL[1] * seconds)
        patch = torch.cat((place, heading), -1).flatten(-2)
        return torch.where(moves.any(-1, keepdim=True), patch, 0.0)

    def decode(self, token: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The poses themselves."""
        return token.unflatten(-1, (self.steps, 3))

    def neighbour(self, token: Tensor, kind: Tensor, drawn: Tensor) -> Tensor:
        """A patch that ends up to :data:`AHEAD` farther or nearer, turned by up to :data:`TURNED` where it moves."""
        poses, done = self.decode(token, token, kind), self._done(token)
        ahead, turned = (2 * drawn[..., None] - 1).unbind(-2)
        moves = (poses[..., -1:, :2].norm(dim=-1) / FULL_TURN).clamp(max=1)
        turned = TURNED * turned * moves * done
        place = rotate(poses[..., :2], turned / 2)  # as along an arc
        heading = poses[..., 2] + turned
        further = AHEAD * ahead * done**2
        place = place + further[..., None] * torch.stack((heading.cos(), heading.sin()), -1)
        return self.encode(torch.cat((place, heading[..., None]), -1), token, kind)

    def way_back(self, target: Tensor, recent: Tensor, start: Tensor, known: Tensor, recovery: float) -> Tensor:
        """See :meth:`MotionTokenizer.way_back`; offset and velocity change smoothly from what they are."""
        done = self._done(target)
        left = 1 - recovery * done**2 * (3 - 2 * done)
        path = beside(target, recent[..., -1, :], start, left * known[..., None])
        faster = (recent[..., -1, :2] - recent[..., -2, :2]) - (target[..., 0, :2] - start[..., :2])  # [m] in 0.1 s
        further = self.steps * faster[..., None, :] * (done * (1 - done) ** 2 * known[..., None])[..., None]
        return torch.cat((path[..., :2] + further, path[..., 2:]), -1)

    def _done(self, like: Tensor) -> Tensor:
        """``[F]``: how much of the patch has passed."""
        return torch.linspace(0, 1, self.steps + 1, device=like.device)[1:]

    def alike(self, one: Tensor, other: Tensor) -> Tensor:
        """Patches that differ by less than :data:`ALIKE` everywhere."""
        return ((one - other).abs() < ALIKE).all(-1)

    def extra_repr(self) -> str:
        """Options, for ``print``."""
        return f"F={self.steps} ({self.steps * STEP_SECONDS:.1f} s)"
