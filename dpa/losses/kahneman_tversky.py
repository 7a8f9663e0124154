"""Kahneman-Tversky optimisation: rollouts that are desirable or not, without pairs (Ethayarajh et al. 2024)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule

from dpa.losses.preference import Comparison, PreferenceLoss, Reduction, Side, check_positive


class KahnemanTverskyLoss(PreferenceLoss):
    """KTO: each rollout on its own, against how far the policy has moved from the reference in its scene.

    With the score ``A = alpha * reduce(log pi - log pi_ref)`` and the anchor ``z0``, a preferred rollout costs
    ``w_D * sigmoid(z0 - A)`` and an unpreferred one ``w_U * sigmoid(A - z0)``. Sides may differ in size; a scene costs
    the mean over its rollouts.

    The anchor is the divergence of the policy from the reference, ``alpha * reduce(KL)``, averaged over the rollouts of
    the **scene** and without a gradient. Over the vocabulary of a token it is exact, where KTO for language
    estimates it from mismatched pairs of the batch; and with one anchor for each scene a step does not depend on
    which scenes share a part of the batch.

    Args:
        actor_network: from :func:`~dpa.losses.token_network`.

    Keyword Args:
        desirable_weight: w_D. With M preferred and N unpreferred rollouts, both sides weigh alike where
            ``w_D * M = w_U * N``.
        undesirable_weight: w_U.
        alpha: scale of a score; their beta.
        score_reduction: see :class:`~dpa.losses.PreferenceLoss`.
        cloning: see there.

    Raises:
        ValueError: an option outside its range.

    Examples:
        >>> from tensordict import TensorDict
        >>> from dpa.losses import token_network
        >>> from dpa.models import collate_contexts, make_context
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> loss = KahnemanTverskyLoss(token_network(model), undesirable_weight=0.5)
        >>> batch = TensorDict(
        ...     {
        ...         "context": collate_contexts([make_context(straight_road(2), model.featurize)]),
        ...         "preferred": torch.full((1, 2, 2, 16), 84),
        ...         "unpreferred": torch.full((1, 3, 2, 16), 90),
        ...         "token_valid": torch.ones(1, 1, 2, 16, dtype=torch.bool),
        ...     },
        ...     batch_size=[1],
        ... )
        >>> round(loss(batch)["loss_preference"].item(), 4)  # no score, no drift: (2 + 3 * 0.5) / 5 * 1/2
        0.35
    """

    sides = "sets"

    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        desirable_weight: float = 1.0,
        undesirable_weight: float = 1.0,
        alpha: float = 0.1,
        score_reduction: Reduction = "sum",
        cloning: float = 0.0,
    ) -> None:
        check_positive("desirable_weight", desirable_weight)
        check_positive("undesirable_weight", undesirable_weight)
        super().__init__(actor_network, alpha=alpha, score_reduction=score_reduction, cloning=cloning)
        self.desirable_weight, self.undesirable_weight = desirable_weight, undesirable_weight

    def compare(self, preferred: Side, unpreferred: Side, tensordict: TensorDictBase) -> Comparison:
        """Each rollout with the anchor of its scene."""
        anchor = torch.cat((preferred.divergence, unpreferred.divergence), 1).mean(1, keepdim=True)
        logit = torch.cat((preferred.score - anchor, anchor - unpreferred.score), 1)
        share = torch.cat(
            (
                torch.full_like(preferred.divergence, self.desirable_weight),
                torch.full_like(unpreferred.divergence, self.undesirable_weight),
            ),
            1,
        )
        wrong = torch.sigmoid(-logit)
        return Comparison(share * wrong, logit.detach(), (share * wrong * (1 - wrong)).detach())
