"""Tokens that are motions of a vocabulary (k-disks), one table for each class of agent."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor

from dpa.tokens.base import MotionTokenizer
from dpa.tokens.vocabulary import corners, digest_of, read_vocabulary
from envs.devices import of_rows, on_host
from envs.scene import STEP_SECONDS, AgentKind

NEAR = 5
"""Entries among which noisy tokenization draws, as in SMART (k = 5)."""


class KDisksTokenizer(MotionTokenizer):
    """A token is one of V logged motions of the agent's class, whatever the agent did before.

    A motion is encoded as the entry with the smallest root mean square distance of the corners of a box of the class,
    over all F poses. Encoding goes on from where the tokens before have led (rolling matching), as of any tokenizer.

    The motions are buffers, so they are part of a policy's weights, and a policy needs no file to be opened.

    Args:
        steps: F.
        size: V.
        digest: of the motions; the weights of a policy bring them.

    Raises:
        ValueError: no steps or no entries.

    Examples:
        >>> from dpa.tokens.vocabulary import k_disks, logged_motions, stacked
        >>> from envs.sources.synthetic import straight_road
        >>> motions = logged_motions([straight_road(9)], 5)[AgentKind.VEHICLE]
        >>> table = stacked({AgentKind.VEHICLE: k_disks(motions, 1, 64, 0.2, torch.Generator())})
        >>> tokenizer = KDisksTokenizer.of(table)
        >>> still = torch.zeros(1, 6, 3)
        >>> tokenizer.encode(still[:, 1:], still, torch.tensor([1]))
        tensor([0])
    """

    by_class = True

    def __init__(self, steps: int, size: int, digest: str) -> None:
        super().__init__()
        if steps < 1 or size < 1:
            raise ValueError(f"a vocabulary needs steps and entries, got steps={steps} and size={size}.")
        self.vocab_size, self.steps, self.digest = size, steps, digest
        self.register_buffer("motions", torch.zeros(len(AgentKind), size, steps, 3))
        self.register_buffer("points", torch.zeros(len(AgentKind), size, steps * 8), persistent=False)
        self._near: Tensor | None = None
        self.register_load_state_dict_post_hook(_measure)

    @classmethod
    def settled(cls, table: str | None = None, **options: Any) -> dict[str, Any]:
        """The size and digest of a vocabulary's file; options without one are settled.

        Raises:
            FileNotFoundError: no such file.
            ValueError: the file is no vocabulary.
        """
        if table is None:
            return options
        motions = read_vocabulary(Path(table)).motions
        return {"steps": motions.shape[2], "size": motions.shape[1], "digest": digest_of(motions)}

    def fill(self, table: str | None = None, **options: Any) -> None:
        """Take over the motions of a vocabulary's file.

        Raises:
            ValueError: none is named, or another one than the options were settled with.
        """
        if table is None:
            raise ValueError("k_disks needs table=FILE.npz, which python -m recipes.vocabulary makes.")
        motions = read_vocabulary(Path(table)).motions
        if digest_of(motions) != self.digest:
            raise ValueError(f"{table} holds the vocabulary {digest_of(motions)}, and {self.digest} is asked for.")
        self.motions.copy_(motions)
        self.measure()

    @classmethod
    def of(cls, motions: Tensor) -> Self:
        """The tokenizer of a vocabulary's motions ``[kinds, V, F, 3]``."""
        tokenizer = cls(motions.shape[2], motions.shape[1], digest_of(motions))
        tokenizer.motions.copy_(motions)
        tokenizer.measure()
        return tokenizer

    def measure(self) -> None:
        """What follows from the motions: corners of all entries, and which lie near each other."""
        tables = zip(AgentKind, self.motions, strict=True)
        self.points.copy_(torch.stack([corners(motions, kind) for kind, motions in tables]))
        self._near = None

    def encode(self, target: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The entry of the class that comes nearest; of equals the first."""
        token = torch.zeros_like(kind)
        # A device would have to be waited for to hear which classes there are, so there all of them are tried.
        for each in kind.unique().tolist() if on_host(kind) else AgentKind:
            own = kind == each
            nearest = of_rows(own, partial(self._nearest, AgentKind(each)), target)
            token = torch.where(own, nearest, token)
        return token

    def _nearest(self, kind: AgentKind, target: Tensor) -> Tensor:
        """The nearest entry of a class to motions ``[*, F, 3]``: ``[*]``."""
        places = corners(target.reshape(-1, *target.shape[-2:]), kind)
        return torch.cdist(places, self.points[kind]).argmin(-1).view(target.shape[:-2])

    def decode(self, token: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The motion itself."""
        return self.motions[kind, token]

    def neighbour(self, token: Tensor, kind: Tensor, drawn: Tensor) -> Tensor:
        """One of the :data:`NEAR` entries nearest to each, itself among them."""
        if self._near is None:
            self._near = torch.stack([nearest_others(points, NEAR) for points in self.points])
        return self._near[kind, token, (self._near.shape[-1] * drawn[..., 0]).long()]

    def extra_repr(self) -> str:
        """Options, for ``print``."""
        return f"V={self.vocab_size}, F={self.steps} ({self.steps * STEP_SECONDS:.1f} s), {self.digest}"


def nearest_others(points: Tensor, count: int) -> Tensor:
    """The nearest entries of each entry, itself among them.

    A class of few motions is filled up with copies, among which nothing would be drawn: they count for none. Where
    there are fewer other motions than asked for, the entry itself stands for the rest.

    Args:
        points: ``[V, C]``.
        count: entries for each.

    Returns:
        ``[V, min(count, V)]`` indices.

    Examples:
        >>> nearest_others(torch.tensor([[0.0], [1.0], [5.0], [0.0]]), 3)
        tensor([[0, 1, 2],
                [1, 0, 2],
                [2, 1, 0],
                [0, 1, 2]])
    """
    apart = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    copies = (apart == 0).tril(-1).any(1)
    near, index = apart.masked_fill(copies, torch.inf).topk(min(count, len(points)), largest=False)
    return torch.where(near.isfinite(), index, index[:, :1])


def _measure(tokenizer: KDisksTokenizer, _: object) -> None:
    """After weights were loaded."""
    tokenizer.measure()
