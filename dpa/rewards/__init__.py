"""Rewards of ranked rollouts, and the advantages that a policy gradient follows."""

from dpa.rewards.advantages import Baseline, Scale, advantages
from dpa.rewards.functions import REWARDS, Outcome, Reward, check_horizon, check_rewards
from dpa.rewards.ranking import RealismRanking
from dpa.rewards.transform import RewardRollouts

__all__ = [
    "REWARDS",
    "Baseline",
    "Outcome",
    "RealismRanking",
    "Reward",
    "RewardRollouts",
    "Scale",
    "advantages",
    "check_horizon",
    "check_rewards",
]
