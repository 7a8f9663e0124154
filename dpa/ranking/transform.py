"""Ranking behind a collector: rollouts ``[S * K, T]`` in, ranked groups ``[S]`` out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.envs import Transform

from dpa.ranking.distance import Distance, PreferenceDistance, Ranking, rank_of
from envs import keys
from envs.geometry.ground import lift
from envs.scene import CURRENT_STEP, Scene, SceneSource

PAPER_DISTANCE = PreferenceDistance()
"""All features, the paper's weights, exact transport at 10 Hz, summed over the controlled agents."""


class Ranked(NamedTuple):
    """K rollouts of one scene, as the environment drove them, and their ranking; A agents are present."""

    scene: Scene
    """Uncollated."""
    trajectories: Tensor
    """``[K, A, T * F, 4]`` x, y, z, heading."""
    controlled: Tensor
    """``[A]`` bool."""
    ranking: Ranking


class RankRollouts(Transform):
    """Ranks the K rollouts of each scene by their preference distance to the log and by their ADE.

    Made for a collector's ``postproc``: it runs once, on complete episodes, and what it returns is small enough to keep
    (tokens and numbers; poses follow from tokens). Never append it to a replay buffer, which would rank anew at every
    sample. Rollouts on a device come to the CPU at once, before anything is computed; poses stay there for a distance
    that ranks on the device (``on_device``).

    Reads ``scene`` and ``step`` ``[B, T]``, and under ``agents`` ``token`` and ``controlled`` ``[B, T, A]`` and
    ``("next", ..., "recent")`` ``[B, T, A, F + 1, 3]``. Writes a tensordict of batch size ``[S]`` with the keys of
    :mod:`envs.keys` from ``TOKENS`` to ``RANK`` (of the distance), and ``SCENE``. Agents are the rows of the
    environment: those present in the scene, in order, then padding.

    Args:
        scenes: where the environment's scenes come from.
        num_rollouts: K.
        distance: how rollouts are compared; the paper's way by default. Any :class:`~dpa.ranking.distance.Distance`.

    Raises:
        ValueError: in ``forward``, when the batch is not made of whole groups of whole episodes.

    Examples:
        >>> from dpa.tokens import TokenAction, VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> from envs.traffic import TrafficEnv
        >>> from torchrl.envs import TransformedEnv
        >>> scenes = [straight_road(2), straight_road(3)]
        >>> env = TransformedEnv(TrafficEnv(scenes, num_scenes=2, num_rollouts=4), TokenAction(VerletTokenizer()))
        >>> RankRollouts(scenes, num_rollouts=4)(env.rollout(16))["distance"].shape
        torch.Size([2, 4])
    """

    def __init__(self, scenes: SceneSource, num_rollouts: int, distance: Distance = PAPER_DISTANCE) -> None:
        super().__init__(
            in_keys=[keys.SCENE, keys.STEP, keys.TOKEN, keys.CONTROLLED, ("next", *keys.RECENT)],
            out_keys=[
                keys.SCENE,
                keys.TOKENS,
                keys.TOKEN_VALID,
                keys.DISTANCE,
                keys.AGENT_DISTANCE,
                keys.ADE,
                keys.AGENT_RANKED,
                keys.AGENT_KIND,
                keys.FEATURE_SHARE,
                keys.RANK,
            ],
        )
        if num_rollouts < 1:
            raise ValueError(f"num_rollouts must be 1 or more, got {num_rollouts}.")
        self.scenes, self.num_rollouts, self.distance = scenes, num_rollouts, distance
        self.on_device = getattr(distance, "on_device", False)

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Rank every group: ``[S * K, T]`` -> ``[S]``."""
        scene, controlled, tokens, poses = self._groups(tensordict)
        ranked = [self._rank(*group) for group in zip(scene.tolist(), poses, controlled, strict=True)]
        return TensorDict(
            {
                keys.SCENE: scene,
                keys.TOKENS: tokens,
                keys.TOKEN_VALID: controlled[:, :, None].expand(-1, -1, tokens.shape[3]).clone(),
                **self.entries(ranked, controlled.shape[1], tokens.shape[3]),
            },
            batch_size=[len(ranked)],
            device=tensordict.device,
        )

    def entries(self, ranked: Sequence[Ranked], rows: int, decisions: int) -> dict[NestedKey, Tensor]:
        """What is told of S groups beside their tokens, each ``[S, ...]``; a subclass may tell more.

        Args:
            ranked: the groups.
            rows: agents of the environment, padding included.
            decisions: T.
        """
        rankings = [group.ranking for group in ranked]
        kinds = [group.scene.agents.kind[group.scene.agents.present] for group in ranked]
        distance = torch.stack([ranking.distance for ranking in rankings])
        return {
            keys.DISTANCE: distance,
            keys.AGENT_DISTANCE: stacked([ranking.agent_distance for ranking in rankings], rows),
            keys.ADE: torch.stack([ranking.ade for ranking in rankings]),
            keys.AGENT_RANKED: stacked([ranking.agent_ranked for ranking in rankings], rows),
            keys.AGENT_KIND: stacked(kinds, rows),
            keys.FEATURE_SHARE: torch.stack([ranking.feature_share for ranking in rankings]),
            keys.RANK: rank_of(distance),
        }

    def _groups(self, rollouts: TensorDictBase) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Scene ``[S]``, controlled ``[S, A]``, tokens ``[S, K, A, T, ...]`` and poses ``[S, K, A, T * F, 3]``.

        All but the tokens are on the CPU, where scenes are, and so are poses unless the distance ranks on the device.
        """
        recent = ("next", *keys.RECENT)
        # All that comes back from the device comes here, at once.
        here = rollouts.select(keys.SCENE, keys.STEP, keys.CONTROLLED, *(() if self.on_device else (recent,))).cpu()
        groups = self._check_episodes(here)
        scene = self._alike(groups[keys.SCENE], "scenes")
        controlled = self._alike(groups[keys.CONTROLLED], "controlled agents")
        tokens = rollouts[keys.TOKEN].unflatten(0, (-1, self.num_rollouts)).transpose(2, 3)
        poses = (rollouts if self.on_device else here)[recent].unflatten(0, (-1, self.num_rollouts))
        decisions = poses[..., 1:, :]  # the first pose repeats the last one of the step before
        return scene, controlled, tokens, decisions.movedim(2, 3).flatten(3, 4)

    def _check_episodes(self, rollouts: TensorDictBase) -> TensorDictBase:
        """The rollouts as ``[S, K, T]``."""
        if rollouts.batch_dims != 2 or rollouts.shape[0] % self.num_rollouts:
            raise ValueError(
                f"rollouts of batch size {list(rollouts.batch_size)} are not [S * {self.num_rollouts}, T]; give the "
                "ranking the num_rollouts of the environment."
            )
        step = rollouts[keys.STEP].reshape(rollouts.batch_size)
        wanted = torch.arange(rollouts.shape[1], device=step.device)
        # Zero everywhere is what a collector's fake batch holds.
        if not bool((step == wanted).all() or (step == 0).all()):
            raise ValueError(
                f"a batch must hold whole episodes from step 0 on, got steps {step[0].tolist()}; set "
                "reset_at_each_iter=True and frames_per_batch = S * K * horizon in the collector."
            )
        return rollouts.view(-1, self.num_rollouts, rollouts.shape[1])

    def _alike(self, value: Tensor, what: str) -> Tensor:
        """The one value of each group, ``[S, K, T, ...]`` -> ``[S, ...]``."""
        one = value[:, :1, :1]
        if not bool((value == one).all()):
            group = int((value != one).flatten(1).any(1).nonzero()[0])
            raise ValueError(
                f"the {self.num_rollouts} rollouts of group {group} have different {what}; the rollouts of a scene "
                "must be contiguous and num_rollouts that of the environment."
            )
        return one[:, 0, 0]

    def _rank(self, index: int, poses: Tensor, controlled: Tensor) -> Ranked:
        """Rank one group, without the padding of the environment."""
        scene = self.scenes[index]
        num_agents = self._num_agents(scene, poses.shape[1])
        start = scene.agents.position[scene.agents.present, CURRENT_STEP]
        trajectories, controlled = lift(poses[:, :num_agents], start, scene.road.points), controlled[:num_agents]
        return Ranked(scene, trajectories, controlled, self.distance(scene, trajectories, controlled))

    @staticmethod
    def _num_agents(scene: Scene, rows: int) -> int:
        num_agents = int(scene.agents.present.sum())
        if num_agents > rows:
            raise ValueError(
                f"scene {scene.scene_id} has {num_agents} agents and the rollouts have {rows}; rank with the scenes "
                "that the environment was made with."
            )
        return num_agents


def stacked(values: Sequence[Tensor], rows: int) -> Tensor:
    """One tensor of values ``[..., A]`` of several scenes, padded to the agents of the environment."""
    return torch.stack([pad(value, (0, rows - value.shape[-1])) for value in values])
