"""Verlet tokens of MotionLM: a token changes the displacement of the last half second."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from torch import Tensor

from dpa.tokens.base import MotionTokenizer
from envs.geometry.frames import rotate, wrap_angle
from envs.scene import STEP_SECONDS, AgentKind

CHANGES = 13
"""Changes per coordinate: up to six bins each way (Seff et al. 2023, section 3.2)."""
REACH = 64
"""Largest displacement in bins: 128 bins of 0.28125 m cover [-18, 18] m."""
Interpolation = Literal["linear", "quadratic"]
Frame = Literal["current", "scene"]

DEFAULT_BINS = {"vehicle": (0.28125, 0.140625), "pedestrian": (0.1, 0.1), "cyclist": (0.2, 0.1)}
"""Forward and lateral bin of each class [m per decision]."""
DEFAULT_TURN = {"vehicle": 0.25, "pedestrian": 2.0, "cyclist": 0.5}
"""How far the heading may turn towards the motion, by class [rad per metre moved]."""
_KINDS = {"vehicle": AgentKind.VEHICLE, "pedestrian": AgentKind.PEDESTRIAN, "cyclist": AgentKind.CYCLIST}


def _by_kind(name: str, values: Mapping[str, object], width: int) -> Tensor:
    """A row for every :class:`AgentKind`; unset and other agents take the vehicle's."""
    if set(values) != set(_KINDS):
        raise ValueError(f"{name} needs exactly the classes {sorted(_KINDS)}, got {sorted(values)}.")
    table = torch.tensor(values["vehicle"], dtype=torch.float32).reshape(1, width).repeat(len(AgentKind), 1)
    for kind, row in values.items():
        table[_KINDS[kind]] = torch.tensor(row, dtype=torch.float32)
    if not (table > 0).all():
        raise ValueError(f"{name} must be positive, got {dict(values)}.")
    return table


class VerletTokenizer(MotionTokenizer):
    """C x C changes of the displacement per decision, 13 x 13 in MotionLM (method.md section 2).

    A displacement is a whole number of bins along and across the agent's heading. The displacement of the last
    decision is read from ``recent``, turned into the current frame and rounded to bins. Of 13 x 13 tokens,
    ``13 * i + j`` changes it by ``i - 6`` bins forward and ``j - 6`` bins to the left; 84 keeps the velocity.

    Args:
        steps: F, poses of 0.1 s in one token.

    Keyword Args:
        bins: forward and lateral bin of each class [m per decision].
        changes: C, odd. Finer bins need more of them to brake as hard.
        reach: largest displacement in bins.
        turn: largest change of heading per metre moved, by class [rad/m].
        interpolation: ``"quadratic"`` moves at constant acceleration inside a decision, ``"linear"`` at constant speed.
        frame: ``"current"`` measures along the current heading, ``"scene"`` along the axes of the scene.

    Raises:
        ValueError: an unknown option, a bin that is not positive, an even number of changes, or no reach.

    Examples:
        >>> tokenizer = VerletTokenizer()
        >>> recent = torch.zeros(1, 6, 3)
        >>> recent[0, :, 0] = torch.linspace(-2.8125, 0.0, 6)
        >>> tokenizer.decode(torch.tensor([84]), recent, torch.tensor([1]))[0, -1]
        tensor([2.8125, 0.0000, 0.0000])
    """

    def __init__(
        self,
        steps: int = 5,
        *,
        bins: Mapping[str, tuple[float, float]] = DEFAULT_BINS,
        changes: int = CHANGES,
        reach: int = REACH,
        turn: Mapping[str, float] = DEFAULT_TURN,
        interpolation: Interpolation = "quadratic",
        frame: Frame = "current",
    ) -> None:
        super().__init__()
        if steps < 1:
            raise ValueError(f"steps must be 1 or more poses of 0.1 s, got {steps}.")
        if interpolation not in ("linear", "quadratic"):
            raise ValueError(f"interpolation must be 'linear' or 'quadratic', got {interpolation!r}.")
        if frame not in ("current", "scene"):
            raise ValueError(f"frame must be 'current' or 'scene', got {frame!r}.")
        if changes < 1 or changes % 2 == 0:
            raise ValueError(f"changes must be an odd number of 1 or more, as many each way, got {changes}.")
        if reach < 1:
            raise ValueError(f"reach must be 1 bin or more, got {reach}.")
        self.vocab_size, self.steps = changes**2, steps
        self.changes, self.reach = changes, reach
        self.interpolation = interpolation
        self.frame = frame
        self.register_buffer("bins", _by_kind("bins", bins, 2))
        self.register_buffer("turn", _by_kind("turn", turn, 1)[:, 0])

    def encode(self, target: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The change of displacement that ends nearest to the target, of those there are."""
        end = self._from_own_frame(target[..., -1, :2], recent)
        bins = (end / self.bins[kind]).round()
        most = self.changes // 2
        change = (bins - self._last_bins(recent, kind)).clamp(-most, most).long() + most
        return change[..., 0] * self.changes + change[..., 1]

    def decode(self, token: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The motion at the changed displacement, at most ``reach`` bins each way."""
        change = torch.stack((token // self.changes, token % self.changes), -1) - self.changes // 2
        last_bins = self._last_bins(recent, kind)
        bins = (last_bins + change).clamp(-self.reach, self.reach)
        last, end = (self._to_own_frame(b * self.bins[kind], recent) for b in (last_bins, bins))
        xy = self._interpolate(last, end)
        return torch.cat((xy, self._headings(xy, kind)[..., None]), -1)

    def neighbour(self, token: Tensor, kind: Tensor, drawn: Tensor) -> Tensor:
        """A change of at most one bin more or less in each direction."""
        change = torch.stack((token // self.changes, token % self.changes), -1) + (3 * drawn).long() - 1
        change = change.clamp(0, self.changes - 1)
        return change[..., 0] * self.changes + change[..., 1]

    def _last_bins(self, recent: Tensor, kind: Tensor) -> Tensor:
        """``[*, 2]``: displacement of the last decision in bins, in the frame that is measured in."""
        moved = recent[..., -1, :2] - recent[..., 0, :2]
        if self.frame == "current":
            moved = rotate(moved, -recent[..., -1, 2])
        return (moved / self.bins[kind]).round().clamp(-self.reach, self.reach)

    def _from_own_frame(self, vector: Tensor, recent: Tensor) -> Tensor:
        return vector if self.frame == "current" else rotate(vector, recent[..., -1, 2])

    def _to_own_frame(self, vector: Tensor, recent: Tensor) -> Tensor:
        return vector if self.frame == "current" else rotate(vector, -recent[..., -1, 2])

    def _interpolate(self, last: Tensor, end: Tensor) -> Tensor:
        """``[*, F, 2]`` positions on the way from 0 to ``end``, given the displacement of the last decision.

        At constant acceleration a decision's mean velocity is that of its middle, so it starts at the mean of the two.
        """
        share = torch.arange(1, self.steps + 1, device=end.device, dtype=end.dtype)[:, None] / self.steps
        if self.interpolation == "linear":
            return share * end[..., None, :]
        start = (last + end) / 2
        return (share * start[..., None, :]) + share**2 * (end - start)[..., None, :]

    def _headings(self, xy: Tensor, kind: Tensor) -> Tensor:
        """``[*, F]``: the heading follows the motion, no faster than ``turn``; standing and reversing keep it."""
        moves = torch.diff(xy, dim=-2, prepend=torch.zeros_like(xy[..., :1, :]))
        # Move by move: whoever brakes to a stop at constant acceleration rolls back a little at the end.
        backward = moves[..., 0] < 0
        direction = torch.atan2(moves[..., 1], moves[..., 0]) + torch.pi * backward
        limit = self.turn[kind][..., None] * moves.norm(dim=-1)
        heading, headings = torch.zeros_like(direction[..., 0]), []
        for along, least, most in zip(direction.unbind(-1), (-limit).unbind(-1), limit.unbind(-1), strict=True):
            heading = heading + wrap_angle(along - heading).clamp(least, most)
            headings.append(heading)
        return wrap_angle(torch.stack(headings, -1))

    def extra_repr(self) -> str:
        """Options, for ``print``."""
        seconds = self.steps * STEP_SECONDS
        return f"V={self.vocab_size}, F={self.steps} ({seconds:.1f} s), {self.interpolation}, {self.frame}"
