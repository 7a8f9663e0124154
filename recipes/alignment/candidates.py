"""What each method learns from: pairs, sets, rankings or targets, out of a preference store (method.md section 4)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor

from dpa.models import Contexts
from dpa.models.context import Context
from dpa.preferences import (
    PreferenceStore,
    agent_preference,
    all_pairs,
    nearest,
    nearest_farthest,
    random_pairs,
    random_rollouts,
    separated,
    thin_out,
)
from dpa.tokens import MotionTokenizer
from dpa.training.logs import log_item
from envs import keys
from envs.seeding import make_generator
from recipes.alignment.data import PAIRED, RANKED, SIDES, check_data


class Group(NamedTuple):
    """Candidates of one scene.

    Attributes:
        context: uncollated.
        preferred: ``[M, A, T, ...]`` tokens.
        unpreferred: ``[N, A, T, ...]`` tokens; None for a method that only imitates.
        token_valid: ``[A, T]`` bool, the same for both sides, so that nothing but the motion tells them apart.
        agent_preference: ``[M, A]`` int64 of pairs, see :func:`~dpa.preferences.agent_preference`; None where agents
            have no distance of their own.
        sides: how the two sides belong together, one of the values of :data:`~recipes.alignment.data.SIDES`.
    """

    context: Context
    preferred: Tensor
    unpreferred: Tensor | None
    token_valid: Tensor
    agent_preference: Tensor | None = None
    sides: str = "pairs"


class Chosen(NamedTuple):
    """Rollouts of one scene's group: indices ``[M]`` and ``[N]``."""

    preferred: Tensor
    unpreferred: Tensor


def make_candidates(
    data: DictConfig,
    store: PreferenceStore,
    contexts: Contexts,
    tokenizer: MotionTokenizer,
    seed: int,
    expert: PreferenceStore | None = None,
    among: Collection[int] | None = None,
) -> Candidates:
    """Choose rollouts of the scenes of a store.

    Args:
        data: options of :mod:`recipes.alignment.data`: ``kind`` (one of its ``SIDES``), ``rank_by`` (``distance`` or
            ``ade``; of its ``RANKED`` kinds) and ``num``: pairs, targets or rollouts of a scene; a whole number of
            them, or a share of its rollouts below 1.

            - pairs: also ``pairs`` (one of its ``PAIRS``; ``all`` takes no ``num``), ``margin`` (share of the scene's
              mean distance by which the sides of a pair differ at least) and ``rankings_per_scene`` (pairs kept of a
              scene in the mean, see :func:`~dpa.preferences.pairs.thin_out`; None keeps all);
            - sets: ``num`` nearest rollouts against ``num_unpreferred`` farthest ones;
            - ranking: ``num`` rollouts spread evenly over the ranks, None for all.
        store: ranked rollouts.
        contexts: of the scenes that they are of.
        tokenizer: for the tokens of logs.
        seed: of everything that is drawn.
        expert: rollouts of an expert in the same scenes and tokens, the preferred side of ``kind: expert``.
        among: indices of the scenes to take; all by default.

    Returns:
        Groups in the order of the store; scenes that no pair is left of are not among them.

    Raises:
        ValueError: an unknown kind, ranking or way to pair, more rollouts than the groups hold, nothing is left to
            learn from, or no store of an expert that fits.
    """
    data = check_data(data, store.provenance.num_rollouts)
    if data.kind == "expert":
        expert = _check_expert(data, store, expert)
    elif expert is not None:
        raise ValueError(
            f"{expert.folder} holds rollouts of an expert, and method.data.kind={data.kind} reads none; leave expert "
            "out, or say method=afd_expert."
        )
    wanted = set(store.scenes.tolist() if among is None else among)
    rows = [row for row, scene in enumerate(store.scenes.tolist()) if scene in wanted]
    chosen = zip(rows, _choose(data, store, rows, seed), strict=True)
    left = {row: each for row, each in chosen if len(each.preferred)}
    candidates = Candidates(data, store, left, contexts, tokenizer, seed, expert)
    if not any(group.token_valid.any() for group in candidates):
        raise ValueError(
            f"none of the {len(rows)} scenes of {store.folder} has anything to learn from; raise "
            "method.data.rankings_per_scene, or take more scenes."
        )
    return candidates


@dataclass(frozen=True)
class Candidates(Sequence[Group]):
    """What a method may learn from, by scene: read when a step asks for it, whatever the size of the data set.

    Attributes:
        data: options, shares as whole numbers.
        store: ranked rollouts.
        chosen: rollouts of a scene by its row in the store.
        contexts: of the scenes.
        tokenizer: for the tokens of logs.
        seed: of what is drawn of an expert's rollouts.
        expert: rollouts of an expert.
    """

    data: DictConfig
    store: PreferenceStore
    chosen: Mapping[int, Chosen]
    contexts: Contexts
    tokenizer: MotionTokenizer
    seed: int
    expert: PreferenceStore | None

    def __len__(self) -> int:
        return len(self.chosen)

    def __getitem__(self, index: int) -> Group:
        row = self._rows[index]
        scene = int(self.store.scenes[row])
        context = self.contexts[scene]
        agents = len(context.episode.kind)
        group = group_of(self.data, context, self.store.read([row], num_agents=agents)[0], self.chosen[row])
        if self.data.kind == "adversarial":
            log = log_item(context, self.tokenizer)
            return _against(group, log.tokens.expand(self.data.num, *log.tokens.shape[1:]), log.token_valid)
        if self.data.kind == "expert":
            played = self.expert.read([_row_of(self.expert, scene)], num_agents=agents)[0]
            draw = make_generator(self.seed, "expert_rollouts", scene)
            drawn = random_rollouts(1, len(played[keys.TOKENS]), self.data.num, draw)[0]
            return _against(group, played[keys.TOKENS][drawn], played[keys.TOKEN_VALID])
        return group

    @cached_property
    def _rows(self) -> list[int]:
        return list(self.chosen)

    @property
    def counts(self) -> set[int]:
        """Numbers of pairs, or of preferred rollouts, that scenes have."""
        return {len(each.preferred) for each in self.chosen.values()}


def group_of(data: DictConfig, context: Context, ranked: TensorDict, chosen: Chosen) -> Group:
    """Chosen rollouts of one scene's own ranked group, which is cut to its own agents."""
    tokens, valid, say = ranked[keys.TOKENS], ranked[keys.TOKEN_VALID], None
    # Displacement is kept of rollouts as a whole: agents have a preference by the distance only.
    if data.kind in PAIRED and data.rank_by == keys.DISTANCE:
        say = agent_preference(ranked[keys.AGENT_DISTANCE][None], *(side[None] for side in chosen))[0]
    unpreferred = None if data.kind == "best" else tokens[chosen.unpreferred]
    return Group(context, tokens[chosen.preferred], unpreferred, valid, say, SIDES[data.kind])


def _against(group: Group, preferred: Tensor, token_valid: Tensor) -> Group:
    """The group with its preferred side from elsewhere, under the mask that both have in common."""
    return group._replace(preferred=preferred, token_valid=group.token_valid & token_valid)


def _choose(data: DictConfig, store: PreferenceStore, rows: list[int], seed: int) -> list[Chosen]:
    """Rollouts of some scenes, whatever others the store holds; M and N may differ among scenes for pairs only."""
    if data.kind not in RANKED:
        held = store.provenance.num_rollouts
        draws = (make_generator(seed, data.kind, scene) for scene in store.scenes[rows].tolist())
        drawn = (random_rollouts(1, held, data.num, draw)[0] for draw in draws)
        return [Chosen(each, each) for each in drawn]
    distance = (store.distance if data.rank_by == keys.DISTANCE else store.ade)[rows]
    if data.kind == "pairs":
        return _choose_pairs(data, distance, seed)
    order = nearest(distance, distance.shape[-1])
    if data.kind == "best":
        sides = order[:, : data.num], order[:, :0]
    elif data.kind == "sets":
        sides = order[:, : data.num], order[:, -data.num_unpreferred :].flip(-1)
    else:
        held = order.shape[-1]
        ranks = torch.linspace(0, held - 1, data.num or held, dtype=torch.float64).round().long()
        sides = order[:, ranks].tensor_split([(len(ranks) + 1) // 2], dim=1)
    return [Chosen(*each) for each in zip(*sides, strict=True)]


def pair_up(data: DictConfig, distance: Tensor, draw: torch.Generator) -> tuple[Tensor, Tensor]:
    """Preferred and unpreferred sides ``[S, M]`` of the pairs that ``data.pairs`` and ``data.num`` ask for.

    Args:
        data: of a kind in :data:`~recipes.alignment.data.PAIRED`.
        distance: ``[S, K]`` that ranks the rollouts.
        draw: of random pairs.
    """
    if data.pairs == "nearest_farthest":
        return nearest_farthest(distance, data.num)
    return random_pairs(distance, data.num, draw) if data.pairs == "random" else all_pairs(distance)


def _choose_pairs(data: DictConfig, distance: Tensor, seed: int) -> list[Chosen]:
    preferred, unpreferred = pair_up(data, distance, make_generator(seed, "random_pairs"))
    kept = separated(distance, preferred, unpreferred, data.margin, relative=True)
    if not kept.any():
        raise ValueError(
            f"method.data.margin={data.margin} leaves no pair: none differs by this share of its scene's mean "
            "distance; lower it."
        )
    if data.rankings_per_scene is not None:
        kept = thin_out(kept, data.rankings_per_scene, make_generator(seed, "rankings"))
    return [Chosen(near[pairs], far[pairs]) for near, far, pairs in zip(preferred, unpreferred, kept, strict=True)]


def _check_expert(data: DictConfig, store: PreferenceStore, expert: PreferenceStore | None) -> PreferenceStore:
    """The store of the expert, if it speaks of the same scenes in the same tokens."""
    if expert is None:
        raise ValueError(
            "method.data.kind=expert needs rollouts of an expert, and there are none; say expert=DIR, the folder of "
            "their preferences."
        )
    for name in ("scenes", "horizon", "tokenizer"):
        mine, other = getattr(store.provenance, name), getattr(expert.provenance, name)
        if mine != other:
            raise ValueError(
                f"{expert.folder} has {name} {other} and {store.folder} {mine}; let the expert roll out the same "
                "scenes with the same tokens."
            )
    if data.num > expert.provenance.num_rollouts:
        raise ValueError(
            f"method.data.num={data.num} needs as many rollouts of the expert and {expert.folder} holds "
            f"{expert.provenance.num_rollouts} of a scene; lower it, or collect again."
        )
    missing = sorted(set(store.scenes.tolist()) - set(expert.scenes.tolist()))
    if missing:
        raise ValueError(
            f"{expert.folder} lacks {len(missing)} scenes of {store.folder}, scene {missing[0]} first; collect with "
            "the expert until it has all."
        )
    return expert


def _row_of(store: PreferenceStore, scene: int) -> int:
    return int((store.scenes == scene).nonzero()[0])
