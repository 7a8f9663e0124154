"""What every preference loss shares: two sides of rollouts, their scores, and what is logged of a step."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal, NamedTuple, get_args

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
    network_input,
    reference_logits,
    scene_mean,
)
from envs import keys

Reduction = Literal["sum", "agent_mean", "token_mean"]
Sides = Literal["pairs", "sets", "ranking"]
"""How preferred and unpreferred rollouts belong together: pair by pair, not at all, or as one ranking."""
SATURATED = 0.01
"""A pair whose probability (the sigmoid of its logit) lies this close to 0 or 1 no longer weighs preferences."""


@dataclass(frozen=True)
class Side:
    """One side's rollouts as a loss sees them.

    Attributes:
        gain: ``[S, M, A, T]`` log-likelihood of each token, minus that under the reference where there is one [nats].
        drift: ``[S, M, A, T]`` KL divergence from the reference at each token, detached [nats].
        valid: ``[S, 1, A, T]`` bool.
        alpha: scale of the scores.
        reduction: of tokens to scores.
    """

    gain: Tensor
    drift: Tensor
    valid: Tensor
    alpha: float
    reduction: Reduction

    @property
    def score(self) -> Tensor:
        """``[S, M]``: alpha times the reduced gain of each rollout."""
        return self.alpha * reduce_tokens(self.gain, self.valid, self.reduction)

    @property
    def agent_score(self) -> Tensor:
        """``[S, M, A]``: the same of each agent's own tokens."""
        return self.alpha * reduce_tokens(self.gain, self.valid, self.reduction, each="agent")

    @property
    def divergence(self) -> Tensor:
        """``[S, M]``: alpha times the drift, reduced like the score."""
        return self.alpha * reduce_tokens(self.drift, self.valid, self.reduction)


class Comparison(NamedTuple):
    """What a loss makes of the scores of both sides.

    Attributes:
        cost: ``[S, P]`` of the P things that a scene compares (pairs, rollouts, choices); each scene has as many.
        logit: ``[S, P, ...]`` that the costs are functions of: large where the policy prefers what it should.
        weight: like ``logit``: how strongly each pulls, the negative derivative of its cost.
        counts: bool like ``logit``: those that take part; None for all.
    """

    cost: Tensor
    logit: Tensor
    weight: Tensor
    counts: Tensor | None = None


class PreferenceLoss(LossModule):
    """Teacher-forced scores of preferred and unpreferred rollouts of scenes; a subclass says what they cost.

    The score of a rollout is ``A = alpha * reduce(log pi - log pi_ref)`` over its valid tokens (method.md section 5). A
    subclass writes :meth:`compare` and, where rollouts are not compared pair by pair, :attr:`sides`.

    A step takes a pass of the policy and one, without gradients, of the reference: a frozen copy of the network as it
    is when the loss is made. The copy is kept without ``reference`` too, for ``kl``.

    Args:
        actor_network: from :func:`~dpa.losses.token_network`.

    Keyword Args:
        alpha: scale of a score (1 / temperature of the preference model).
        reference: subtract the log-likelihood under the reference.
        score_reduction: ``"sum"`` over agents and decisions as in eq. 4, ``"agent_mean"`` sums over decisions and
            averages over agents, ``"token_mean"`` averages over both.
        cloning: weight of the negative log-likelihood per token of the preferred rollouts, averaged over scenes.

    Raises:
        ValueError: an option outside its range.

    Returns ``loss_preference``, ``loss_cloning`` and, detached:

    ===================== ============================================================================================
    ``logit_mean``        mean of the logits of what is compared (:class:`Comparison`), ``logit_std`` their spread
    ``weight_mean``       mean of how strongly what is compared pulls, ``weight_std`` its spread
    ``saturated``         share of logits whose sigmoid is within :data:`SATURATED` of 0 or 1
    ``pair_accuracy``     share of pairs whose preferred rollout is the more likely one; NaN of densities
    ``nll_preferred``     negative log-likelihood per token [nats]; ``nll_unpreferred`` likewise
    ``entropy``           of the policy, per token [nats]
    ``kl``                of the policy from the reference, per token, whatever was drawn [nats]
    ===================== ============================================================================================

    Every one is a mean over scenes, so a step is the same however its scenes are split into parts or among ranks.

    Examples:
        >>> from dpa.losses import token_network
        >>> from dpa.models import collate_contexts, make_context
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> class Difference(PreferenceLoss):
        ...     '''The difference of scores itself: every pair pulls alike.'''
        ...     def compare(self, preferred, unpreferred, tensordict):
        ...         logit = preferred.score - unpreferred.score
        ...         return Comparison(-logit, logit, torch.ones_like(logit))
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> loss = Difference(token_network(model))
        >>> batch = TensorDict(
        ...     {
        ...         "context": collate_contexts([make_context(straight_road(2), model.featurize)]),
        ...         "preferred": torch.full((1, 4, 2, 16), 84),
        ...         "unpreferred": torch.full((1, 4, 2, 16), 90),
        ...         "token_valid": torch.ones(1, 1, 2, 16, dtype=torch.bool),
        ...     },
        ...     batch_size=[1],
        ... )
        >>> out = loss(batch)
        >>> out["weight_mean"].item(), out["saturated"].item()
        (1.0, 0.0)
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of the input.

        Attributes:
            context: :class:`~dpa.models.context.Context` of batch size ``[S]``.
            preferred: ``[S, M, A, T, ...]``.
            unpreferred: ``[S, N, A, T, ...]``.
            token_valid: ``[S, 1, A, T]`` bool, the same for both sides.
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
    sides: ClassVar[Sides] = "pairs"
    """What a subclass compares; ``pair_accuracy`` takes all pairs of both sides unless they come pair by pair."""
    out_keys = [
        "loss_preference",
        "loss_cloning",
        "logit_mean",
        "logit_std",
        "weight_mean",
        "weight_std",
        "saturated",
        "pair_accuracy",
        "nll_preferred",
        "nll_unpreferred",
        "entropy",
        "kl",
    ]

    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        alpha: float = 0.1,
        reference: bool = True,
        score_reduction: Reduction = "sum",
        cloning: float = 0.0,
    ) -> None:
        super().__init__()
        check_positive("alpha", alpha)
        check_choice("score_reduction", score_reduction, get_args(Reduction))
        check_not_negative("cloning", cloning)
        if not reference and not distribution_of(actor_network).discrete:
            raise ValueError(
                "reference=false compares how likely rollouts are, and of densities that is mostly how many agents "
                "move; say reference=true."
            )
        hold_network(self, actor_network, keep_reference=True)
        self.alpha, self.reference = alpha, reference
        self.score_reduction, self.cloning = score_reduction, cloning

    @abstractmethod
    def compare(self, preferred: Side, unpreferred: Side, tensordict: TensorDictBase) -> Comparison:
        """What the scores cost.

        Args:
            preferred: scores ``[S, M]``.
            unpreferred: scores ``[S, N]``.
            tensordict: the whole batch, for a loss that reads more of it.
        """

    @property
    def in_keys(self) -> list[NestedKey]:
        """Where the input lies, in the order in which plain tensors are taken."""
        accepted = self.tensor_keys
        return [accepted.context, accepted.preferred, accepted.unpreferred, accepted.token_valid]

    def _forward_value_estimator_keys(self, **_: object) -> None:
        """There is no value estimator."""

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss and its diagnostics, each a scalar, of a batch of scenes."""
        accepted = self.tensor_keys
        rollouts = tensordict[accepted.preferred], tensordict[accepted.unpreferred]
        tokens, sizes = torch.cat(rollouts, 1), [side.shape[1] for side in rollouts]
        valid = tensordict[accepted.token_valid]
        batch = network_input(tensordict[accepted.context], tokens, valid)
        logits = logits_under(self.actor_network_params, self.actor_network, batch)
        reference, says = reference_logits(self, batch), distribution_of(self.actor_network)
        with torch.no_grad():
            drift = says.divergence(logits, reference)
        log_prob = says.log_prob(logits, tokens)
        gain = log_prob - says.log_prob(reference, tokens) if self.reference else log_prob

        sides = zip(gain.split(sizes, 1), drift.split(sizes, 1), strict=True)
        compared = self.compare(*(Side(*side, valid, self.alpha, self.score_reduction) for side in sides), tensordict)
        likelihoods = log_prob.split(sizes, 1)
        nll, nll_unpreferred = (scene_mean(-side, valid) for side in likelihoods)
        out = {"loss_preference": compared.cost.mean(), "loss_cloning": self.cloning * nll}
        with torch.no_grad():
            out |= _weighing(compared)
            out |= {"pair_accuracy": self._pair_accuracy(*likelihoods, valid), "nll_preferred": nll.detach()}
            out |= {"nll_unpreferred": nll_unpreferred.detach(), "entropy": scene_mean(says.entropy(logits), valid)}
            out |= {"kl": scene_mean(drift, valid)}
        return TensorDict(out, batch_size=[])

    def _pair_accuracy(self, preferred: Tensor, unpreferred: Tensor, valid: Tensor) -> Tensor:
        one, other = (reduce_tokens(side, valid, "sum") for side in (preferred, unpreferred))
        likelier = one > other if self.sides == "pairs" else one[:, :, None] > other[:, None]
        share = likelier.to(one.dtype).mean()
        return share if distribution_of(self.actor_network).discrete else torch.full_like(share, torch.nan)


def reduce_tokens(
    value: Tensor, valid: Tensor, reduction: Reduction, each: Literal["rollout", "agent"] = "rollout"
) -> Tensor:
    """One number for each rollout, or for each agent of it, from one for each token.

    Args:
        value: ``[S, M, A, T]``.
        valid: bool, broadcast to it; only these tokens count.
        reduction: see :class:`PreferenceLoss`; means are over the agents and the tokens that count.
        each: what gets a number. An agent's own mean over agents is its sum.

    Returns:
        ``[S, M]``, or ``[S, M, A]`` for agents; 0 where no token counts.

    Examples:
        >>> value = torch.tensor([[[[1.0, 2.0], [3.0, 9.0]]]])
        >>> valid = torch.tensor([[[[True, True], [True, False]]]])
        >>> [reduce_tokens(value, valid, reduction).item() for reduction in ("sum", "agent_mean", "token_mean")]
        [6.0, 3.0, 2.0]
        >>> reduce_tokens(value, valid, "token_mean", each="agent")
        tensor([[[1.5000, 3.0000]]])
    """
    within = (-1,) if each == "agent" else (-1, -2)
    valid = valid.expand_as(value)
    total = value.where(valid, value.new_zeros(())).sum(within)
    if reduction == "token_mean":
        return total / valid.sum(within).clamp(min=1)
    if reduction == "agent_mean" and each == "rollout":
        return total / valid.any(-1).sum(-1).clamp(min=1)
    return total


def _weighing(compared: Comparison) -> dict[str, Tensor]:
    """Diagnostics of the logits."""
    logit, counts = compared.logit, compared.counts
    counts = torch.ones_like(logit, dtype=torch.bool) if counts is None else counts
    sure = logit.sigmoid()
    saturated = (sure < SATURATED) | (sure > 1 - SATURATED)
    logits, weights = _mean_std(logit, counts), _mean_std(compared.weight, counts)
    return {
        "logit_mean": logits[0],
        "logit_std": logits[1],
        "weight_mean": weights[0],
        "weight_std": weights[1],
        "saturated": scene_mean(saturated.to(logit.dtype), counts),
    }


def _mean_std(value: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Spread around the mean over scenes; in float64, because it is the difference of two large numbers."""
    exact = value.double()
    mean, square = scene_mean(exact, counts), scene_mean(exact**2, counts)
    return mean.to(value.dtype), (square - mean**2).clamp(min=0).sqrt().to(value.dtype)


def check_positive(name: str, value: float) -> None:
    """Refuse an option that is not positive."""
    if not value > 0:
        raise ValueError(f"{name} must be positive, got {value}.")


def check_not_negative(name: str, value: float) -> None:
    """Refuse an option below 0."""
    if not value >= 0:
        raise ValueError(f"{name} must not be negative, got {value}.")


def check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Refuse an option that is none of its choices."""
    if value not in choices:
        named = ", ".join(repr(choice) for choice in choices[:-1]) + f" or {choices[-1]!r}"
        raise ValueError(f"{name} must be {named}, got {value!r}.")
