"""The ranked rollouts of one scene as plain arrays, what must hold for them, and the way from and to tensordicts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from dpa.preferences.provenance import Provenance, StoreError
from dpa.ranking.distance import rank_of
from envs import keys
from envs.scene import AgentKind

NUMBERS = ("agent_distance", "distance", "ade", "feature_share")
"""Fields of :class:`Group` that are float32."""


class Group(NamedTuple):
    """One scene without padding: A are its agents, D the features."""

    scene: int
    tokens: np.ndarray
    """``[A, K, T]`` whole numbers, or ``[A, K, T, D]`` float32; 0 where no token counts."""
    token_valid: np.ndarray
    """``[A, T]`` bool."""
    agent_ranked: np.ndarray
    """``[A]`` bool."""
    agent_kind: np.ndarray
    """``[A]`` whole numbers, :class:`~envs.scene.AgentKind`."""
    agent_distance: np.ndarray
    """``[A, K]`` float32; 0 where the agent took no part."""
    distance: np.ndarray
    """``[K]`` float32."""
    ade: np.ndarray
    """``[K]`` float32 [m]."""
    feature_share: np.ndarray
    """``[K, D]`` float32."""


def group_shapes(a: int, k: int, t: int, d: int, token: tuple[int, ...] = ()) -> dict[str, tuple[int, ...]]:
    """Shape of every array of a :class:`Group` of A agents, K rollouts, T decisions and D features, and of a token."""
    return {
        "tokens": (a, k, t, *token),
        "token_valid": (a, t),
        "agent_ranked": (a,),
        "agent_kind": (a,),
        "agent_distance": (a, k),
        "distance": (k,),
        "ade": (k,),
        "feature_share": (k, d),
    }


def take_groups(groups: TensorDictBase, origin: Provenance) -> list[Group]:
    """Check groups of batch size ``[S]``, as :class:`~dpa.ranking.transform.RankRollouts` gives them, and unpad them.

    Rows at the end that neither act, nor are ranked, nor are of a class are padding.

    Raises:
        StoreError: groups that are not of this origin, or a value that cannot be right.
    """
    tokens = groups[keys.TOKENS]
    if tokens.shape[1] != origin.num_rollouts or tokens.shape[3] != origin.horizon:
        raise StoreError(
            f"this store is for {origin.num_rollouts} rollouts of {origin.horizon} decisions, got {tokens.shape[1]} of "
            f"{tokens.shape[3]}; name a new folder, or roll out like the groups that it holds."
        )
    taken = [_taken(group) for group in groups.cpu()]
    for group in taken:
        check_group(group, origin)
    return taken


def _taken(group: TensorDictBase) -> Group:
    valid, ranked, kind = group[keys.TOKEN_VALID], group[keys.AGENT_RANKED], group[keys.AGENT_KIND]
    there = (valid.any(-1) | ranked | (kind != AgentKind.UNSET)).nonzero()
    size = int(there.max()) + 1 if len(there) else 0
    tokens = group[keys.TOKENS]
    tokens = torch.where(valid.view(*valid.shape, *(1,) * (tokens.dim() - 3)), tokens, 0)
    return Group(
        scene=int(group[keys.SCENE]),
        tokens=tokens.transpose(0, 1)[:size].contiguous().numpy(),
        token_valid=valid[:size].numpy(),
        agent_ranked=ranked[:size].numpy(),
        agent_kind=kind[:size].numpy(),
        agent_distance=group[keys.AGENT_DISTANCE].float().transpose(0, 1)[:size].contiguous().numpy(),
        distance=group[keys.DISTANCE].float().numpy(),
        ade=group[keys.ADE].float().numpy(),
        feature_share=group[keys.FEATURE_SHARE].float().numpy(),
    )


def check_group(group: Group, origin: Provenance) -> None:
    """What must hold for every group of a store, when it is written and when the store is verified.

    Args:
        group: to look at.
        origin: of the store.

    Raises:
        StoreError: naming the scene and what is wrong with it.
    """
    name, valid = f"scene {group.scene}", np.broadcast_to(group.token_valid[:, None], group.tokens.shape[:3])
    used = group.tokens[valid]
    if group.scene < 0:
        raise StoreError(f"{name}: the index of a scene is not negative; give the index in the scene source.")
    shapes = group_shapes(len(group.tokens), origin.num_rollouts, origin.horizon, group.feature_share.shape[-1],
                          origin.layout.shape)  # fmt: skip
    for field, shape in shapes.items():
        if getattr(group, field).shape != shape:
            raise StoreError(f"{name}: {field} is {getattr(group, field).shape} and not {shape}; rank it again.")
    if origin.vocab_size and used.size and not 0 <= used.min() <= used.max() < origin.vocab_size:
        raise StoreError(
            f"{name}: tokens from {used.min()} to {used.max()} are outside the vocabulary of {origin.vocab_size}; "
            "give the vocab_size of the tokenizer."
        )
    if group.tokens[~valid].any():
        raise StoreError(f"{name}: there are tokens where none counts; roll it out and rank it again.")
    for field in ("tokens", *NUMBERS):
        if not np.isfinite(getattr(group, field)).all():
            raise StoreError(f"{name}: {field} is not finite everywhere; rank it again.")
    if group.agent_distance[~group.agent_ranked].any():
        raise StoreError(f"{name}: an agent that took no part in the ranking has a distance; rank it again.")
    if not np.isin(group.agent_kind, list(AgentKind)).all():
        raise StoreError(f"{name}: {group.agent_kind.max()} is no class of agents; give an AgentKind.")


def pad_groups(groups: Sequence[Group], origin: Provenance, num_features: int, num_agents: int) -> TensorDict:
    """Groups as a tensordict of batch size ``[S]``, agents padded.

    Args:
        groups: S of them.
        origin: of their store.
        num_features: D.
        num_agents: A, at least that of the largest group.
    """
    shapes = group_shapes(num_agents, origin.num_rollouts, origin.horizon, num_features, origin.layout.shape)
    dtypes = _DTYPES | {"tokens": torch.int64 if origin.vocab_size else torch.float32}
    made = {name: torch.zeros(len(groups), *shape, dtype=dtypes.get(name)) for name, shape in shapes.items()}
    for row, group in enumerate(groups):
        for name, values in made.items():
            array = torch.from_numpy(getattr(group, name))
            values[row, : len(array)] = array  # what has no rows of agents has all its rows
    return TensorDict(
        {
            keys.SCENE: torch.tensor([group.scene for group in groups], dtype=torch.int64),
            keys.TOKENS: made["tokens"].transpose(1, 2).contiguous(),
            keys.TOKEN_VALID: made["token_valid"],
            keys.DISTANCE: made["distance"],
            keys.AGENT_DISTANCE: made["agent_distance"].transpose(1, 2).contiguous(),
            keys.ADE: made["ade"],
            keys.AGENT_RANKED: made["agent_ranked"],
            keys.AGENT_KIND: made["agent_kind"],
            keys.FEATURE_SHARE: made["feature_share"],
            keys.RANK: rank_of(made["distance"]),
        },
        batch_size=[len(groups)],
    )


_DTYPES = {"agent_kind": torch.int64, "token_valid": torch.bool, "agent_ranked": torch.bool}
