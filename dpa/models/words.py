"""Tokens of a vocabulary at both ends of a policy: what is made of the last one, and the logits of the next.

Where a token means another motion for each class of agent (:attr:`~dpa.tokens.base.MotionTokenizer.meanings`), each
class has rows of its own.
"""

from __future__ import annotations

from torch import Tensor, nn

from dpa.tokens.base import MotionTokenizer


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
        self.meanings, self.words = tokenizer.meanings, tokenizer.vocab_size + 1
        super().__init__(self.meanings * self.words, width)

    def forward(self, token: Tensor, kind: Tensor) -> Tensor:
        """``[*, width]`` of tokens ``[*]`` of agents of a class ``[*]``."""
        return super().forward(token if self.meanings == 1 else kind * self.words + token)


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
        self.meanings = tokenizer.meanings
        super().__init__(width, self.meanings * tokenizer.vocab_size)

    def forward(self, x: Tensor, kind: Tensor) -> Tensor:
        """``[*, V]`` of nodes ``[*, width]`` of agents of a class ``[*]``."""
        logits = super().forward(x)
        if self.meanings == 1:
            return logits
        logits = logits.unflatten(-1, (self.meanings, -1))
        own = kind[..., None, None].expand(*kind.shape, 1, logits.shape[-1])
        return logits.gather(-2, own).squeeze(-2)
