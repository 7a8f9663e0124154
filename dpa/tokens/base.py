"""The contract of a motion tokenizer, and what follows from it for whole tracks."""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor, nn

from envs.geometry.frames import beside, to_local, to_world


class TokenizedTracks(NamedTuple):
    """Tracks as tokens.

    Attributes:
        tokens: ``[*, A, T, ...]``.
        valid: ``[*, A, T]`` bool, the token was encoded from logged poses; false from the first hole of a log on.
        poses: ``[*, A, T * F, 3]``, what the tokens decode to, in the scene's frame.
        labels: ``[*, A, T, ...]``, the token that comes nearest to the log from where the tokens before have led; it
            differs from ``tokens`` where noise has replaced it.
    """

    tokens: Tensor
    valid: Tensor
    poses: Tensor
    labels: Tensor


class MotionTokenizer(nn.Module):
    """Maps one token to the F next poses of an agent, and back.

    A token is an index into a vocabulary, or, where there is none, a few numbers: then every tensor of tokens has them
    in dimensions of its own after those of agents and decisions.

    A tokenizer has no memory: what it needs of the past it reads from ``recent``, the poses of the last decision. A
    subclass gives ``vocab_size``, ``steps`` (F), :meth:`encode`, :meth:`decode` and :meth:`neighbour`; tables and bin
    sizes are buffers.

    Attributes:
        vocab_size: V; 0 where there is no vocabulary.
        steps: F, poses of 0.1 s in one token.
        shape: of one token, ``()`` for an index.
        by_class: a token is another motion for each class of agent, whatever the agent did before.
    """

    vocab_size: int
    steps: int
    shape: tuple[int, ...] = ()
    by_class: bool = False

    @property
    def dtype(self) -> torch.dtype:
        """Of tokens."""
        return torch.int64 if self.vocab_size else torch.float32

    @classmethod
    def settled(cls, **options: Any) -> dict[str, Any]:
        """Options as a checkpoint holds them: those that do not depend on a file of the machine."""
        return options

    def fill(self, **options: Any) -> None:
        """Take over what options name that :meth:`settled` leaves out; a policy from a file has it in its weights."""

    @abstractmethod
    def encode(self, target: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The token that comes nearest to a motion.

        Args:
            target: ``[*, F, 3]`` next poses, in the agent's own current frame.
            recent: ``[*, F + 1, 3]`` poses of the last decision in any common frame, the current one last.
            kind: ``[*]`` :class:`~envs.scene.AgentKind`.

        Returns:
            ``[*, ...]``.
        """

    @abstractmethod
    def decode(self, token: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """The motion of a token: ``[*, F, 3]`` poses in the agent's own current frame (arguments as in encode)."""

    @abstractmethod
    def neighbour(self, token: Tensor, kind: Tensor, drawn: Tensor) -> Tensor:
        """A random token of nearly the same motion as each token ``[*, ...]``, for noisy tokenization.

        Args:
            token: ``[*, ...]``.
            kind: ``[*]`` or what broadcasts to it.
            drawn: ``[*, 2]`` uniform in [0, 1): what decides which neighbour.
        """

    def encode_tracks(
        self,
        poses: Tensor,
        valid: Tensor,
        recent: Tensor,
        kind: Tensor,
        *,
        noise: float = 0.0,
        recovery: float = 1.0,
        drawn: Tensor | None = None,
    ) -> TokenizedTracks:
        """Tokenize tracks greedily on the reconstructed track, so that errors do not add up (method.md section 2).

        A token is valid up to the first decision in which the log misses its last pose. With ``noise``, some tokens
        are replaced by neighbours and the labels lead back to the log: whoever learns the labels learns to recover
        from its own errors (Philion et al. 2024, section 3.3). Where tokens change a velocity, to be back at once is
        harsh: with a ``recovery`` below 1 the labels come back slowly.

        Args:
            poses: ``[*, A, T * F, 3]`` logged poses after the current step.
            valid: ``[*, A, T * F]`` bool.
            recent: ``[*, A, F + 1, 3]``.
            kind: ``[*, A]``.

        Keyword Args:
            noise: probability with which a token is replaced.
            recovery: share of the offset from the log, seen from the log's own pose, that a label makes good.
            drawn: ``[*, A, T, 3]`` uniform in [0, 1), from which the noise is taken; needed only where there is any.
        """
        decisions = poses.unflatten(-2, (-1, self.steps))
        ends = valid.unflatten(-1, (-1, self.steps))[..., -1]
        token_valid = ends.cummin(-1).values
        tokens, labels, tracks = [], [], []
        for step in range(decisions.shape[-3]):
            target = decisions[..., step, :, :]
            if noise and step:
                before = decisions[..., step - 1, -1, :], ends[..., step - 1]
                target = self.way_back(target, recent, *before, recovery)
            target = to_local(target, recent[..., -1:, :])
            labels.append(self.encode(target, recent, kind))
            tokens.append(self._noisy(labels[-1], kind, noise, drawn[..., step, :]) if noise else labels[-1])
            recent = self.advance(tokens[-1], recent, kind)
            tracks.append(recent[..., 1:, :])
        together = (torch.stack(each, -1 - len(self.shape)) for each in (tokens, labels))
        return TokenizedTracks(next(together), token_valid, torch.cat(tracks, -2), next(together))

    def alike(self, one: Tensor, other: Tensor) -> Tensor:
        """``[*]`` bool: tokens ``[*, ...]`` that mean the same motion."""
        return one == other

    def way_back(self, target: Tensor, recent: Tensor, start: Tensor, known: Tensor, recovery: float) -> Tensor:
        """Where a label leads from beside the log: back to it by a share of the offset.

        Args:
            target: ``[*, F, 3]`` what was logged.
            recent: ``[*, F + 1, 3]``.
            start: ``[*, 3]`` where the log was before.
            known: ``[*]`` bool, it was there; nothing is left of the offset where it was not.
            recovery: the share.
        """
        if recovery == 1:
            return target
        return beside(target, recent[..., -1, :], start, (1 - recovery) * known[..., None])

    def _noisy(self, token: Tensor, kind: Tensor, noise: float, drawn: Tensor) -> Tensor:
        replaced = self.of_numbers(drawn[..., 0] < noise)
        return torch.where(replaced, self.neighbour(token, kind, drawn[..., 1:]), token)

    def of_numbers(self, mask: Tensor) -> Tensor:
        """A mask of tokens ``[*]`` as one of their numbers, ``[*, ...]``."""
        return mask.view(*mask.shape, *(1 for _ in self.shape))

    def decode_tracks(self, tokens: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """Poses of a row of tokens.

        Args:
            tokens: ``[*, A, T, ...]``.
            recent: ``[*, A, F + 1, 3]``.
            kind: ``[*, A]``.

        Returns:
            ``[*, A, T * F, 3]`` in the frame of ``recent``.
        """
        tracks = []
        for token in tokens.unbind(-1 - len(self.shape)):
            recent = self.advance(token, recent, kind)
            tracks.append(recent[..., 1:, :])
        return torch.cat(tracks, -2)

    def on_cpu(self) -> Self:
        """A copy on the CPU, where logs are cut up and tokenized wherever the model is."""
        return copy.deepcopy(self).cpu()

    def advance(self, token: Tensor, recent: Tensor, kind: Tensor) -> Tensor:
        """``recent`` after one token: ``[*, F + 1, 3]``."""
        current = recent[..., -1:, :]
        return torch.cat((current, to_world(self.decode(token, recent, kind), current)), -2)


def check_vocabulary(tokenizer: MotionTokenizer, who: str) -> MotionTokenizer:
    """Refuse a tokenizer without a vocabulary.

    Args:
        tokenizer: to check.
        who: wants one, for the message.

    Raises:
        ValueError: it has none.
    """
    if not tokenizer.vocab_size:
        raise ValueError(f"{who} predicts tokens of a vocabulary, and patches have none; name another model.tokenizer.")
    return tokenizer
