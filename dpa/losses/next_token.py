"""Next-token prediction (eq. 1 of the paper)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams, dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from dpa.losses.network import (
    CONTEXT,
    distribution_of,
    hold_network,
    logits_under,
    masked_mean,
    model_of,
    network_input,
)
from dpa.models.base import Auxiliary
from envs import keys


class NextTokenLoss(LossModule):
    """Negative log-likelihood of tokens, per valid token [nats] (eq. 1).

    Pre-training reads the tokens of logs; SFT-best those of the best rollouts as new labels
    (:class:`~dpa.losses.ImitationLoss`).

    Args:
        actor_network: from :func:`~dpa.losses.token_network`.

    Keyword Args:
        label_smoothing: share of the target spread over all tokens.
        auxiliary: of the policy's family (:meth:`~dpa.models.MotionModel.auxiliary`); its weights are the loss's.
        auxiliary_weight: of it.

    Returns ``loss_next_token``, with an auxiliary loss ``loss_auxiliary``, which is that times its weight, and,
    detached, ``accuracy`` (share of tokens that are the most probable ones) and ``entropy`` [nats].

    Examples:
        >>> from dpa.losses import token_network
        >>> from dpa.models import collate_contexts, make_context
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> loss = NextTokenLoss(token_network(model))
        >>> batch = TensorDict(
        ...     {
        ...         "context": collate_contexts([make_context(straight_road(2), model.featurize)]),
        ...         "tokens": torch.full((1, 1, 2, 16), 84),
        ...         "token_valid": torch.ones(1, 1, 2, 16, dtype=torch.bool),
        ...     },
        ...     batch_size=[1],
        ... )
        >>> loss(batch)["loss_next_token"].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the input.

        Attributes:
            context: :class:`~dpa.models.context.Context` of batch size ``[S]``.
            tokens: ``[S, M, A, T, ...]``, what the network reads.
            labels: ``[S, M, A, T, ...]``, what it is to predict; the tokens themselves by default.
            token_valid: ``[S, M or 1, A, T]`` bool; an agent is seen by others while its tokens are valid.
            learnt: ``[S, M or 1, A, T]`` bool, labels that count; by default those of valid tokens.
        """

        context: NestedKey = CONTEXT
        tokens: NestedKey = keys.TOKENS
        labels: NestedKey | None = None
        token_valid: NestedKey = keys.TOKEN_VALID
        learnt: NestedKey | None = None

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    sides = "targets"
    """It imitates one side; see :attr:`~dpa.losses.PreferenceLoss.sides`."""
    out_keys = ["loss_next_token", "accuracy", "entropy"]
    keeps_reference: ClassVar[bool] = False
    """Whether a frozen copy of the network, as it is when the loss is made, is kept."""

    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        label_smoothing: float = 0.0,
        auxiliary: Auxiliary | None = None,
        auxiliary_weight: float = 1.0,
    ) -> None:
        super().__init__()
        if not 0 <= label_smoothing < 1:
            raise ValueError(f"label_smoothing must lie in [0, 1), got {label_smoothing}.")
        distribution_of(actor_network).check_smoothing(label_smoothing)
        hold_network(self, actor_network, keep_reference=self.keeps_reference)
        self.label_smoothing = label_smoothing
        self.auxiliary, self.auxiliary_weight = auxiliary, auxiliary_weight
        if auxiliary is not None:
            self.out_keys = [*self.out_keys, "loss_auxiliary"]

    @property
    def in_keys(self) -> list[NestedKey]:
        """Where the input lies, in the order in which plain tensors are taken."""
        accepted, (labels, learnt) = self.tensor_keys, self._imitated
        read = (accepted.context, accepted.tokens, labels, accepted.token_valid, learnt)
        return list(dict.fromkeys(read))

    @property
    def _imitated(self) -> tuple[NestedKey, NestedKey]:
        """Keys of the labels, and of which of them count."""
        accepted = self.tensor_keys
        return accepted.labels or accepted.tokens, accepted.learnt or accepted.token_valid

    def _forward_value_estimator_keys(self, **_: object) -> None:
        """There is no value estimator."""

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss and its diagnostics, each a scalar, of a batch of rollouts."""
        accepted = self.tensor_keys
        tokens, valid = tensordict[accepted.tokens], tensordict[accepted.token_valid]
        batch = network_input(tensordict[accepted.context], tokens, valid)
        logits = logits_under(self.actor_network_params, self.actor_network, batch)
        labels, learnt = (tensordict[key] for key in self._imitated)
        says = distribution_of(self.actor_network)
        loss = masked_mean(says.surprise(logits, labels, self.label_smoothing), learnt)
        with torch.no_grad():
            hit = says.hit(logits, labels).to(logits.dtype)
            entropy = masked_mean(says.entropy(logits), learnt)
            diagnostics = {"accuracy": masked_mean(hit, learnt), "entropy": entropy}
            diagnostics |= self._diagnostics(batch, logits)
        losses = {"loss_next_token": loss}
        if self.auxiliary is not None:
            losses["loss_auxiliary"] = self.auxiliary_weight * self._auxiliary(batch)
        return TensorDict(losses | diagnostics, batch_size=[])

    def _auxiliary(self, batch: TensorDict) -> Tensor:
        with self.actor_network_params.to_module(self.actor_network):
            return self.auxiliary(model_of(self.actor_network), batch[CONTEXT])

    def _diagnostics(self, batch: TensorDict, logits: Tensor) -> dict[str, Tensor]:
        """What a subclass logs as well."""
        return {}
