"""Imitation of rollouts as new labels (SFT-best; method.md section 6)."""

from __future__ import annotations

from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor

from dpa.losses.network import distribution_of, masked_mean, reference_logits
from dpa.losses.next_token import NextTokenLoss
from envs import keys


class ImitationLoss(NextTokenLoss):
    """Next-token loss (eq. 1) of a trained policy's best rollouts, and how far the policy has gone from there.

    What is minimised is :class:`~dpa.losses.NextTokenLoss`. A step takes one more pass, without gradients: of a frozen
    copy of the network as it is when the loss is made.

    Args:
        actor_network: from :func:`~dpa.losses.token_network`.

    Keyword Args:
        label_smoothing: share of the target spread over all tokens.

    Returns, besides what :class:`~dpa.losses.NextTokenLoss` does, ``kl``: of the policy from the copy, per valid token,
    over the vocabulary, as the loss a mean over tokens [nats], detached.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from dpa.losses import token_network
        >>> from dpa.models import collate_contexts, make_context
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer()).eval()
        >>> loss = ImitationLoss(token_network(model))
        >>> batch = TensorDict(
        ...     {
        ...         "context": collate_contexts([make_context(straight_road(2), model.featurize)]),
        ...         "tokens": torch.full((1, 1, 2, 16), 84),
        ...         "token_valid": torch.ones(1, 1, 2, 16, dtype=torch.bool),
        ...     },
        ...     batch_size=[1],
        ... )
        >>> loss(batch)["kl"].item()  # before the first step
        0.0
    """

    keeps_reference = True
    out_keys = ["loss_next_token", "accuracy", "entropy", "kl"]

    def __init__(self, actor_network: TensorDictModule, *, label_smoothing: float = 0.0) -> None:
        # An auxiliary loss is pre-training's alone.
        super().__init__(actor_network, label_smoothing=label_smoothing)

    def _diagnostics(self, batch: TensorDict, logits: Tensor) -> dict[str, Tensor]:
        drift = distribution_of(self.actor_network).divergence(logits, reference_logits(self, batch))
        return {"kl": masked_mean(drift, batch[keys.TOKEN_VALID])}
