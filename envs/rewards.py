"""Rewards for reinforcement learning, made of what an environment signals."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Transform

from envs import keys


class SignalReward(Transform):
    """Makes ``("agents", "reward")`` a weighted sum of signals.

    An agent that no policy moves has reward 0. Nobody's episode ends before the horizon: TorchRL ends rows, not agents,
    and one that has crashed drives on, at its cost.

    Args:
        weights: of the environment's signals, by name: reward for a metre, or for an event.

    Keyword Args:
        imitation: weight of the environment's own reward, minus the displacement from the log [1/m].

    Raises:
        ValueError: no weight at all, or, once appended, a weight of a signal that the environment does not give.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from envs.sources.synthetic import straight_road
        >>> from envs.traffic import TrafficEnv
        >>> weights = {"progress": 0.1, "collision": -1.0}
        >>> env = TransformedEnv(TrafficEnv([straight_road(2)], signals=tuple(weights)), SignalReward(weights))
        >>> env.rollout(2)["next", "agents", "reward"].shape
        torch.Size([1, 2, 2, 1])
    """

    def __init__(self, weights: Mapping[str, float], *, imitation: float = 0.0) -> None:
        if not weights and not imitation:
            raise ValueError("SignalReward needs a weight, got none; give weights={'progress': 0.1} for instance.")
        super().__init__(in_keys=[(keys.AGENTS, name) for name in weights], out_keys=[keys.REWARD])
        self.weights, self.imitation = dict(weights), imitation

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        reward = weighted_reward(next_tensordict, self.weights, self.imitation)
        return next_tensordict.set(keys.REWARD, reward)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Nothing changes; the signals must be there."""
        missing = [key[-1] for key in self.in_keys if key not in observation_spec.keys(True, True)]
        if missing:
            raise ValueError(
                f"the environment gives no signal {missing}; set TrafficEnv(signals={tuple(self.weights)})."
            )
        return observation_spec


def weighted_reward(after: TensorDictBase, weights: Mapping[str, float], imitation: float = 0.0) -> Tensor:
    """The reward of a step, see :class:`SignalReward`.

    Args:
        after: what the environment gives under ``"next"``.
        weights: of its signals.
        imitation: weight of its own reward.

    Returns:
        ``[B, A, 1]``.
    """
    reward = imitation * after[keys.REWARD]
    for name, weight in weights.items():
        reward = reward + weight * after[keys.AGENTS, name][..., None]
    return torch.where(after[keys.CONTROLLED][..., None], reward, 0)
