"""What a worker needs to know, and the worker: one TorchRL collector for each piece of a task."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv

from dpa.models import Contexts, MotionActor, MotionModel
from dpa.models.precision import Precision, check_precision
from dpa.models.sampling import Decoding
from dpa.rollout.plan import RolloutTask
from dpa.tokens import TokenAction
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import Scene, SceneSource
from envs.traffic import TrafficEnv

PostProcess = Callable[[TensorDictBase], TensorDictBase]


class Subset:
    """Some scenes of a source, in the order given: a :class:`~envs.scene.SceneSource` itself. Each is loaded once.

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
        self._loaded: dict[int, Scene] = {}

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> Scene:
        if index not in self._loaded:
            self._loaded[index] = self.scenes[self.indices[index]]
        return self._loaded[index]


@dataclass(frozen=True)
class RolloutJob:
    """Everything that decides rollouts but the task at hand. It travels to the workers.

    Attributes:
        scenes: where scenes come from.
        model: what drives.
        num_rollouts: K.
        decoding: how tokens are drawn.
        options: of the episodes.
        seed: of the sampling.
        make_postproc: makes the post-processing of a task from its scenes, for instance
            :class:`~dpa.ranking.transform.RankRollouts`; applied to the whole rollouts ``[S * K, T]`` of the task.
        device: of environment and policy.
        precision: of the policy's linear layers, see :class:`~dpa.models.MotionActor`.
        compile: what decodes, see :class:`~dpa.models.MotionActor`.
    """

    scenes: SceneSource
    model: MotionModel
    num_rollouts: int
    decoding: Decoding = field(default_factory=Decoding)
    options: EpisodeOptions = field(default_factory=EpisodeOptions)
    seed: int = 0
    make_postproc: Callable[[SceneSource], PostProcess] | None = None
    device: torch.device | str = "cpu"
    precision: Precision = "float32"
    compile: bool = False

    def __post_init__(self) -> None:
        check_precision(self.precision)
        if self.options.horizon > self.model.config.horizon:
            horizon = self.model.config.horizon
            raise ValueError(
                f"episodes of {self.options.horizon} decisions need a policy that was made for as many, and this one "
                f"has horizon={horizon}; give EpisodeOptions(horizon={horizon})."
            )


def make_env(part: Subset, options: EpisodeOptions, num_rollouts: int, device: str) -> TrafficEnv:
    """The environment of some scenes side by side."""
    return TrafficEnv(part, options, num_scenes=len(part), num_rollouts=num_rollouts, device=device)


class RolloutWorker:
    """Rolls tasks out, one after the other.

    Args:
        job: what to do with a task.

    Examples:
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> job = RolloutJob([straight_road(2)], MotionLM("nano", VerletTokenizer()), num_rollouts=4)
        >>> RolloutWorker(job).run(RolloutTask((0,), (range(0, 2), range(2, 4)))).batch_size
        torch.Size([4, 16])
    """

    def __init__(self, job: RolloutJob) -> None:
        self.job = job
        self.model = copy.deepcopy(job.model).to(job.device).eval()  # the caller's may be in training, or elsewhere

    def update(self, weights: Mapping[str, Tensor] | None, seed: int) -> None:
        """Take over other weights (None keeps those at hand) and a seed."""
        if weights is not None:
            self.model.load_state_dict(weights)
        self.job = replace(self.job, seed=seed)

    def run(self, task: RolloutTask) -> TensorDictBase:
        """The rollouts of a task, post-processed; ``scene`` holds indices into the job's source."""
        part = Subset(self.job.scenes, task.scenes)
        contexts = Contexts(part, self.model.featurize, self.job.options)
        pieces = [self._piece(part, contexts, piece) for piece in task.pieces]
        # [S * k, T] each; the rollouts of a scene must be contiguous.
        together = [piece.unflatten(0, (len(part), len(piece) // len(part))) for piece in pieces]
        batch = pieces[0] if len(pieces) == 1 else torch.cat(together, 1).flatten(0, 1)
        if self.job.make_postproc is not None:
            batch = self.job.make_postproc(part)(batch)
        in_source = torch.tensor(task.scenes, device=batch.device)
        for key in (keys.SCENE, ("next", keys.SCENE)):
            if key in batch.keys(include_nested=True):
                batch[key] = in_source[batch[key]]
        return batch

    def _piece(self, part: Subset, contexts: Contexts, piece: range) -> TensorDictBase:
        job, options = self.job, self.job.options
        env = make_env(part, options, len(piece), job.device)
        actor = MotionActor(
            self.model,
            contexts,
            num_rollouts=len(piece),
            decoding=job.decoding,
            seed=job.seed,
            first_rollout=piece.start,
            precision=job.precision,
            compile=job.compile,
        )
        frames = len(part) * len(piece) * options.horizon
        collector = Collector(
            TransformedEnv(env, TokenAction(self.model.tokenizer)),
            actor,
            frames_per_batch=frames,
            total_frames=frames,
            auto_register_policy_transforms=False,
            track_traj_ids=False,
            trust_policy=True,
            use_buffers=False,  # buffers are made by trying the policy out, which costs as much as a decision
            device=job.device,
        )
        try:
            return next(iter(collector))
        finally:
            collector.shutdown()
