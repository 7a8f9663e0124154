"""What each method learns from: pairs or targets, drawn from a preference store (METHOD section 6)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from omegaconf import DictConfig
from torch import Tensor

from dpa.policy import ContextOptions, SceneContext, collate_contexts
from dpa.policy.actor import Contexts
from dpa.preferences import PreferenceStore, nearest, nearest_farthest, random_rollouts
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
            pairs or targets of a scene.
        store: ranked rollouts.
        scenes: that they are of.
        options: how scenes are cut up.
        tokenizer: for the tokens of logs.
        seed: of the random rollouts of ``adversarial``.

    Raises:
        ValueError: an unknown kind or ranking, or more pairs than the groups hold.
    """
    if data.kind not in DATA:
        raise ValueError(f"method.data.kind must be one of {', '.join(DATA)}, got {data.kind!r}.")
    if data.kind != "adversarial" and data.rank_by not in (keys.DISTANCE, keys.ADE):
        raise ValueError(f"method.data.rank_by must be distance or ade, got {data.rank_by!r}.")
    needed, held = data.num * (2 if data.kind == "pairs" else 1), store.provenance.num_rollouts
    if not data.num > 0 or needed > held:
        raise ValueError(
            f"method.data.num={data.num} needs {needed} rollouts of a scene and the store holds {held}; lower it, or "
            "collect again with a larger collection.num_rollouts."
        )
    contexts = Contexts(scenes, options)
    groups = []
    for row, scene in enumerate(store.scenes.tolist()):
        context = contexts[scene]
        ranked = store.read([row], num_agents=len(context.kind))
        tokens, valid = ranked[keys.TOKENS][0].long(), ranked[keys.TOKEN_VALID][0]
        if data.kind == "adversarial":
            drawn = random_rollouts(1, len(tokens), data.num, make_generator(seed, "adversarial", scene))[0]
            log = log_item(context, tokenizer)
            groups.append(Group(context, log.tokens.expand(data.num, -1, -1), tokens[drawn], log.token_valid & valid))
        elif data.kind == "best":
            groups.append(Group(context, tokens[nearest(ranked[data.rank_by], data.num)[0]], None, valid))
        else:
            preferred, unpreferred = nearest_farthest(ranked[data.rank_by], data.num)
            groups.append(Group(context, tokens[preferred[0]], tokens[unpreferred[0]], valid))
    return [group for group in groups if group.token_valid.any()]


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
