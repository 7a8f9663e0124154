"""Rollouts made by hand on straight roads: it is known who collides, who leaves the road, and what is coupled."""

from __future__ import annotations

import torch
from torch import Tensor

from dpa.ranking import PreferenceDistance, log_trajectory
from dpa.report.judged import JudgedRollouts, judge_rollouts
from dpa.report.player import PlayerScene
from envs.scene import Scene
from envs.sources.synthetic import red_light, straight_road

COLLISION, OFFROAD = slice(20, 30), slice(40, 80)
"""Simulated steps at which cars 0 and 1 of :func:`with_mishaps` overlap, and at which car 2 is off the road."""
DISTANCE = PreferenceDistance(stride=5)


def with_mishaps(scene: Scene) -> Tensor:
    """``[3, 80, 4]``: the log but for a jump of the second car into the first one, and of the third off the road."""
    trajectory = log_trajectory(scene, 80).clone()
    trajectory[1, COLLISION, 0] += 12.0
    trajectory[2, OFFROAD, 1] -= 6.0
    return trajectory


def slower(scene: Scene, metres: float) -> Tensor:
    """``[A, 80, 4]``: everybody falls behind the log, by so much in the end."""
    return log_trajectory(scene, 80) - torch.linspace(0, metres, 80)[:, None] * torch.tensor([1.0, 0, 0, 0])


def judged(scene: Scene, trajectories: list[Tensor], nats: list[float], kept: int = 6) -> JudgedRollouts:
    """Rollouts of a scene in which all agents are controlled."""
    controlled = torch.ones(int(scene.agents.present.sum()), dtype=torch.bool)
    return judge_rollouts(scene, torch.stack(trajectories), controlled, torch.tensor(nats), DISTANCE, kept)


def made_players() -> list[PlayerScene]:
    """Two scenes; in the first, the reference's most likely rollout has the mishaps, and its nearest one is the log."""
    road, light = straight_road(3), red_light()
    log = log_trajectory(road, 80)
    reference = judged(road, [slower(road, 10), with_mishaps(road), log, slower(road, 30)], [-2.0, -1.0, -1.5, -3.0])
    aligned = judged(road, [slower(road, 5), slower(road, 20)], [-0.5, -0.7])
    one = judged(light, [slower(light, 15)], [-1.25])
    return [PlayerScene(road, {"reference": reference, "DPA-OMF": aligned}), PlayerScene(light, {"reference": one})]
