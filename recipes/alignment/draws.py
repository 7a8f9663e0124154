"""What a step takes from the candidates of its scenes, as batches for a loss."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor
from torch.nn import functional as F

from dpa.training.batches import Item, collate_items, micro_batches
from dpa.training.distributed import ALONE, Ranks
from envs import keys
from recipes.alignment.candidates import Group


class Draw(NamedTuple):
    """Rows of one scene's group: of the preferred (or target) rollouts and of the unpreferred ones."""

    group: Group
    preferred: Tensor
    unpreferred: Tensor


def parts_of(
    groups: list[Group], options: DictConfig, draw: torch.Generator, device: str, ranks: Ranks = ALONE
) -> Iterator[tuple[TensorDict, float]]:
    """Drawn rollouts of scenes of similar size as batches, each with its share of the step.

    A preference loss is a mean over scenes; imitation is a mean over tokens. All ranks draw for all scenes of the
    step, so that what is drawn does not depend on their number, and each passes its own.

    Args:
        groups: of the scenes of the step.
        options: ``pairs_per_scene``, see :func:`draw_rows`, and ``max_rows``: the larger side's rollouts x agents.
        draw: the only source of randomness.
        device: of the batches.
        ranks: that pass the step together.
    """
    drawn = [draw_rows(group, options.pairs_per_scene, draw) for group in groups]
    weights = [1 if group.unpreferred is not None else int(group.token_valid.sum()) for group in groups]
    mine = ranks.mine(range(len(groups)))
    if not mine:  # scenes without tokens were left out; the other ranks wait for a pass of this one
        yield make_batch(drawn[:1]).to(device), 0.0
    for part in micro_batches([_rows(drawn[i]) for i in mine], options.max_rows):
        share = sum(weights[mine[i]] for i in part) / max(1, sum(weights))
        yield make_batch([drawn[mine[i]] for i in part]).to(device), share


def draw_rows(group: Group, num: int, draw: torch.Generator) -> Draw:
    """Some rollouts of a scene, in the order in which the group holds them: what is left of a ranking is one.

    Args:
        group: of the scene.
        num: pairs, targets, or preferred rollouts; all of them where there are fewer. Of sides that are not paired, a
            draw of its own takes the same share of the unpreferred rollouts, rounded up.
        draw: the only source of randomness.
    """
    preferred = _some(len(group.preferred), num, draw)
    if group.unpreferred is None or group.sides == "pairs":
        return Draw(group, preferred, preferred)
    _, others = num_drawn(len(group.preferred), len(group.unpreferred), num)
    return Draw(group, preferred, _some(len(group.unpreferred), others, draw))


def num_drawn(preferred: int, unpreferred: int, num: int) -> tuple[int, int]:
    """How many rollouts a step takes of either side.

    Args:
        preferred: M, those that a scene has.
        unpreferred: N.
        num: asked for of the preferred ones.

    Examples:
        >>> num_drawn(preferred=8, unpreferred=16, num=1), num_drawn(preferred=2, unpreferred=2, num=4)
        ((1, 2), (2, 2))
    """
    drawn = min(preferred, num)
    return drawn, -(-unpreferred * drawn // preferred)


def make_batch(drawn: list[Draw]) -> TensorDict:
    """A batch of what was drawn of some scenes.

    Two sides become ``preferred`` and ``unpreferred``, with ``agent_preference`` where the groups have it; targets
    become ``tokens``. All scenes of a method have the same.
    """
    batch = collate_items(
        [Item(one.group.context, one.group.preferred[one.preferred], one.group.token_valid) for one in drawn]
    )
    first = drawn[0].group
    if first.unpreferred is not None:
        other = [
            Item(one.group.context, one.group.unpreferred[one.unpreferred], one.group.token_valid) for one in drawn
        ]
        batch.rename_key_(keys.TOKENS, keys.PREFERRED)
        batch[keys.UNPREFERRED] = collate_items(other)[keys.TOKENS]
    if first.agent_preference is not None:
        agents = batch[keys.TOKEN_VALID].shape[2]
        says = [one.group.agent_preference[one.preferred] for one in drawn]
        batch[keys.AGENT_PREFERENCE] = torch.stack([F.pad(say, (0, agents - say.shape[1])) for say in says])
    return batch


def _some(held: int, num: int, draw: torch.Generator) -> Tensor:
    return torch.randperm(held, generator=draw)[:num].sort().values


def _rows(drawn: Draw) -> int:
    return len(drawn.group.token_valid) * max(len(drawn.preferred), len(drawn.unpreferred))
