"""What the numbers that a policy gives of a decision say of its tokens: probabilities, or a density."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor
from torch.nn.functional import cross_entropy

from dpa.models.sampling import Decoding, draw


class Distribution(ABC):
    """Of tokens ``[*, ...]`` whose distributions have P numbers each, ``logits`` ``[*, P]``; it holds no weights.

    Attributes:
        discrete: tokens have probabilities, and otherwise densities, per metre and radian.
        numbers: in [0, 1), that decide a draw.
    """

    discrete: bool
    numbers: int = 1

    @abstractmethod
    def log_prob(self, logits: Tensor, token: Tensor) -> Tensor:
        """Log-probability or log-density of each token, ``[*]`` [nats]."""

    @abstractmethod
    def entropy(self, logits: Tensor) -> Tensor:
        """``[*]`` [nats]."""

    @abstractmethod
    def divergence(self, logits: Tensor, reference: Tensor) -> Tensor:
        """KL from the distributions of ``reference``, ``[*]`` [nats]."""

    @abstractmethod
    def likeliest(self, logits: Tensor) -> Tensor:
        """The most probable tokens."""

    @abstractmethod
    def hit(self, logits: Tensor, token: Tensor) -> Tensor:
        """``[*]`` bool: the most probable token is this one, or near it where there are densities."""

    @abstractmethod
    def draw(self, logits: Tensor, uniform: Tensor, decoding: Decoding) -> tuple[Tensor, Tensor]:
        """Tokens ``[*, ...]`` and by which log-probabilities they were drawn ``[*]``.

        Args:
            logits: ``[*, P]``.
            uniform: ``[*, numbers]`` in [0, 1).
            decoding: changes the distribution that is drawn from.
        """

    def check_smoothing(self, label_smoothing: float) -> None:
        """Refuse to smooth labels where there is no vocabulary.

        Raises:
            ValueError: they are to be.
        """
        if label_smoothing and not self.discrete:
            raise ValueError(
                f"label_smoothing={label_smoothing} needs a vocabulary to smooth over, and patches have none; set 0."
            )

    def surprise(self, logits: Tensor, token: Tensor, label_smoothing: float = 0.0) -> Tensor:
        """``[*]``: what the next-token loss is the mean of, minus the log-probability [nats].

        Raises:
            ValueError: see :meth:`check_smoothing`.
        """
        self.check_smoothing(label_smoothing)
        return -self.log_prob(logits, token)


class TokenDistribution(Distribution):
    """Over the vocabulary of a tokenizer: P is V.

    Examples:
        >>> import torch
        >>> logits = torch.tensor([[0.5, 0.25, 0.25]]).log()
        >>> tokens = TokenDistribution()
        >>> round(tokens.log_prob(logits, torch.tensor([1])).exp().item(), 4)
        0.25
    """

    discrete = True

    def log_prob(self, logits: Tensor, token: Tensor) -> Tensor:
        """See :meth:`Distribution.log_prob`."""
        return logits.log_softmax(-1).gather(-1, token[..., None])[..., 0]

    def entropy(self, logits: Tensor) -> Tensor:
        """See :meth:`Distribution.entropy`."""
        log_probs = logits.log_softmax(-1)
        return -(log_probs.exp() * log_probs).sum(-1)

    def divergence(self, logits: Tensor, reference: Tensor) -> Tensor:
        """See :meth:`Distribution.divergence`; exact, over the whole vocabulary."""
        log_probs = logits.log_softmax(-1)
        return (log_probs.exp() * (log_probs - reference.log_softmax(-1))).sum(-1)

    def likeliest(self, logits: Tensor) -> Tensor:
        """See :meth:`Distribution.likeliest`."""
        return logits.argmax(-1)

    def hit(self, logits: Tensor, token: Tensor) -> Tensor:
        """See :meth:`Distribution.hit`."""
        return logits.argmax(-1) == token

    def draw(self, logits: Tensor, uniform: Tensor, decoding: Decoding) -> tuple[Tensor, Tensor]:
        """See :meth:`Distribution.draw`."""
        log_probs = decoding.log_probs(logits)
        token = draw(log_probs, uniform[..., 0])
        return token, log_probs.gather(-1, token[..., None])[..., 0]

    def surprise(self, logits: Tensor, token: Tensor, label_smoothing: float = 0.0) -> Tensor:
        """See :meth:`Distribution.surprise`; the share ``label_smoothing`` of the label is spread over all tokens."""
        flat = logits.flatten(0, -2), token.flatten()
        return cross_entropy(*flat, reduction="none", label_smoothing=label_smoothing).view_as(token)


TOKENS = TokenDistribution()
"""That of every module that gives logits of tokens."""
