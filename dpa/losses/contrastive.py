"""Contrastive preference loss over pairs of rollouts (METHOD eq. 4 and section 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictParams, dispatch
from torch import Tensor
from torch.nn import functional as F
from torchrl.objectives import LossModule

from dpa.losses.network import CONTEXT, LOGITS, scene_mean, token_log_prob
from envs import keys

Reduction = Literal["sum", "agent_mean", "token_mean"]
SATURATED = 0.01
"""A pair whose weight lies this close to 0 or 1 no longer weighs preferences."""


class ContrastivePreferenceLoss(LossModule):
    """Raises the likelihood of preferred rollouts over that of unpreferred ones of the same scene.

    With the score of a rollout ``A = alpha * reduce(log pi - log pi_ref)`` over its valid tokens, a pair costs
    ``softplus(lambda * A_unpreferred - A_preferred)`` (eq. 4; ``reference=False`` leaves ``log pi_ref`` out, as the
    paper does).

    The default starts with equal weights for all pairs, because both scores are 0. The plain sum without a reference
    starts with scores of hundreds of nats: nearly every pair then has weight 0 or 1, improbable winners dominate and
    the policy flattens (watch ``logit_std`` and ``saturated`` at the first step, and ``entropy`` later).

    Args:
        actor_network: from :func:`~dpa.losses.token_network`.

    Keyword Args:
        alpha: scale of a score (1 / temperature of the preference model).
        conservative: lambda in (0, 1], the factor on the unpreferred score (Hejna et al. 2024).
        reference: subtract the log-likelihood under a frozen copy of the network as it is now.
        score_reduction: ``"sum"`` over agents and decisions as in eq. 4, ``"agent_mean"`` sums over decisions and
            averages over agents, ``"token_mean"`` averages over both.
        cloning: weight of the negative log-likelihood per token of the preferred rollouts, averaged over scenes.

    Raises:
        ValueError: an option outside its range.

    Returns ``loss_preference``, ``loss_cloning`` and, detached: ``logit_mean``, ``logit_std``, ``weight_mean`` and
    ``saturated`` of the pairs, ``pair_accuracy`` (the preferred rollout is the more likely one), ``nll_preferred``,
    ``nll_unpreferred`` and ``entropy`` per token [nats] and, with a reference, ``kl`` to it per token [nats]. Every
    one is a mean over scenes, so a step is the same however its scenes are split into parts or among ranks.

    Examples:
        >>> from dpa.losses import token_network
        >>> from dpa.policy import MotionLM, collate_contexts, make_context
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> loss = ContrastivePreferenceLoss(token_network(MotionLM("nano", VerletTokenizer())))
        >>> batch = TensorDict(
        ...     {
        ...         "context": collate_contexts([make_context(straight_road(2))]),
        ...         "preferred": torch.full((1, 4, 2, 16), 84),
        ...         "unpreferred": torch.full((1, 4, 2, 16), 90),
        ...         "token_valid": torch.ones(1, 1, 2, 16, dtype=torch.bool),
        ...     },
        ...     batch_size=[1],
        ... )
        >>> round(loss(batch)["loss_preference"].item(), 4)  # equal scores: log 2
        0.6931
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the input.

        Attributes:
            context: :class:`~dpa.policy.SceneContext` of batch size ``[S]``.
            preferred: ``[S, M, A, T]`` int64.
            unpreferred: ``[S, M, A, T]`` int64, pair by pair.
            token_valid: ``[S, 1, A, T]`` bool, the same for both sides of a pair.
        """

        context: NestedKey = CONTEXT
        preferred: NestedKey = keys.PREFERRED
        unpreferred: NestedKey = keys.UNPREFERRED
        token_valid: NestedKey = keys.TOKEN_VALID

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    diagnostics = [
        "logit_mean",
        "logit_std",
        "weight_mean",
        "saturated",
        "pair_accuracy",
        "nll_preferred",
        "nll_unpreferred",
        "entropy",
    ]

    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        alpha: float = 0.1,
        conservative: float = 1.0,
        reference: bool = True,
        score_reduction: Reduction = "sum",
        cloning: float = 0.0,
    ) -> None:
        super().__init__()
        if alpha <= 0:
            raise ValueError(f"alpha must be positive, got {alpha}.")
        if not 0 < conservative <= 1:
            raise ValueError(f"conservative (lambda) must lie in (0, 1], got {conservative}.")
        if score_reduction not in ("sum", "agent_mean", "token_mean"):
            raise ValueError(f"score_reduction must be 'sum', 'agent_mean' or 'token_mean', got {score_reduction!r}.")
        if cloning < 0:
            raise ValueError(f"cloning must not be negative, got {cloning}.")
        self.convert_to_functional(actor_network, "actor_network", create_target_params=reference)
        # The reference stays as it is: tell torchrl, which warns otherwise, that no updater is missing.
        self._has_update_associated["actor_network"] = True
        self.alpha, self.conservative, self.reference = alpha, conservative, reference
        self.score_reduction, self.cloning = score_reduction, cloning

    @property
    def in_keys(self) -> list[NestedKey]:
        """Where the input lies, in the order in which plain tensors are taken."""
        accepted = self.tensor_keys
        return [accepted.context, accepted.preferred, accepted.unpreferred, accepted.token_valid]

    @property
    def out_keys(self) -> list[str]:
        """``loss_preference``, ``loss_cloning`` and the diagnostics."""
        return ["loss_preference", "loss_cloning", *self.diagnostics, *(["kl"] if self.reference else [])]

    def _forward_value_estimator_keys(self, **_: object) -> None:
        """There is no value estimator."""

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss and its diagnostics, each a scalar, of a batch of pairs."""
        accepted = self.tensor_keys
        tokens = torch.cat((tensordict[accepted.preferred], tensordict[accepted.unpreferred]), 1)
        valid = tensordict[accepted.token_valid]
        batch = TensorDict(
            {CONTEXT: tensordict[accepted.context], keys.TOKENS: tokens, keys.TOKEN_VALID: valid},
            batch_size=tokens.shape[:1],
        )
        with self.actor_network_params.to_module(self.actor_network):
            logits = self.actor_network(batch)[LOGITS]
        log_prob = token_log_prob(logits, tokens)
        gain, drift = log_prob, {}
        if self.reference:
            with torch.no_grad(), self.target_actor_network_params.to_module(self.actor_network):
                reference = self.actor_network(batch.select(CONTEXT, keys.TOKENS, keys.TOKEN_VALID))[LOGITS]
            gain = log_prob - token_log_prob(reference, tokens)
            drift = {"kl": scene_mean(_divergence(logits.detach(), reference), valid)}
        preferred, unpreferred = (self.alpha * self._reduce(gain, valid)).chunk(2, 1)
        logit = preferred - self.conservative * unpreferred
        nll, nll_unpreferred = (scene_mean(-side, valid) for side in log_prob.chunk(2, 1))
        out = {"loss_preference": F.softplus(-logit).mean(), "loss_cloning": self.cloning * nll}
        with torch.no_grad():
            likelier = torch.gt(*self._reduce(log_prob, valid).chunk(2, 1))
            out |= _pair_diagnostics(logit.detach())
            out |= {"pair_accuracy": likelier.to(logit.dtype).mean(), "nll_preferred": nll.detach()}
            out |= {"nll_unpreferred": nll_unpreferred.detach(), "entropy": scene_mean(_entropy(logits), valid)}
            out |= drift
        return TensorDict(out, batch_size=[])

    def _reduce(self, value: Tensor, valid: Tensor) -> Tensor:
        """``[S, M, A, T]`` to the score ``[S, M]`` of each rollout, without alpha."""
        valid = valid.expand_as(value)
        total = value.where(valid, value.new_zeros(())).sum((-1, -2))
        if self.score_reduction == "sum":
            return total
        count = valid.any(-1).sum(-1) if self.score_reduction == "agent_mean" else valid.sum((-1, -2))
        return total / count.clamp(min=1)


def _pair_diagnostics(logit: Tensor) -> dict[str, Tensor]:
    weight = torch.sigmoid(-logit)  # how strongly a pair pulls: the derivative of its loss
    saturated = (weight < SATURATED) | (weight > 1 - SATURATED)
    return {
        "logit_mean": logit.mean(),
        "logit_std": logit.std(correction=0),
        "weight_mean": weight.mean(),
        "saturated": saturated.to(logit.dtype).mean(),
    }


def _entropy(logits: Tensor) -> Tensor:
    log_probs = logits.log_softmax(-1)
    return -(log_probs.exp() * log_probs).sum(-1)


def _divergence(logits: Tensor, reference: Tensor) -> Tensor:
    """KL(pi || pi_ref) of each token's distribution [nats]."""
    log_probs = logits.log_softmax(-1)
    return (log_probs.exp() * (log_probs - reference.log_softmax(-1))).sum(-1)
