"""Tokens of a vocabulary at both ends of a policy: what is made of the last one, and the logits of the next.

Where a token means another motion for each class of agent (:attr:`~dpa.tokens.base.MotionTokenizer.by_class`), each
class has rows of its own.
"""

from __future__ import annotations

from torch import Tensor, nn

from dpa.tokens.base import MotionTokenizer
from envs.scene import AgentKind

CLASSES = (AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST)
"""Classes with rows of their own; all others have those of vehicles, whose motions they have as well."""


def class_of(kind: Tensor) -> Tensor:
    """Index into :data:`CLASSES`.

    Examples:
        >>> import torch
        >>> class_of(torch.tensor([0, 1, 2, 3, 4])).tolist()
        [0, 0, 1, 2, 0]
    """
    return sum((kind == each) * index for index, each in enumerate(CLASSES))


class TokenEmbedding(nn.Embedding):
    """Embeds tokens of agents; V stands for no token.

    Args:
        tokenizer: what a token means.
        width: channels.

    Examples:
        >>> import torch
        >>> from dpa.tokens import VerletTokenizer
        >>> TokenEmbedding(VerletTokenizer(), 8)(torch.tensor([[84, 169]]), torch.tensor([[1, 2]])).shape
        torch.Size([1, 2, 8])
    """

    def __init__(self, tokenizer: MotionTokenizer, width: int) -> None:
        self.by_class, self.words = tokenizer.by_class, tokenizer.vocab_size + 1
        super().__init__(self.words * (len(CLASSES) if self.by_class else 1), width)

    def forward(self, token: Tensor, kind: Tensor) -> Tensor:
        """``[*, width]`` of tokens ``[*]`` of agents of a class ``[*]``."""
        return super().forward(class_of(kind) * self.words + token if self.by_class else token)


class TokenHead(nn.Linear):
    """Logits of the next token.

    Args:
        width: channels.
        tokenizer: what a token means.

    Examples:
        >>> import torch
        >>> from dpa.tokens import VerletTokenizer
        >>> TokenHead(8, VerletTokenizer())(torch.zeros(1, 2, 8), torch.tensor([[1, 2]])).shape
        torch.Size([1, 2, 169])
    """

    def __init__(self, width: int, tokenizer: MotionTokenizer) -> None:
        self.by_class = tokenizer.by_class
        super().__init__(width, tokenizer.vocab_size * (len(CLASSES) if self.by_class else 1))

    def forward(self, x: Tensor, kind: Tensor) -> Tensor:
        """``[*, V]`` of nodes ``[*, width]`` of agents of a class ``[*]``."""
        logits = super().forward(x)
        if not self.by_class:
            return logits
        logits = logits.unflatten(-1, (len(CLASSES), -1))
        own = class_of(kind)[..., None, None].expand(*kind.shape, 1, logits.shape[-1])
        return logits.gather(-2, own).squeeze(-2)
