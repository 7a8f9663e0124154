"""Rollouts scene by scene: of what a collector gives, and of what a preference store holds."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from dpa.models import Decoding, MotionModel
from dpa.preferences import PreferenceStore
from dpa.ranking import agent_spread
from dpa.rollout import lifted, make_collector, simulated_poses
from dpa.tokens import MotionTokenizer
from envs import keys
from envs.episode import EpisodeOptions, make_episode
from envs.scene import Scene, SceneSource
from recipes.common.cli import build


class Rolled(NamedTuple):
    """The rollouts of one scene.

    Attributes:
        index: of the scene in its source.
        scene: uncollated.
        trajectories: ``[K, A, 80, 4]`` x, y, z, heading of the present agents, on the CPU.
        controlled: ``[A]`` bool.
    """

    index: int
    scene: Scene
    trajectories: Tensor
    controlled: Tensor

    @classmethod
    def of(cls, index: int, scene: Scene, trajectories: Tensor) -> Rolled:
        """All agents are controlled."""
        return cls(index, scene, trajectories, torch.ones(trajectories.shape[1], dtype=torch.bool))


def final_spread(scene: Scene, trajectories: Tensor, controlled: Tensor) -> float:
    """How far apart rollouts end, small where sampling is sharp [m] (NaN: no evaluated agent is controlled).

    The mean of :func:`dpa.ranking.agent_spread` over evaluated agents that the policy controls.

    Args:
        scene: uncollated.
        trajectories: ``[K, A, T * F, 4]`` of the present agents.
        controlled: ``[A]`` bool.
    """
    agents = scene.agents
    return agent_spread(trajectories[:, agents.evaluated[agents.present] & controlled]).mean().item()


def rolled(
    batches: Iterable[TensorDictBase], scenes: SceneSource, num_rollouts: int, done: Collection[int] = ()
) -> Iterator[Rolled]:
    """Each scene of a collector's batches, in the order in which they come.

    Args:
        batches: ``[S * K, T]`` each.
        scenes: that ``scene`` in the batches points to.
        num_rollouts: K.
        done: scenes to leave out: a collector rolls them out again where they share a batch with others.
    """
    for batch in batches:
        poses = simulated_poses(batch, num_rollouts).cpu()
        controlled = batch[keys.CONTROLLED][::num_rollouts, 0].cpu()
        for row, index in enumerate(batch[keys.SCENE][::num_rollouts, 0].tolist()):
            if index in done:
                continue
            scene = scenes[index]
            trajectories = lifted(scene, poses[row])
            yield Rolled(index, scene, trajectories, controlled[row, : trajectories.shape[1]])


def waiting(scenes: SceneSource, done: Collection[int]) -> Iterator[tuple[int, Scene]]:
    """The scenes that are not done, with their indices."""
    return ((index, scenes[index]) for index in range(len(scenes)) if index not in done)


def driven_log(scene: Scene, tokenizer: MotionTokenizer | None, options: EpisodeOptions) -> Tensor:
    """The log as a policy would have driven it: by tokens, at the height of the road; others replay as in a rollout.

    Args:
        scene: uncollated.
        tokenizer: of the policy; None: controlled agents keep their logged poses.
        options: of the episode; they say whom the policy moves.

    Returns:
        ``[A, 80, 4]`` x, y, z, heading of the present agents; past the first hole of a log it means nothing.

    Examples:
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2, seed=0)
        >>> sides = [driven_log(scene, tokenizer, EpisodeOptions()) for tokenizer in (VerletTokenizer(), None)]
        >>> 0 < (sides[0] - sides[1]).abs().max() < 0.3
        tensor(True)
    """
    episode = make_episode(scene, options)
    poses = episode.logged
    if tokenizer is not None:
        tracks = tokenizer.encode_tracks(poses, episode.logged_valid, episode.recent, episode.kind)
        poses = torch.where(episode.controlled[:, None, None], tracks.poses, poses)
    return lifted(scene, poses[None])[0]


def logs(
    scenes: SceneSource, options: EpisodeOptions, tokenizer: MotionTokenizer | None, done: Collection[int] = ()
) -> Iterator[Rolled]:
    """The log of every scene; where a tokenizer is given, that of the self-driving car as its tokens have it.

    Args:
        scenes: whose logs these are.
        options: who takes part.
        tokenizer: of the self-driving car.
        done: scenes to leave out.
    """
    for index, scene in waiting(scenes, done):
        yield Rolled.of(index, scene, driven_log(scene, tokenizer, replace(options, control="sdc"))[None])


def driven(
    scenes: SceneSource, model: MotionModel, options: EpisodeOptions, cfg: DictConfig, done: Collection[int] = ()
) -> Iterator[Rolled]:
    """Every scene, driven by a model.

    Args:
        scenes: to roll out.
        model: of the rollouts.
        options: of the episodes.
        cfg: with ``num_rollouts``, ``decoding``, ``seed``, ``memory`` and ``device``.
        done: scenes to leave out.
    """
    batches = make_collector(
        scenes,
        model,
        num_rollouts=cfg.num_rollouts,
        done=frozenset(done),
        decoding=build(Decoding, cfg.decoding, "decoding"),
        options=options,
        seed=cfg.seed,
        memory=cfg.memory,
        device=cfg.device,
    )
    return rolled(batches, scenes, cfg.num_rollouts, done)


def stored(
    store: PreferenceStore, rows: Iterable[int], scenes: SceneSource, model: MotionModel, options: EpisodeOptions
) -> Iterator[Rolled]:
    """Some scenes of a preference store, as they drove: poses follow from tokens, and the log replays the others.

    Args:
        store: of the scenes and of the model.
        rows: positions in the store.
        scenes: that the store is of.
        model: that made its rollouts; only its tokenizer is asked.
        options: of the episodes.
    """
    for row in rows:
        index = int(store.scenes[row])
        scene = scenes[index]
        episode = make_episode(scene, options)
        group = store.read([row], num_agents=len(episode.kind))[0]
        tokens, controlled = group[keys.TOKENS], group[keys.TOKEN_VALID][:, 0]
        recent, kind = (value.expand(len(tokens), *value.shape) for value in (episode.recent, episode.kind))
        decoded = model.tokenizer.decode_tracks(tokens, recent, kind)
        trajectories = lifted(scene, torch.where(controlled[:, None, None], decoded, episode.logged))
        yield Rolled(index, scene, trajectories, controlled[: trajectories.shape[1]])
