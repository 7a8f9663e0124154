"""What each method learns from: pairs, sets, rankings or targets, out of a preference store (method.md section 4)."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from torch import Tensor

from dpa.policy import ContextOptions, SceneContext
from dpa.policy.actor import Contexts
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
from dpa.training.batches import log_item
from envs import keys
from envs.scene import SceneSource
from envs.seeding import make_generator


class Group(NamedTuple):
    """Candidates of one scene.

    Attributes:
        context: uncollated.
        preferred: ``[M, A, T]`` tokens.
        unpreferred: ``[N, A, T]`` tokens; None for a method that only imitates.
        token_valid: ``[A, T]`` bool, the same for both sides, so that nothing but the motion tells them apart.
        agent_preference: ``[M, A]`` int64 of pairs, see :func:`~dpa.preferences.agent_preference`; None where agents
            have no distance of their own.
        sides: how the two sides belong together, one of the values of :data:`SIDES`.
    """

    context: SceneContext
    preferred: Tensor
    unpreferred: Tensor | None
    token_valid: Tensor
    agent_preference: Tensor | None = None
    sides: str = "pairs"


SIDES = {
    "pairs": "pairs",
    "best": "targets",
    "sets": "sets",
    "ranking": "ranking",
    "adversarial": "pairs",
    "expert": "pairs",
}
"""Ways to learn from the rollouts of a scene (``config/method``), and what each gives: M pairs, M targets to imitate,
two sets of any sizes, or one ranking, whose nearer half is the preferred side and the rest the unpreferred one."""
RANKED = ("pairs", "best", "sets", "ranking")
"""Those of them that read ranks."""
READ = {
    "pairs": ("rank_by", "pairs", "num", "margin", "rankings_per_scene"),
    "best": ("rank_by", "num"),
    "sets": ("rank_by", "num", "num_unpreferred"),
    "ranking": ("rank_by", "num"),
    "adversarial": ("num",),
    "expert": ("num",),
}
"""Options of each beside ``kind``."""
PAIRS = ("nearest_farthest", "random", "all")
"""Ways to pair the rollouts of a group."""


class Chosen(NamedTuple):
    """Rollouts of one scene's group: indices ``[M]`` and ``[N]``."""

    preferred: Tensor
    unpreferred: Tensor


def make_candidates(
    data: DictConfig,
    store: PreferenceStore,
    scenes: SceneSource,
    options: ContextOptions,
    tokenizer: MotionTokenizer,
    seed: int,
    expert: PreferenceStore | None = None,
    among: Collection[int] | None = None,
) -> Candidates:
    """Choose rollouts of the scenes of a store.

    Args:
        data: ``kind`` (one of :data:`SIDES`), ``rank_by`` (``distance`` or ``ade``; for :data:`RANKED` ones) and
            ``num``: pairs, targets or rollouts of a scene; a whole number of them, or a share of its rollouts below 1.

            - pairs: also ``pairs`` (one of :data:`PAIRS`; ``all`` takes no ``num``), ``margin`` (share of the scene's
              mean distance by which the sides of a pair differ at least) and ``rankings_per_scene`` (pairs kept of a
              scene in the mean, see :func:`~dpa.preferences.pairs.thin_out`; None keeps all);
            - sets: ``num`` nearest rollouts against ``num_unpreferred`` farthest ones;
            - ranking: ``num`` rollouts spread evenly over the ranks, None for all.
        store: ranked rollouts.
        scenes: that they are of.
        options: how scenes are cut up.
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
    candidates = Candidates(data, store, left, Contexts(scenes, options), tokenizer, seed, expert)
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
        agents = len(context.kind)
        group = _group(self.data, context, self.store.read([row], num_agents=agents)[0], self.chosen[row])
        if self.data.kind == "adversarial":
            log = log_item(context, self.tokenizer)
            return _against(group, log.tokens.expand(self.data.num, -1, -1), log.token_valid)
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


def _group(data: DictConfig, context: SceneContext, ranked: TensorDict, chosen: Chosen) -> Group:
    """Chosen rollouts of one scene's own group."""
    tokens, valid, say = ranked[keys.TOKENS], ranked[keys.TOKEN_VALID], None
    # Displacement is kept of rollouts as a whole: agents have a preference by the distance only.
    if data.kind == "pairs" and data.rank_by == keys.DISTANCE:
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


def _choose_pairs(data: DictConfig, distance: Tensor, seed: int) -> list[Chosen]:
    if data.pairs == "nearest_farthest":
        preferred, unpreferred = nearest_farthest(distance, data.num)
    elif data.pairs == "random":
        preferred, unpreferred = random_pairs(distance, data.num, make_generator(seed, "random_pairs"))
    else:
        preferred, unpreferred = all_pairs(distance)
    kept = separated(distance, preferred, unpreferred, data.margin, relative=True)
    if not kept.any():
        raise ValueError(
            f"method.data.margin={data.margin} leaves no pair: none differs by this share of its scene's mean "
            "distance; lower it."
        )
    if data.rankings_per_scene is not None:
        kept = thin_out(kept, data.rankings_per_scene, make_generator(seed, "rankings"))
    return [Chosen(near[pairs], far[pairs]) for near, far, pairs in zip(preferred, unpreferred, kept, strict=True)]


def num_candidates(data: DictConfig, held: int) -> tuple[int, int]:
    """How many rollouts of a scene that is learnt from stand on either side, M and N; a margin may leave fewer.

    Args:
        data: of a method, see :func:`make_candidates`.
        held: K, rollouts of a scene.

    Examples:
        >>> data = OmegaConf.create({"kind": "sets", "rank_by": "distance", "num": 0.25, "num_unpreferred": 16})
        >>> num_candidates(data, held=32)
        (8, 16)
    """
    data = check_data(data, held)
    if data.kind == "ranking":
        whole = data.num or held
        return (whole + 1) // 2, whole // 2
    num = held * (held - 1) // 2 if data.kind == "pairs" and data.pairs == "all" else data.num
    if data.kind == "pairs" and data.rankings_per_scene is not None:
        num = min(num, max(1, int(data.rankings_per_scene)))  # of half a pair in the mean, a scene has one or none
    return num, {"best": 0, "sets": data.get("num_unpreferred")}.get(data.kind, num)


def check_data(data: DictConfig, held: int) -> DictConfig:
    """Refuse options of a method's data before any work.

    Args:
        data: of a method, see :func:`make_candidates`.
        held: K, rollouts of a scene.

    Returns:
        The options, shares of the rollouts as whole numbers.

    Raises:
        ValueError: an unknown kind, option, ranking or way to pair, or more rollouts than there are.
    """
    counted = _counted(data, held)
    _check(counted, held, data)
    return counted


def _counted(data: DictConfig, held: int) -> DictConfig:
    """Shares of a scene's rollouts as whole numbers, at least one."""
    shares = {name: data.get(name) for name in ("num", "num_unpreferred") if isinstance(data.get(name), float)}
    for name, share in shares.items():
        if not 0 < share < 1:
            raise ValueError(f"method.data.{name} must be a whole number, or a share between 0 and 1, got {share}.")
    return OmegaConf.merge(data, {name: max(1, round(share * held)) for name, share in shares.items()})


def _asked(given: DictConfig, data: DictConfig, name: str) -> str:
    """An option as it was given, and the number that it stands for where it is a share."""
    told = f"method.data.{name}={given[name]}"
    return told if given[name] == data[name] else f"{told} ({data[name]})"


def _check(data: DictConfig, held: int, given: DictConfig) -> None:
    if data.kind not in SIDES:
        raise ValueError(f"method.data.kind must be one of {', '.join(SIDES)}, got {data.kind!r}.")
    if unread := sorted(set(map(str, data)) - {"kind", *READ[data.kind]}):
        raise ValueError(
            f"method.data.{unread[0]} says nothing to method.data.kind={data.kind}, which takes "
            f"{', '.join(READ[data.kind])}; leave it out (~method.data.{unread[0]})."
        )
    if data.kind in RANKED and data.rank_by not in (keys.DISTANCE, keys.ADE):
        raise ValueError(f"method.data.rank_by must be distance or ade, got {data.rank_by!r}.")
    if data.kind == "pairs" and data.pairs not in PAIRS:
        raise ValueError(f"method.data.pairs must be one of {', '.join(PAIRS)}, got {data.pairs!r}.")
    if data.kind == "pairs" and data.pairs == "all":
        if data.num is not None:
            raise ValueError(
                f"method.data.pairs=all takes every pair, and {_asked(given, data, 'num')} asks for some; say "
                "method.data.num=null, and rankings_per_scene to keep fewer."
            )
        _check_pairs(data, held * (held - 1) // 2)
        return
    if data.kind == "ranking" and data.num is None:
        return
    for name in ("num", "num_unpreferred") if data.kind == "sets" else ("num",):
        if type(data.get(name)) is not int:
            raise ValueError(
                f"method.data.{name} must be a whole number, or a share between 0 and 1, got {data.get(name)!r}."
            )
        if data[name] < 1:
            raise ValueError(f"method.data.{name} must be 1 or more, got {data[name]}.")
    _check_enough(data, held, given)
    if data.kind == "pairs":
        _check_pairs(data, data.num)


def _check_pairs(data: DictConfig, pairs: int) -> None:
    if data.margin < 0:
        raise ValueError(f"method.data.margin must be 0 or more, got {data.margin}.")
    if data.rankings_per_scene is None:
        return
    if not data.rankings_per_scene > 0:
        raise ValueError(f"method.data.rankings_per_scene must be positive, got {data.rankings_per_scene}.")
    if data.rankings_per_scene > pairs:
        raise ValueError(
            f"method.data.rankings_per_scene={data.rankings_per_scene} and a scene has {pairs} pairs; lower it, take "
            "more of the rollouts (method.data.num), or collect more of them."
        )


def _check_enough(data: DictConfig, held: int, given: DictConfig) -> None:
    asked, needed = _asked(given, data, "num"), data.num
    if data.kind == "pairs":
        needed *= 2
    elif data.kind == "sets":
        asked = f"{asked} and {_asked(given, data, 'num_unpreferred')}"
        needed += data.num_unpreferred
    elif data.kind == "ranking" and data.num < 2:
        raise ValueError(f"a ranking needs two rollouts, got {asked}; say 2 or more, or null for all.")
    if needed > held:
        raise ValueError(
            f"{asked} needs {needed} rollouts of a scene and there are {held}; lower it, or collect again with a "
            "larger collection.num_rollouts."
        )


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
