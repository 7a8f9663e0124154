"""The contract of a policy family: all that actor, losses, collectors and recipes ask of a policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor, nn

from dpa.models.context import Context, Featurize
from dpa.models.distribution import TOKENS, Distribution
from dpa.tokens.base import MotionTokenizer


class Observation(NamedTuple):
    """What B rollouts of A agents show of themselves at a decision; rows may stand at different ones.

    Attributes:
        recent: ``[B, A, F + 1, 3]`` poses of the last decision.
        token: ``[B, A, ...]`` token of it; V where there is none.
        step: ``[B]`` index of the decision.
        latest: the largest of these, known without asking the device.
        kind: ``[B, A]`` :class:`~envs.scene.AgentKind`.
        valid: ``[B, A]`` bool, the agent is there.
    """

    recent: Tensor
    token: Tensor
    step: Tensor
    latest: int
    kind: Tensor
    valid: Tensor


class Choose(Protocol):
    """Chooses tokens where a policy says how likely each is; whoever drives a policy gives it."""

    def __call__(self, logits: Tensor, agents: Tensor | None = None) -> Tensor:
        """``[B, n, ...]`` tokens of some agents.

        Args:
            logits: ``[B, n, P]``.
            agents: ``[B, n]`` which agents; all of them by default.
        """


def of_agents(value: Tensor, agents: Tensor | None) -> Tensor:
    """``[B, A, ...]`` of some agents ``[B, n]``, or of all.

    Args:
        value: of B rows.
        agents: which, of each row.

    Examples:
        >>> import torch
        >>> of_agents(torch.tensor([[10, 11, 12]]), torch.tensor([[2]]))
        tensor([[12]])
    """
    if agents is None:
        return value
    index = agents.view(*agents.shape, *(1,) * (value.dim() - 2)).expand(*agents.shape, *value.shape[2:])
    return value.gather(1, index)


class Decision(NamedTuple):
    """What was chosen at a decision.

    Attributes:
        token: ``[B, A, ...]``.
        logits: ``[B, A, P]`` of the distributions that the tokens were chosen from.
    """

    token: Tensor
    logits: Tensor


class Memory(Protocol):
    """Running rollouts of some scenes: what a policy keeps of them between two decisions."""

    def begin(self, context: Context, rollouts: int, anew: bool) -> None:
        """Rollouts begin, of these scenes from now on.

        Args:
            context: of batch size ``[S]``.
            rollouts: K, contiguous rows of each scene.
            anew: all rollouts do; otherwise some go on where they are, of scenes that are what they were.
        """

    def step(self, seen: Observation, choose: Choose) -> Decision:
        """Take the decision at hand: all agents at once, or one after another, who then know what those before chose.

        The logits are those of teacher forcing up to rounding (1e-5).
        """


class Auxiliary(nn.Module, ABC):
    """A loss of a family beside the one of its tokens, with weights of its own that only pre-training needs."""

    @abstractmethod
    def forward(self, model: nn.Module, context: Context) -> Tensor:
        """A scalar.

        Args:
            model: of the family.
            context: of batch size ``[S]``.
        """


class MotionModel(nn.Module, ABC):
    """The distribution of what all agents of a scene do, decision after decision.

    A subclass is a family: one folder, and one line in :data:`~dpa.models.registry.FAMILIES`.

    Attributes:
        tokenizer: what an action is.
        config: size of the model, a dataclass with ``horizon``.
        distribution: what the logits mean.
        compiles: its memory can run what decodes through :func:`torch.compile`.
    """

    tokenizer: MotionTokenizer
    config: Any
    distribution: Distribution = TOKENS
    compiles: ClassVar[bool] = False

    @property
    def no_token(self) -> int:
        """Stands for the last token, or each of its numbers, of an agent that has none: V."""
        return self.tokenizer.vocab_size

    def no_tokens(self, shape: tuple[int, ...], device: torch.device) -> Tensor:
        """Tokens of agents ``shape`` that have none: ``[*, ...]``."""
        tokenizer = self.tokenizer
        return torch.full((*shape, *tokenizer.shape), self.no_token, dtype=tokenizer.dtype, device=device)

    @property
    @abstractmethod
    def featurize(self) -> Featurize:
        """Makes what the policy sees of a scene, with padding and cropping of its own; it holds no weights."""

    @abstractmethod
    def forward(self, context: Context, tokens: Tensor, token_valid: Tensor) -> Tensor:
        """Teacher-forced logits of every token of M rollouts of each scene.

        Args:
            context: of batch size ``[S]``.
            tokens: ``[S, M, A, T, ...]``.
            token_valid: ``[S, M or 1, A, T]`` bool; a controlled agent is seen by others while its tokens are valid.

        Returns:
            ``[S, M, A, T, P]`` logits, P = V of tokens; those of agents that are not controlled mean nothing.
        """

    @abstractmethod
    def remember(self, *, compile: bool = False) -> Memory:
        """A memory of running rollouts.

        Args:
            compile: run what decodes through :func:`torch.compile`; asked of a family that :attr:`compiles` alone.
        """

    def auxiliary(self) -> Auxiliary | None:
        """What pre-training may minimise as well (``pretraining.auxiliary``); none by default."""
        return None

    @abstractmethod
    def bytes_per_row(self) -> int:
        """Memory of one agent of one rollout while it runs: what is kept of it, and what a decision computes."""


class ContractError(ValueError):
    """A policy gives something else than :class:`MotionModel` says; the message names the method."""


def check_logits(logits: Any, tokens: Tensor, who: str, vocab_size: int | None = None) -> None:
    """Refuse logits that are not of these tokens.

    Args:
        logits: what ``who`` gave.
        tokens: ``[S, M, A, T, ...]``.
        who: gives them, for the message.
        vocab_size: V, where they are of a vocabulary that is known.

    Raises:
        ContractError: no tensor, or one of another shape than ``[S, M, A, T, P]``.

    Examples:
        >>> import torch
        >>> check_logits(torch.zeros(1, 2, 5, 3, 9), torch.zeros(1, 2, 3, 5), "Own.forward")
        Traceback (most recent call last):
        ...
        dpa.models.base.ContractError: Own.forward must give logits [1, 2, 3, 5, 'P'], got [1, 2, 5, 3, 9].
    """
    wanted = [*tokens.shape[:4], vocab_size or "P"]
    got = list(logits.shape) if isinstance(logits, Tensor) else type(logits).__name__
    if not isinstance(logits, Tensor) or got[:4] != wanted[:4] or len(got) != 5 or vocab_size not in (None, got[4]):
        raise ContractError(f"{who} must give logits {wanted}, got {got}.")


def named_size(config: Any, sizes: Mapping[str, Any]) -> Any:
    """The configuration itself, or the one of its name.

    Raises:
        ValueError: a name that is no size.
    """
    if not isinstance(config, str):
        return config
    if config not in sizes:
        raise ValueError(f"size must be one of {sorted(sizes)}, got {config!r}.")
    return sizes[config]
