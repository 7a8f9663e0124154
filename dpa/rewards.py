"""Rewards of ranked rollouts, and the advantages that a policy gradient follows.

A reward is a function of a ranked group (:class:`~dpa.ranking.transform.RankRollouts`), the higher the better. Some are
of a rollout as a whole, some of each agent, so that credit reaches whom it belongs to. Add one of your own to
:data:`REWARDS`, and any YAML can name it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, get_args

from tensordict import TensorDictBase
from torch import Tensor

from envs import keys

REWARDS: dict[str, Callable[[TensorDictBase], Tensor]] = {
    "distance": lambda ranked: -ranked[keys.DISTANCE][..., None],
    "agent_distance": lambda ranked: -ranked[keys.AGENT_DISTANCE],
    "ade": lambda ranked: -ranked[keys.ADE][..., None],
}
"""By name: a ranked group ``[S]`` to ``[S, K, A]``, or to ``[S, K, 1]`` where all agents are paid alike."""
Baseline = Literal["leave_one_out", "mean"]
Scale = Literal["group", "none"]
SMALLEST_SPREAD = 1e-3
"""Spread of a group's rewards below which they are as good as equal."""


def check_rewards(weights: Mapping[str, float]) -> None:
    """Refuse rewards that nobody knows, or that pay nothing.

    Raises:
        ValueError: the message lists the known ones.
    """
    if unknown := sorted(weights.keys() - REWARDS.keys()):
        raise ValueError(f"there is no reward {unknown[0]!r}; choose among {', '.join(REWARDS)}.")
    if not any(weights.values()):
        raise ValueError(f"all of the rewards {', '.join(weights)} weigh 0; give one of them a weight.")


def reward_of(ranked: TensorDictBase, weights: Mapping[str, float]) -> Tensor:
    """The weighted sum of some rewards.

    Args:
        ranked: groups ``[S]`` of K rollouts.
        weights: by name; those of 0 are left out.

    Returns:
        ``[S, K, A]``, or ``[S, K, 1]`` where no reward tells agents apart.

    Raises:
        ValueError: as :func:`check_rewards`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> ranked = TensorDict({"ade": torch.tensor([[1.0, 3.0]])}, batch_size=[1])
        >>> reward_of(ranked, {"ade": 0.5, "distance": 0.0}).squeeze()
        tensor([-0.5000, -1.5000])
    """
    check_rewards(weights)
    return sum(weight * REWARDS[name](ranked) for name, weight in weights.items() if weight)


def advantages(reward: Tensor, *, baseline: Baseline = "leave_one_out", scale: Scale = "none") -> Tensor:
    """How much better each rollout was than the others of its group.

    Args:
        reward: ``[S, K, ...]``, K of 2 or more.

    Keyword Args:
        baseline: the mean of the other K - 1 rollouts (RLOO; Ahmadian et al., 2024), in which the rollout has no part,
            or that of all K (GRPO; Shao et al., 2024), whose advantages are (K - 1) / K of the former.
        scale: none (RLOO, whose gradient is unbiased), or divide by the standard deviation of the group (GRPO), each
            agent's own where agents have rewards of their own, so that all groups and agents weigh alike. Where it is
            below :data:`SMALLEST_SPREAD` there is nothing to prefer, and the advantage is 0.

    Returns:
        Like ``reward``.

    Raises:
        ValueError: an unknown choice, or a group of one.

    Examples:
        >>> import torch
        >>> advantages(torch.tensor([[1.0, 2.0, 6.0]]))
        tensor([[-3.0000, -1.5000,  4.5000]])
        >>> advantages(torch.tensor([[1.0, 2.0, 6.0]]), baseline="mean")
        tensor([[-2., -1.,  3.]])
        >>> advantages(torch.tensor([[-1.0, 1.0], [5.0, 5.0]]), baseline="mean", scale="group")
        tensor([[-0.7071,  0.7071],
                [ 0.0000,  0.0000]])
    """
    for name, value, known in (("baseline", baseline, Baseline), ("scale", scale, Scale)):
        if value not in get_args(known):
            raise ValueError(f"{name} must be {' or '.join(get_args(known))}, got {value!r}.")
    rollouts = reward.shape[1]
    if rollouts < 2:
        raise ValueError("a rollout is compared with the others of its group, and there are none; roll out 2 or more.")
    above = reward - reward.mean(1, keepdim=True)
    if baseline == "leave_one_out":
        above = above * rollouts / (rollouts - 1)
    if scale == "none":
        return above
    spread = reward.std(1, keepdim=True)
    return above.where(spread >= SMALLEST_SPREAD, above.new_zeros(())) / spread.clamp(min=SMALLEST_SPREAD)
