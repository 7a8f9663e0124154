"""The loss that a method's YAML names, and whether it can read what the method learns from."""

from __future__ import annotations

from omegaconf import DictConfig
from torchrl.objectives import LossModule

from dpa.losses import (
    ContrastivePreferenceLoss,
    ImitationLoss,
    KahnemanTverskyLoss,
    PlackettLuceLoss,
    PolicyGradientLoss,
    token_network,
)
from dpa.models import MotionModel
from envs import keys
from recipes.alignment.data import PAIRED, SIDES, num_candidates
from recipes.alignment.draws import num_drawn
from recipes.common.cli import build

LOSSES: dict[str, type[LossModule]] = {
    "contrastive": ContrastivePreferenceLoss,
    "kahneman_tversky": KahnemanTverskyLoss,
    "plackett_luce": PlackettLuceLoss,
    "next_token": ImitationLoss,
    "policy_gradient": PolicyGradientLoss,
}
"""Losses that a method's YAML can name."""
FITS = {
    "pairs": ("pairs", "pairs in parts"),
    "sets": ("pairs", "sets"),
    "ranking": ("ranking",),
    "targets": ("targets",),
    "groups": ("groups",),
}
"""What a loss can read, by its ``sides``: all pairs of a scene may be read as two sets."""


def make_loss(section: DictConfig, model: MotionModel) -> LossModule:
    """The loss that a method names, around the model; a reference copy is the model as it is now."""
    options = {key: value for key, value in section.items() if key != "kind"}
    if section.kind not in LOSSES:
        raise ValueError(f"method.loss.kind must be one of {sorted(LOSSES)}, got {section.kind!r}.")
    return build(LOSSES[section.kind], DictConfig(options), f"method.loss ({section.kind})", token_network(model))


def check_fit(method: DictConfig, alignment: DictConfig, held: int) -> None:
    """Refuse a loss that would misread what the method learns from; a loss that has no ``sides`` takes anything.

    Args:
        method: ``data`` and ``loss``, from ``config/method``.
        alignment: the section, of which ``pairs_per_scene`` is read.
        held: K, rollouts of a scene.

    Raises:
        ValueError: for instance a ranking loss for pairs, or for rankings of two.
    """
    data = method.data
    if method.loss.get("credit") == "agent" and not (data.kind in PAIRED and data.rank_by == keys.DISTANCE):
        raise ValueError(
            "method.loss.credit=agent needs pairs that agents are ranked in one by one: method.data.kind=pairs or "
            f"own_pairs, and rank_by={keys.DISTANCE}, got {data.kind} and {data.get('rank_by')}."
        )
    if method.loss.kind == "plackett_luce" and data.kind == "ranking":
        ranked = sum(num_drawn(*num_candidates(data, held), alignment.pairs_per_scene))
        if ranked < 3:
            raise ValueError(
                "method.loss.kind=plackett_luce ranks several rollouts, and of two it is the loss of a pair; "
                f"method.data.num={data.num} of {held} rollouts and alignment.pairs_per_scene="
                f"{alignment.pairs_per_scene} leave {ranked}; say method.data.num=null and "
                "alignment.pairs_per_scene=4, or method=dpo."
            )
    if data.get("passes", 1) > 1 and method.loss.get("clip") is None:
        raise ValueError(
            f"method.data.passes={data.passes} takes several steps with the same rollouts, which without a clip lead "
            "away from the policy that drew them; say method.loss.clip=0.2, or method.data.passes=1."
        )
    if data.kind == "own_groups" and alignment.staleness > 0 and method.loss.get("clip") is None:
        raise ValueError(
            f"alignment.staleness={alignment.staleness} learns from rollouts of older weights, whose gradient needs a "
            "ratio of likelihoods; say method.loss.clip=0.2, or alignment.staleness=0."
        )
    wanted = getattr(LOSSES.get(method.loss.kind), "sides", None)
    given = SIDES.get(method.data.kind)
    if wanted is None or given is None or given in FITS[wanted]:
        return
    kinds = [kind for kind, sides in SIDES.items() if sides in FITS[wanted]]
    raise ValueError(
        f"method.loss.kind={method.loss.kind} learns from {wanted}, and method.data.kind={method.data.kind} gives "
        f"{given}; say method.data.kind={' or '.join(kinds)}, or another loss."
    )
