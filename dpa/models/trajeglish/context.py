"""What Trajeglish sees of a scene: what its encoder reads, and in which order agents decide."""

from __future__ import annotations

from dataclasses import fields
from typing import ClassVar

import torch
from torch import Tensor

from dpa.models import scene as surroundings
from dpa.models.scene import ContextOptions, SceneContext
from envs.episode import Episode
from envs.scene import CURRENT_STEP, Scene


class TrajeglishContext(SceneContext):
    """Inputs of Trajeglish for one scene, or for a padded batch of them (``*`` is nothing or ``S``).

    Attributes:
        rank: ``[*, A]`` place of each agent by its distance to the SDC at the current step; of equals the first.
        turns: ``[*, C]`` bool, one for each controlled agent: what matters is their number, which a tensor's shape
            tells without asking the device.
    """

    of_agents: ClassVar[tuple[str, ...]] = ("rank",)
    rank: Tensor
    turns: Tensor


def featurize(scene: Scene, episode: Episode, options: ContextOptions | None = None) -> TrajeglishContext:
    """Cut up one uncollated scene.

    Examples:
        >>> from envs.episode import make_episode
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(3)
        >>> featurize(scene, make_episode(scene)).rank
        tensor([0, 1, 2])
    """
    seen = surroundings.featurize(scene, episode, options)
    sdc = scene.agents.position[scene.agents.sdc, CURRENT_STEP, :2]
    away = (episode.recent[:, -1, :2] - sdc).norm(dim=-1)
    return TrajeglishContext(
        **{field.name: getattr(seen, field.name) for field in fields(SceneContext)},
        rank=away.argsort(stable=True).argsort(),
        turns=episode.controlled[episode.controlled],
        batch_size=[],
    )


def order_of(context: TrajeglishContext) -> Tensor:
    """``[S, A]``: agents in the order of their turns, then those who take none.

    Args:
        context: of batch size ``[S]``.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from envs.sources.synthetic import straight_road
        >>> context = collate_contexts([make_context(straight_road(3), featurize)])
        >>> context.rank, context.episode.controlled = torch.tensor([[2, 0, 1]]), torch.tensor([[True, False, True]])
        >>> order_of(context)
        tensor([[2, 0, 1]])
    """
    last = torch.iinfo(torch.int64).max
    return context.rank.masked_fill(~context.episode.controlled, last).argsort(dim=-1, stable=True)


def turns_of(context: TrajeglishContext) -> int:
    """C, turns in a decision: at least one, and no more than there are agents.

    Args:
        context: of batch size ``[S]``.

    Examples:
        >>> from dpa.models.context import collate_contexts, make_context
        >>> from envs.sources.synthetic import straight_road
        >>> turns_of(collate_contexts([make_context(straight_road(count), featurize) for count in (3, 1)]))
        3
    """
    return max(1, min(context.turns.shape[1], context.rank.shape[1]))
