"""Rollouts of one scene with what a viewer asks of them: how near, how likely, who collides, and what is like the log.

Many rollouts are judged and few are kept: the most likely one (figures 5 and 9), and some from the nearest to
the farthest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from dpa.ranking import PreferenceDistance, rank_of
from dpa.ranking.features import feature_names
from dpa.safety.off_road import off_road
from envs.geometry.boxes import nearest_box_distance
from envs.scene import EDGE_KINDS, Scene, polylines

COUPLING_STRIDE = 5
"""Couplings are shown at the ends of decisions of 0.5 s: a matrix of 16 x 16 can be read, one of 80 x 80 cannot."""


class Couplings(NamedTuple):
    """How E ranked agents of R rollouts are coupled with their log, at T' steps; D features."""

    agents: Tensor
    """``[E]`` int64: rows among the present agents."""
    stride: int
    """Steps of 0.1 s from one to the next; the first is ``stride`` steps after the current one."""
    features: tuple[str, ...]
    """Names of the D features."""
    weights: Tensor
    """``[D]``: of the cost of a pair of steps."""
    valid: Tensor
    """``[E, T']`` bool."""
    rollouts: Tensor
    """``[R, E, T', D]``: features, clipped; 0 where not valid."""
    log: Tensor
    """``[E, T', D]``: likewise."""
    partner: Tensor
    """``[R, E, T']`` int64: the step of the log that most of the mass of a step goes to; -1 where not valid."""
    share: Tensor
    """``[R, E, D]``: share of each feature in what the agent pays; rows sum to 1, or are 0 where it pays nothing."""


@dataclass(frozen=True)
class JudgedRollouts:
    """R of K rollouts of one scene; A are the agents present at the current step, in scene order.

    Attributes:
        poses: ``[R, A, 80, 3]`` x, y, heading.
        sampled: K.
        number: ``[R]`` int64, of the rollout among all K.
        distance: ``[R]`` preference distance.
        distance_rank: ``[R]`` int64 among all K, 0 for the nearest.
        log_likelihood: ``[R]`` under the rollout's own policy, mean over tokens [nats].
        likelihood_rank: ``[R]`` int64 among all K, 0 for the most likely.
        agent_distance: ``[R, A]``; 0 where the agent took no part.
        collides: ``[R, A, 80]`` bool.
        offroad: ``[R, A, 80]`` bool.
        couplings: of the ranked agents.
    """

    poses: Tensor
    sampled: int
    number: Tensor
    distance: Tensor
    distance_rank: Tensor
    log_likelihood: Tensor
    likelihood_rank: Tensor
    agent_distance: Tensor
    collides: Tensor
    offroad: Tensor
    couplings: Couplings


def judge_rollouts(
    scene: Scene,
    trajectories: Tensor,
    controlled: Tensor,
    log_likelihood: Tensor,
    distance: PreferenceDistance,
    kept: int,
) -> JudgedRollouts:
    """Rank rollouts, keep some, and say of these what happens in them.

    Args:
        scene: an uncollated scene.
        trajectories: ``[K, A, 80, 4]`` x, y, z, heading of the present agents.
        controlled: ``[A]`` bool.
        log_likelihood: ``[K]`` [nats per token].
        distance: how rollouts are compared with the log.
        kept: rollouts to keep, see :func:`kept_rollouts`.

    Raises:
        ValueError: a likelihood that is no number, or a scene without road edges.

    Examples:
        >>> from dpa.ranking import log_trajectory
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> log = log_trajectory(scene, 80)
        >>> slower = log - torch.linspace(0, 20, 80)[:, None] * torch.tensor([1.0, 0, 0, 0])
        >>> both, nats = torch.stack((slower, log)), torch.tensor([-1.0, -2.0])
        >>> judged = judge_rollouts(scene, both, torch.ones(2, dtype=torch.bool), nats, PreferenceDistance(), kept=2)
        >>> judged.distance_rank, judged.likelihood_rank
        (tensor([1, 0]), tensor([0, 1]))
    """
    if not log_likelihood.isfinite().all():
        raise ValueError(
            f"scene {scene.scene_id}: a rollout has the log-likelihood {log_likelihood.tolist()}; it takes a mean over "
            "at least one token of a controlled agent."
        )
    ranking = distance(scene, trajectories, controlled)
    number = kept_rollouts(ranking.distance, log_likelihood, kept)
    shown = trajectories[number]
    collides, offroad = mishaps(scene, shown)
    return JudgedRollouts(
        poses=shown[..., [0, 1, 3]],
        sampled=len(trajectories),
        number=number,
        distance=ranking.distance[number],
        distance_rank=rank_of(ranking.distance)[number],
        log_likelihood=log_likelihood[number],
        likelihood_rank=rank_of(-log_likelihood)[number],
        agent_distance=ranking.agent_distance[number],
        collides=collides,
        offroad=offroad,
        couplings=couple(distance, scene, shown, ranking.agent_ranked.nonzero()[:, 0]),
    )


def kept_rollouts(distance: Tensor, log_likelihood: Tensor, kept: int) -> Tensor:
    """Numbers of the most likely rollout and of others that lie evenly between the nearest and the farthest one.

    Args:
        distance: ``[K]``.
        log_likelihood: ``[K]``.
        kept: of the ranks by distance; the most likely rollout may come on top.

    Returns:
        ``[R]`` int64, ascending; R is at most ``kept + 1``.

    Raises:
        ValueError: none is kept.

    Examples:
        >>> kept_rollouts(torch.tensor([4.0, 3.0, 2.0, 1.0, 0.0]), torch.tensor([-1.0, -0.5, -2.0, -2.0, -2.0]), kept=3)
        tensor([0, 1, 2, 4])
    """
    if kept < 1:
        raise ValueError(f"kept must be 1 or more, got {kept}.")
    last = len(distance) - 1
    ranks = torch.linspace(0, last, min(kept, len(distance))).round().long()
    return torch.cat((distance.argsort(stable=True)[ranks], log_likelihood.argmax()[None])).unique()


def mishaps(scene: Scene, trajectories: Tensor) -> tuple[Tensor, Tensor]:
    """Who collides and who is off the road, by the measures of the realism metric, of everybody and not of some agents.

    Args:
        scene: an uncollated scene.
        trajectories: ``[R, A, T, 4]`` x, y, z, heading of the present agents, all of which stay to the end.

    Returns:
        ``[R, A, T]`` bool: the box overlaps another one, corners rounded; a corner of the box lies beyond a road edge.

    Raises:
        ValueError: the scene has no road edges.

    Examples:
        >>> from dpa.ranking import log_trajectory
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> log = log_trajectory(scene, 80)[None]
        >>> [bool(flags.any()) for flags in mishaps(scene, log)]
        [False, False]
        >>> [bool(flags.any()) for flags in mishaps(scene, log + torch.tensor([0, 50.0, 0, 0]))]
        [False, True]
    """
    everywhere = torch.ones(trajectories.shape[:-1], dtype=torch.bool)
    return _mishaps(scene, trajectories, scene.agents.extent[scene.agents.present], everywhere)


def logged_mishaps(scene: Scene) -> tuple[Tensor, Tensor]:
    """The same of the whole log and all its agents: ``[A, L]`` bool each, False where an agent is not there."""
    agents = scene.agents
    poses = agents.trajectory[None]
    collides, offroad = _mishaps(scene, poses, agents.extent, agents.valid[None])
    return collides[0], offroad[0]


def _mishaps(scene: Scene, poses: Tensor, extent: Tensor, there: Tensor) -> tuple[Tensor, Tensor]:
    lines = [line for line in polylines(scene, EDGE_KINDS) if len(line) >= 2]
    if not lines:
        raise ValueError(f"scene {scene.scene_id} has no road edge, so nobody can be off the road; play another scene.")
    size = extent[None, :, None].expand(*poses.shape[:-1], 3)
    boxes = torch.cat((poses[..., [0, 1, 3]], size[..., :2]), -1).transpose(1, 2).contiguous()
    nearest = nearest_box_distance(boxes, there.transpose(1, 2).contiguous()).transpose(1, 2)
    return (nearest < 0) & there, off_road(lines, poses, extent, there)


def couple(distance: PreferenceDistance, scene: Scene, trajectories: Tensor, agents: Tensor) -> Couplings:
    """Couple agents of rollouts with their log as a distance does, at 2 Hz or at the distance's own, lower rate.

    Args:
        distance: how rollouts are compared with the log.
        scene: an uncollated scene.
        trajectories: ``[R, A, T, 4]`` of the present agents.
        agents: ``[E]`` int64, rows to couple.

    Examples:
        >>> from dpa.ranking import log_trajectory
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> coupled = couple(PreferenceDistance(), scene, log_trajectory(scene, 80)[None], torch.arange(2))
        >>> coupled.partner[0, 0].tolist() == list(range(16)), float(coupled.share.sum())
        (True, 0.0)
    """
    stride = max(distance.stride, COUPLING_STRIDE)
    rollouts, log, valid, weights, moved = distance.couple(scene, trajectories, agents, stride=stride)
    paid = moved.distance[..., None]
    return Couplings(
        agents=agents,
        stride=stride,
        features=feature_names(distance.features),
        weights=weights,
        valid=valid,
        rollouts=rollouts,
        log=log,
        partner=torch.where(valid, moved.coupling.argmax(-1), -1),
        share=torch.where(paid > 0, moved.parts / paid, 0),
    )
