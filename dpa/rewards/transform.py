"""Rewards behind a collector, beside the ranking."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from dpa.ranking import Distance, agent_spread
from dpa.ranking.transform import PAPER_DISTANCE, Ranked, RankRollouts, stacked
from dpa.rewards.functions import Outcome, Reward
from envs import keys
from envs.scene import SceneSource


class RewardRollouts(RankRollouts):
    """Ranks rollouts, pays for them, and keeps the log-probabilities by which their tokens were drawn.

    Writes, beside what :class:`~dpa.ranking.transform.RankRollouts` writes, ``SAMPLE_LOG_PROB``, ``SPREAD``,
    ``RANKED_IN`` and, under ``REWARDS``, each reward by its name, ``[S, K, A, T]``, 0 of padding. Reads
    ``SAMPLING_LOG_PROB`` as well.

    Args:
        scenes: where the environment's scenes come from.
        num_rollouts: K.
        distance: how rollouts are compared.
        rewards: that are paid, by name; see :data:`~dpa.rewards.functions.REWARDS`.

    Raises:
        ValueError: as the ranking, or a reward of another shape than ``[K, A or 1, T or 1]``.
    """

    def __init__(
        self,
        scenes: SceneSource,
        num_rollouts: int,
        distance: Distance = PAPER_DISTANCE,
        rewards: Mapping[str, Reward] | None = None,
    ) -> None:
        super().__init__(scenes, num_rollouts, distance)
        self.on_device = False  # rewards are measured beside the scenes, on the CPU
        self.rewards = dict(rewards or {})
        self.in_keys = [*self.in_keys, keys.SAMPLING_LOG_PROB]
        self.out_keys += [
            keys.SAMPLE_LOG_PROB,
            keys.SPREAD,
            keys.RANKED_IN,
            *((keys.REWARDS, name) for name in self.rewards),
        ]

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Rank and pay every group: ``[S * K, T]`` -> ``[S]``."""
        start = time.perf_counter()
        groups = super().forward(tensordict)
        each = (time.perf_counter() - start) / len(groups)
        groups.set(keys.RANKED_IN, torch.full((len(groups),), each, device=groups.device))
        likely = tensordict[keys.SAMPLING_LOG_PROB].unflatten(0, (-1, self.num_rollouts))
        return groups.set(keys.SAMPLE_LOG_PROB, likely.movedim(2, -1))

    def entries(self, ranked: Sequence[Ranked], rows: int, decisions: int) -> dict[NestedKey, Tensor]:
        """The ranking, and the rewards."""
        outcomes = [Outcome(**group._asdict(), distance=self.distance, decisions=decisions) for group in ranked]
        paid = {
            (keys.REWARDS, name): torch.stack([self._paid(name, one, rows) for one in outcomes])
            for name in self.rewards
        }
        spread = stacked([agent_spread(one.trajectories) for one in outcomes], rows)
        return super().entries(ranked, rows, decisions) | {keys.SPREAD: spread, **paid}

    def _paid(self, name: str, outcome: Outcome, rows: int) -> Tensor:
        """``[K, rows, T]``; nothing where nobody was moved."""
        rollouts, agents = outcome.trajectories.shape[:2]
        paid = outcome.trajectories.new_zeros(rollouts, rows, outcome.decisions)
        if outcome.controlled.any():
            found = self.rewards[name](outcome)
            if found.dim() != 3:
                raise ValueError(
                    f"the reward {name} must be [K, A, T], with 1 for what it does not tell apart, got "
                    f"{list(found.shape)}."
                )
            paid[:, :agents] = found
        return paid
