"""Rollouts by TorchRL collectors, in groups of K per scene."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from dpa.policy.actor import Contexts, MotionActor
from dpa.policy.context import ContextOptions
from dpa.policy.motionlm import MotionLM
from dpa.tokens import TokenAction
from dpa.training.batches import micro_batches
from envs import keys
from envs.geometry.ground import lift
from envs.scene import CURRENT_STEP, Scene, SceneSource
from envs.seeding import derive_seed
from envs.traffic import TrafficEnv, largest_scene


@dataclass(frozen=True)
class Decoding:
    """How tokens are drawn.

    Attributes:
        top_p: nucleus; 1 draws from the whole distribution.
        temperature: divides the logits.
    """

    top_p: float = 0.95
    temperature: float = 1.0


class Subset:
    """Some scenes of a source, in the order given: a :class:`~envs.scene.SceneSource` itself.

    Args:
        scenes: the whole source.
        indices: positions in it.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> Subset([straight_road(1), straight_road(2)], [1])[0].scene_id
        'straight_road_2_None'
    """

    def __init__(self, scenes: SceneSource, indices: Sequence[int]) -> None:
        self.scenes, self.indices = scenes, list(indices)

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> Scene:
        return self.scenes[self.indices[index]]


def make_collector(
    scenes: SceneSource,
    model: MotionLM,
    *,
    num_rollouts: int,
    num_scenes: int = 1,
    decoding: Decoding | None = None,
    options: ContextOptions | None = None,
    seed: int = 0,
    postproc: Callable[[TensorDictBase], TensorDictBase] | None = None,
    device: torch.device | str = "cpu",
) -> Collector:
    """A collector that takes the scenes in turn, ``num_scenes`` at a time, and yields whole episodes ``[S * K, T]``.

    Args:
        scenes: where scenes come from; when S does not divide their number, the last batch goes on with the first ones.
        model: what drives.

    Keyword Args:
        num_rollouts: K.
        num_scenes: S.
        decoding: how tokens are drawn.
        options: how scenes are cut up; also the horizon and the controlled agents.
        seed: of the sampling.
        postproc: applied to every batch, for instance :class:`~dpa.ranking.RankRollouts`.
        device: of environment and policy.

    Examples:
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> collector = make_collector([straight_road(2)], model, num_rollouts=4)
        >>> next(iter(collector))["agents", "token"].shape
        torch.Size([4, 16, 2])
        >>> collector.shutdown()
    """
    decoding, options = decoding or Decoding(), options or ContextOptions()
    env = TrafficEnv(
        scenes,
        num_scenes=num_scenes,
        num_rollouts=num_rollouts,
        num_agents=largest_scene(scenes),
        max_controlled=options.max_controlled,
        decision_steps=options.decision_steps,
        horizon=options.horizon,
        device=device,
    )
    actor = MotionActor(
        model.eval(),
        Contexts(scenes, options),
        num_rollouts=num_rollouts,
        top_p=decoding.top_p,
        temperature=decoding.temperature,
        seed=seed,
    )
    frames = num_scenes * num_rollouts * options.horizon
    return Collector(
        TransformedEnv(env, TokenAction(model.tokenizer)),
        actor,
        frames_per_batch=frames,
        total_frames=frames * -(-len(scenes) // num_scenes),
        # The environment turns to its next scenes by itself at the end of an episode, so no further reset is needed.
        reset_at_each_iter=False,
        auto_register_policy_transforms=False,
        track_traj_ids=False,
        trust_policy=True,
        postproc=postproc,
        device=device,
    )


def groups_by_size(scenes: SceneSource, indices: Sequence[int], max_rows: int, num_rollouts: int) -> list[list[int]]:
    """Group scenes of similar size, so that little is padded and a batch stays within ``max_rows`` agent rows (B * A).

    Args:
        scenes: all scenes.
        indices: those to group.
        max_rows: bound on the rollouts' agents of a batch; a single scene may exceed it.
        num_rollouts: K.
    """
    counts = getattr(scenes, "num_agents", None)
    size = {i: int(counts[i] if counts is not None else scenes[i].agents.present.sum()) for i in indices}
    ordered = list(indices)
    parts = micro_batches([size[index] * num_rollouts for index in ordered], max_rows)
    return [[ordered[position] for position in part] for part in parts]


def collect_groups(
    scenes: SceneSource,
    model: MotionLM,
    indices: Sequence[int],
    *,
    num_rollouts: int,
    done: Collection[int] = (),
    decoding: Decoding | None = None,
    options: ContextOptions | None = None,
    seed: int = 0,
    make_postproc: Callable[[SceneSource], Callable[[TensorDictBase], TensorDictBase]] | None = None,
    max_rows: int = 4096,
    device: torch.device | str = "cpu",
) -> Iterator[TensorDict]:
    """Roll out scenes group by group, each group in one collector batch.

    The groups depend on ``indices`` and a group's seed on its scenes, so what is left of an interrupted collection
    comes out as it would have: ask for the same indices again, with those that are ``done``.

    Args:
        scenes: all scenes.
        model: what drives.
        indices: scenes to roll out.
        num_rollouts: K.
        done: scenes that are not needed; a group is left out when all its scenes are.
        decoding: how tokens are drawn.
        options: how scenes are cut up.
        seed: of the sampling.
        make_postproc: makes a group's post-processing from its scenes.
        max_rows: see :func:`groups_by_size`.
        device: of environment and policy.

    Yields:
        What the collector gives for each group; ``scene`` holds indices into ``scenes``.
    """
    for group in groups_by_size(scenes, indices, max_rows, num_rollouts):
        if all(index in done for index in group):
            continue
        part = Subset(scenes, group)
        collector = make_collector(
            part,
            model,
            num_rollouts=num_rollouts,
            num_scenes=len(group),
            decoding=decoding,
            options=options,
            seed=derive_seed(seed, *group),
            postproc=None if make_postproc is None else make_postproc(part),
            device=device,
        )
        try:
            batch = next(iter(collector))
        finally:
            collector.shutdown()
        batch[keys.SCENE] = torch.tensor(group, device=batch.device)[batch[keys.SCENE]]
        yield batch


def simulated_poses(rollouts: TensorDictBase, num_rollouts: int) -> Tensor:
    """Poses at 10 Hz of a collector's batch.

    Args:
        rollouts: ``[S * K, T]``.
        num_rollouts: K.

    Returns:
        ``[S, K, A, T * F, 3]`` in each scene's frame.
    """
    decisions = rollouts["next", *keys.RECENT][..., 1:, :]
    return decisions.movedim(1, 2).flatten(2, 3).unflatten(0, (-1, num_rollouts))


def lifted(scene: Scene, poses: Tensor) -> Tensor:
    """Give rollouts of one scene the height of its road.

    Args:
        scene: uncollated.
        poses: ``[K, A', T * F, 3]``, rows beyond the scene's present agents are dropped.

    Returns:
        ``[K, A, T * F, 4]`` x, y, z, heading.
    """
    present = scene.agents.present
    return lift(poses[:, : int(present.sum())], scene.agents.position[present, CURRENT_STEP], scene.road.points)
