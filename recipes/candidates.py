"""What each method learns from: pairs or targets, drawn from a preference store (METHOD section 6)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from dpa.policy import ContextOptions, SceneContext, collate_contexts
from dpa.policy.actor import Contexts
from dpa.preferences import (
    PreferenceStore,
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
        unpreferred: ``[M, A, T]`` tokens, pair by pair; None for a method that only imitates.
        token_valid: ``[A, T]`` bool, the same for both sides, so that nothing but the motion tells them apart.
    """

    context: SceneContext
    preferred: Tensor
    unpreferred: Tensor | None
    token_valid: Tensor


Candidates = list[Group]
DATA = ("pairs", "best", "adversarial")
"""Ways to learn from a ranked group; see ``config/method``."""
PAIRS = ("nearest_farthest", "random", "all")
"""Ways to pair the rollouts of a group."""


def make_candidates(
    data: DictConfig,
    store: PreferenceStore,
    scenes: SceneSource,
    options: ContextOptions,
    tokenizer: MotionTokenizer,
    seed: int,
) -> Candidates:
    """Candidates of every scene of a store.

    Args:
        data: ``kind`` (one of :data:`DATA`), ``rank_by`` (``distance`` or ``ade``; not for adversarial) and ``num``:
            pairs or targets of a scene. For pairs also ``pairs`` (one of :data:`PAIRS`; ``all`` takes no ``num``),
            ``margin`` (share of the scene's mean distance by which the sides of a pair differ at least) and
            ``rankings_per_scene`` (pairs that are kept of a scene in the mean, see
            :func:`~dpa.preferences.pairs.thin_out`; None keeps all).
        store: ranked rollouts.
        scenes: that they are of.
        options: how scenes are cut up.
        tokenizer: for the tokens of logs.
        seed: of everything that is drawn.

    Returns:
        Scenes that no pair is left of, or no token, are not among them.

    Raises:
        ValueError: an unknown kind, ranking or way to pair, more pairs than the groups hold, or no pair is left.
    """
    _check(data, store)
    contexts = Contexts(scenes, options)
    chosen = _choose_pairs(data, store, seed) if data.kind == "pairs" else None
    groups = []
    for row, scene in enumerate(store.scenes.tolist()):
        if chosen is not None and not len(chosen[row][0]):
            continue
        context = contexts[scene]
        ranked = store.read([row], num_agents=len(context.kind))
        tokens, valid = ranked[keys.TOKENS][0], ranked[keys.TOKEN_VALID][0]
        if chosen is not None:
            preferred, unpreferred = chosen[row]
            groups.append(Group(context, tokens[preferred], tokens[unpreferred], valid))
        elif data.kind == "best":
            groups.append(Group(context, tokens[nearest(ranked[data.rank_by], data.num)[0]], None, valid))
        else:
            drawn = random_rollouts(1, len(tokens), data.num, make_generator(seed, "adversarial", scene))[0]
            log = log_item(context, tokenizer)
            groups.append(Group(context, log.tokens.expand(data.num, -1, -1), tokens[drawn], log.token_valid & valid))
    return [group for group in groups if group.token_valid.any()]


def _check(data: DictConfig, store: PreferenceStore) -> None:
    """Refuse options before any work."""
    if data.kind not in DATA:
        raise ValueError(f"method.data.kind must be one of {', '.join(DATA)}, got {data.kind!r}.")
    if data.kind != "adversarial" and data.rank_by not in (keys.DISTANCE, keys.ADE):
        raise ValueError(f"method.data.rank_by must be distance or ade, got {data.rank_by!r}.")
    if data.kind == "pairs" and data.pairs not in PAIRS:
        raise ValueError(f"method.data.pairs must be one of {', '.join(PAIRS)}, got {data.pairs!r}.")
    if data.kind == "pairs" and data.pairs == "all":
        if data.num is not None:
            raise ValueError(
                f"method.data.pairs=all takes every pair, and method.data.num={data.num} asks for some; say "
                "method.data.num=null, and rankings_per_scene to keep fewer."
            )
        return
    if not isinstance(data.num, int):
        raise ValueError(f"method.data.num must be a whole number, got {data.num!r}.")
    needed, held = data.num * (2 if data.kind == "pairs" else 1), store.provenance.num_rollouts
    if not data.num > 0 or needed > held:
        raise ValueError(
            f"method.data.num={data.num} needs {needed} rollouts of a scene and the store holds {held}; lower it, or "
            "collect again with a larger collection.num_rollouts."
        )


def _choose_pairs(data: DictConfig, store: PreferenceStore, seed: int) -> list[tuple[Tensor, Tensor]]:
    """Preferred and unpreferred rollouts ``[M]`` of every scene, M of its own."""
    distance = store.distance if data.rank_by == keys.DISTANCE else store.ade
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
    return [(near[rows], far[rows]) for near, far, rows in zip(preferred, unpreferred, kept, strict=True)]


@torch.no_grad()
def pair_accuracy(model: torch.nn.Module, candidates: Candidates, device: str) -> float:
    """Share of pairs whose preferred rollout is the more likely one under a model (METHOD table 3)."""
    right = total = 0
    for group in candidates:
        scores = []
        context = collate_contexts([group.context]).to(device)
        valid = group.token_valid[None, None].to(device)
        for tokens in (group.preferred, group.unpreferred):
            tokens = tokens[None].to(device)
            log_prob = model(context, tokens, valid).log_softmax(-1).gather(-1, tokens[..., None])[..., 0]
            scores.append((log_prob * valid).sum((-1, -2))[0])
        right += int((scores[0] > scores[1]).sum())
        total += len(scores[0])
    return right / max(total, 1)
