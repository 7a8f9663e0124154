"""CAT-K: supervised fine-tuning on states that the policy drives into (Zhang et al., CVPR 2025)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from dpa.losses.network import without_dropout
from dpa.models import Contexts, MotionModel, collate_contexts
from dpa.models.closest import ClosestActor, check_following
from dpa.rollout.job import Subset, make_env
from dpa.tokens import TokenAction
from dpa.training.batches import ShuffledOrder, micro_batches
from dpa.training.distributed import ALONE, Ranks
from dpa.training.optim import accumulate_gradients, clip_and_step, make_optimizer, make_schedule
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import SceneSource


class ClosedLoopStep:
    """Rolls the policy out in some scenes, near their logs, and learns from there the way back.

    What a step draws depends on its number and the seed alone, and its rollouts on the weights too, so that a run that
    goes on does what it would have done.

    Args:
        model: to align.
        loss: of a batch, with ``labels`` and ``learnt``; a loss module, or what the ranks wrapped it into.
        scenes: to learn from.
        episode: options of their episodes.
        follow: ``candidates`` and ``recovery`` of :class:`~dpa.models.closest.ClosestActor`.
        options: the section ``alignment``.
        seed: of the order of scenes.
        device: of rollouts and batches.
        ranks: that pass a step together.

    Attributes:
        optimizer: of the model.
        schedule: of its learning rate.
    """

    def __init__(
        self,
        model: MotionModel,
        loss: Callable[[TensorDictBase], TensorDictBase],
        scenes: SceneSource,
        episode: EpisodeOptions,
        follow: dict[str, float],
        options: DictConfig,
        seed: int,
        device: str,
        ranks: Ranks = ALONE,
    ) -> None:
        self.model, self.loss, self.scenes = model, loss, scenes
        self.contexts = Contexts(scenes, model.featurize, episode)
        check_following(model, **follow)
        self.follow, self.options, self.device, self.ranks = follow, options, device, ranks
        self.optimizer = make_optimizer(model, options.lr, options.weight_decay)
        self.schedule = make_schedule(self.optimizer, options.steps, options.warmup)
        self.order = ShuffledOrder(len(scenes), options.scenes_per_step, seed)

    def __call__(self, step: int) -> dict[str, Tensor | float]:
        """Take one step.

        Args:
            step: counted from 0.

        Returns:
            What the loss logs, ``gradient_norm`` before clipping, and ``followed``: the share of labels that
            are the tokens that were taken.
        """
        indices = self.ranks.mine(self.order(step))
        with without_dropout(self.model):
            followed = self._follow(indices)
        counts = torch.stack([(followed[keys.TOKENS] == followed[keys.LABELS])[followed[keys.LEARNT]].sum(),
                              followed[keys.LEARNT].sum()])  # fmt: skip
        right, learnt = self.ranks.sum(counts).tolist()
        figures = accumulate_gradients(self.loss, self._parts(indices, followed, max(1, learnt)), self.ranks)
        norm = clip_and_step(self.optimizer, self.options.max_norm, self.schedule)
        return {**figures, "gradient_norm": norm, "followed": right / max(1, learnt)}

    def _follow(self, indices: Sequence[int]) -> TensorDict:
        """Tokens, labels, and which of both count: each ``[S, 1, A, T]``."""
        part, options = Subset(self.scenes, indices), self.contexts.options
        env = make_env(part, options, 1, self.device)
        actor = ClosestActor(self.model, _Part(self.contexts, indices), **self.follow)
        rolled = TransformedEnv(env, TokenAction(self.model.tokenizer)).rollout(options.horizon, actor)
        there = rolled[keys.CONTROLLED] & rolled[keys.VALID]
        found = {
            keys.TOKENS: rolled[keys.TOKEN],
            keys.LABELS: rolled[keys.LABEL],
            keys.TOKEN_VALID: there,
            keys.LEARNT: rolled[keys.LABEL_VALID] & there,
        }
        batch = {key: value.transpose(1, 2)[:, None] for key, value in found.items()}
        return TensorDict(batch, batch_size=[len(part)])

    def _parts(self, indices: Sequence[int], followed: TensorDict, learnt: float) -> Iterator[tuple[TensorDict, float]]:
        """Scenes of similar size as batches, each with its share of the labels of all ranks."""
        contexts = [self.contexts[index] for index in indices]
        for rows in micro_batches([len(context.episode.kind) for context in contexts], self.options.max_rows):
            agents = max(len(contexts[row].episode.kind) for row in rows)
            batch = TensorDict(
                {key: value[rows, :, :agents] for key, value in followed.items()}, batch_size=[len(rows)]
            )
            batch["context"] = collate_contexts([contexts[row] for row in rows]).to(self.device)
            yield batch, float(batch[keys.LEARNT].sum()) / learnt


class _Part:
    """Contexts of some scenes, numbered from 0 as the environment numbers them."""

    def __init__(self, contexts: Contexts, indices: Sequence[int]) -> None:
        self.contexts, self.indices = contexts, indices

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, row: int) -> object:
        return self.contexts[self.indices[row]]

    def scene_id(self, row: int) -> str:
        return self.contexts.scene_id(self.indices[row])
