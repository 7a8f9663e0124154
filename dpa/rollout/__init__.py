"""Rollouts in groups of K per scene, by TorchRL collectors: here, in processes, or on a Ray cluster."""

from dpa.rollout.collector import RolloutCollector, make_collector
from dpa.rollout.crew import Workers
from dpa.rollout.job import RolloutJob, RolloutWorker, Subset
from dpa.rollout.plan import RolloutTask, plan_tasks
from dpa.rollout.poses import lifted, simulated_poses

__all__ = [
    "RolloutCollector",
    "RolloutJob",
    "RolloutTask",
    "RolloutWorker",
    "Subset",
    "Workers",
    "lifted",
    "make_collector",
    "plan_tasks",
    "simulated_poses",
]
