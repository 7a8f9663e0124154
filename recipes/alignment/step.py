"""One step of an alignment: what it draws, and what it follows."""

from __future__ import annotations

from collections.abc import Callable

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from dpa.models import MotionModel
from dpa.training.batches import ShuffledOrder, with_tokens
from dpa.training.distributed import ALONE, Ranks
from dpa.training.optim import accumulate_gradients, clip_and_step, make_optimizer, make_schedule
from envs.seeding import make_generator
from recipes.alignment.candidates import Candidates
from recipes.alignment.draws import parts_of


class AlignmentStep:
    """Draws scenes, and pairs of their rollouts, and follows the gradient of the loss over them.

    What a step draws depends on its number and the seed alone, so that a run that goes on draws what it would have
    drawn.

    Args:
        model: to align.
        loss: of a batch; a loss module, or what the ranks wrapped it into.
        candidates: scenes to learn from, with their ranked rollouts.
        options: the section ``alignment``.
        seed: of what is drawn.
        device: of the batches.
        ranks: that pass a step together.

    Attributes:
        optimizer: of the model.
        schedule: of its learning rate.

    Raises:
        ValueError: some scenes have fewer pairs than a step takes and others have more: they do not fit in one batch.
    """

    def __init__(
        self,
        model: MotionModel,
        loss: Callable[[TensorDictBase], TensorDictBase],
        candidates: Candidates,
        options: DictConfig,
        seed: int,
        device: str,
        ranks: Ranks = ALONE,
    ) -> None:
        _check_enough(candidates, options.pairs_per_scene)
        self.loss, self.candidates, self.options = loss, candidates, options
        self.seed, self.device, self.ranks = seed, device, ranks
        self.optimizer = make_optimizer(model, options.lr, options.weight_decay)
        self.schedule = make_schedule(self.optimizer, options.steps, options.warmup)
        self.order = ShuffledOrder(len(candidates), options.scenes_per_step, seed)

    def __call__(self, step: int) -> dict[str, Tensor | float]:
        """Take one step.

        Args:
            step: counted from 0.

        Returns:
            What the loss logs, and ``gradient_norm`` before clipping.
        """
        draw = make_generator(self.seed, "pairs", step)
        groups = with_tokens([self.candidates[i] for i in self.order(step)])
        parts = parts_of(groups, self.options, draw, self.device, self.ranks)
        figures = accumulate_gradients(self.loss, parts, self.ranks)
        return {**figures, "gradient_norm": clip_and_step(self.optimizer, self.options.max_norm, self.schedule)}


def _check_enough(candidates: Candidates, pairs_per_scene: int) -> None:
    counts = candidates.counts
    if len(counts) > 1 and min(counts) < pairs_per_scene:
        raise ValueError(
            f"alignment.pairs_per_scene={pairs_per_scene} and scenes have {min(counts)} to {max(counts)} pairs after "
            f"method.data.margin and rankings_per_scene; say alignment.pairs_per_scene={min(counts)}."
        )
