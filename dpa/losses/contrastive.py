"""Contrastive preference losses over pairs of rollouts: CPL (eq. 4 of the paper), DPO, IPO, SimPO, and by agent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torch.nn import functional as F

from dpa.losses.preference import (
    Comparison,
    PreferenceLoss,
    Reduction,
    Side,
    check_choice,
    check_not_negative,
)
from envs import keys

Link = Literal["logistic", "squared", "hinge"]
Credit = Literal["scene", "agent"]


class Curve(NamedTuple):
    """The cost of a logit, and how strongly it pulls: minus the derivative."""

    cost: Callable[[Tensor], Tensor]
    weight: Callable[[Tensor], Tensor]


LINKS: dict[str, Curve] = {
    "logistic": Curve(lambda logit: F.softplus(-logit), lambda logit: torch.sigmoid(-logit)),
    "squared": Curve(lambda logit: (logit - 0.5) ** 2, lambda logit: 1 - 2 * logit),
    "hinge": Curve(lambda logit: (1 - logit).relu(), lambda logit: (logit < 1).to(logit.dtype)),
}


class ContrastivePreferenceLoss(PreferenceLoss):
    """Raises the likelihood of preferred rollouts over that of unpreferred ones of the same scene, pair by pair.

    With the scores ``A`` of :class:`~dpa.losses.PreferenceLoss`, the logit of a pair is
    ``h = A_preferred - lambda * A_unpreferred - margin``, and a pair costs ``(1 - e) link(h) + e link(-h)``:

    ========= ================ ==========================================================================
    link      cost             with
    ========= ================ ==========================================================================
    logistic  softplus(-h)     CPL without a reference (eq. 4; Hejna et al. 2024), DPO with one (Rafailov
                               et al. 2023), SimPO with token means and a margin (Meng et al. 2024)
    squared   (h - 1/2)^2      IPO (Azar et al. 2024): alpha^2 times its ``(h / alpha - 1 / (2 alpha))^2``
    hinge     max(0, 1 - h)    SLiC without a reference (Zhao et al. 2023)
    ========= ================ ==========================================================================

    The default starts with equal weights for all pairs, because both scores are 0. The plain sum without a reference
    starts with scores of hundreds of nats: nearly every pair then has weight 0 or 1, improbable winners dominate and
    the policy flattens (watch ``logit_std`` and ``saturated`` at the first step, and ``entropy`` later).

    With ``credit="agent"`` each agent's own tokens are compared, in the direction that the agent itself prefers: it
    may be nearer to its log in the rollout that is the farther one as a whole. A pair costs the mean over the agents
    that have a say, and nothing where none has; lambda acts on the side that the agent prefers less.

    Args:
        actor_network: from :func:`~dpa.losses.token_network`.

    Keyword Args:
        link: what a logit costs.
        alpha: scale of a score; the beta of DPO, IPO and SimPO.
        conservative: lambda in (0, 1], the factor on the unpreferred score (Hejna et al. 2024).
        margin: by which the preferred score is to be ahead, in units of the logit; the gamma of SimPO.
        label_smoothing: e in [0, 0.5), the share of pairs that may be the wrong way round (conservative DPO).
        credit: what is compared, ``"scene"`` (all agents of a rollout together) or ``"agent"``.
        reference: see :class:`~dpa.losses.PreferenceLoss`.
        score_reduction: see there; of an agent's own tokens where agents are compared.
        cloning: see there.

    Raises:
        ValueError: an option outside its range; in a step, sides of different sizes, or agents' preferences missing.

    Examples:
        >>> from tensordict import TensorDict
        >>> from dpa.losses import token_network
        >>> from dpa.models import collate_contexts, make_context
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> loss = ContrastivePreferenceLoss(token_network(model))
        >>> batch = TensorDict(
        ...     {
        ...         "context": collate_contexts([make_context(straight_road(2), model.featurize)]),
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
    class _AcceptedKeys(PreferenceLoss._AcceptedKeys):
        """Keys of the input.

        Attributes:
            agent_preference: ``[S, M, A]`` int64, 1 where an agent itself prefers the preferred rollout of a pair, -1
                the unpreferred one, 0 where it has no say; read with ``credit="agent"`` only.
        """

        agent_preference: NestedKey = keys.AGENT_PREFERENCE

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        link: Link = "logistic",
        alpha: float = 0.1,
        conservative: float = 1.0,
        margin: float = 0.0,
        label_smoothing: float = 0.0,
        credit: Credit = "scene",
        reference: bool = True,
        score_reduction: Reduction = "sum",
        cloning: float = 0.0,
    ) -> None:
        check_choice("link", link, get_args(Link))
        check_choice("credit", credit, get_args(Credit))
        check_not_negative("margin", margin)
        if not 0 < conservative <= 1:
            raise ValueError(f"conservative (lambda) must lie in (0, 1], got {conservative}.")
        if not 0 <= label_smoothing < 0.5:
            raise ValueError(f"label_smoothing must lie in [0, 0.5), got {label_smoothing}.")
        super().__init__(
            actor_network, alpha=alpha, reference=reference, score_reduction=score_reduction, cloning=cloning
        )
        self.link, self.conservative, self.margin = link, conservative, margin
        self.label_smoothing, self.credit = label_smoothing, credit

    @property
    def in_keys(self) -> list[NestedKey]:
        """Where the input lies, in the order in which plain tensors are taken."""
        return super().in_keys + ([self.tensor_keys.agent_preference] if self.credit == "agent" else [])

    def compare(self, preferred: Side, unpreferred: Side, tensordict: TensorDictBase) -> Comparison:
        """Each pair, or each agent of it."""
        sizes = preferred.gain.shape[1], unpreferred.gain.shape[1]
        if sizes[0] != sizes[1]:
            raise ValueError(
                f"pairs need as many preferred as unpreferred rollouts of a scene, got {sizes[0]} and {sizes[1]}; "
                "KahnemanTverskyLoss and PlackettLuceLoss take any numbers."
            )
        if self.credit == "agent":
            return self._by_agent(preferred.agent_score, unpreferred.agent_score, self._say(tensordict, preferred))
        logit = self._logit(preferred.score, unpreferred.score)
        return Comparison(self._smooth("cost", logit), logit.detach(), self._smooth("weight", logit.detach()))

    def _by_agent(self, preferred: Tensor, unpreferred: Tensor, say: Tensor) -> Comparison:
        """Scores ``[S, M, A]`` of agents and what each says ``[S, M, A]``."""
        agrees, counts = say > 0, say != 0
        logit = self._logit(preferred.where(agrees, unpreferred), unpreferred.where(agrees, preferred))
        cost = self._smooth("cost", logit).where(counts, logit.new_zeros(()))
        return Comparison(
            cost.sum(-1) / counts.sum(-1).clamp(min=1), logit.detach(), self._smooth("weight", logit.detach()), counts
        )

    def _say(self, tensordict: TensorDictBase, side: Side) -> Tensor:
        """``[S, M, A]``; an agent without tokens has no say."""
        key = self.tensor_keys.agent_preference
        say = tensordict.get(key, None)
        if say is None:
            raise ValueError(
                f"credit='agent' reads {key!r}, which the batch lacks; give pairs of rollouts ranked by a distance of "
                "each agent, or say credit='scene'."
            )
        return say * side.valid.any(-1)

    def _logit(self, preferred: Tensor, unpreferred: Tensor) -> Tensor:
        return preferred - self.conservative * unpreferred - self.margin

    def _smooth(self, what: Literal["cost", "weight"], logit: Tensor) -> Tensor:
        """Cost or weight if each pair is the wrong way round with probability ``label_smoothing``."""
        curve, sign = getattr(LINKS[self.link], what), 1 if what == "cost" else -1
        return (1 - self.label_smoothing) * curve(logit) + sign * self.label_smoothing * curve(-logit)
