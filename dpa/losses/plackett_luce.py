"""Plackett-Luce: the likelihood of a whole ranking of rollouts (Rafailov et al. 2023, appendix A.3)."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch.nn import functional as F

from dpa.losses.preference import Comparison, PreferenceLoss, Side


class PlackettLuceLoss(PreferenceLoss):
    """Raises the probability of choosing rollouts of a scene one after the other in the order of their ranking.

    The ranking is the preferred rollouts followed by the unpreferred ones, **each side nearest first**. With scores
    ``A_1 ... A_n`` in this order, the k-th choice among those that are left costs

        ``-log(exp A_k / sum_(j >= k) exp A_j) = softplus(-(A_k - log sum_(j > k) exp A_j))``

    so that the bracket is its logit. A scene costs the mean over its n - 1 choices: of two rollouts it is the
    contrastive logistic loss with lambda 1.

    Args:
        actor_network: from :func:`~dpa.losses.token_network`.

    Keyword Args:
        alpha: see :class:`~dpa.losses.PreferenceLoss`; so are ``reference``, ``score_reduction`` and ``cloning``.

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
        >>> loss = PlackettLuceLoss(token_network(model))
        >>> batch = TensorDict(
        ...     {
        ...         "context": collate_contexts([make_context(straight_road(2), model.featurize)]),
        ...         "preferred": torch.full((1, 2, 2, 16), 84),
        ...         "unpreferred": torch.full((1, 1, 2, 16), 90),
        ...         "token_valid": torch.ones(1, 1, 2, 16, dtype=torch.bool),
        ...     },
        ...     batch_size=[1],
        ... )
        >>> round(loss(batch)["loss_preference"].item(), 4)  # equal scores: (log 3 + log 2) / 2
        0.8959
    """

    sides = "ranking"

    def compare(self, preferred: Side, unpreferred: Side, tensordict: TensorDictBase) -> Comparison:
        """Each choice against all that are left."""
        score = torch.cat((preferred.score, unpreferred.score), 1)
        rest = score.flip(1).logcumsumexp(1).flip(1)
        logit = score[:, :-1] - rest[:, 1:]
        return Comparison(F.softplus(-logit), logit.detach(), torch.sigmoid(-logit).detach())
