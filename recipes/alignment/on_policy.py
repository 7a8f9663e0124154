"""Steps that learn from rollouts of the policy as it is, drawn and ranked anew each time (RLOO, GRPO, own pairs)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from dpa.policy import ContextOptions, MotionLM, SceneContext
from dpa.policy.actor import Contexts
from dpa.preferences import agent_preference
from dpa.ranking.transform import RankRollouts
from dpa.rewards import advantages, reward_of
from dpa.rollout import RolloutCollector, RolloutJob, RolloutTask, Workers, plan_tasks
from dpa.rollout.collector import agents_of, rows_within
from dpa.training.batches import Item, ShuffledOrder, collate_items, micro_batches, with_tokens
from dpa.training.distributed import ALONE, Ranks
from dpa.training.optim import accumulate_gradients, clip_and_step, make_optimizer, make_schedule
from envs import keys
from envs.scene import SceneSource
from recipes.alignment.candidates import Group, choose_pairs
from recipes.alignment.data import check_data, check_rolling
from recipes.alignment.draws import Draw, make_batch
from recipes.common.cli import build, plain


class Rolled(NamedTuple):
    """What a step has rolled out of one scene.

    Attributes:
        context: uncollated.
        ranked: its group, of batch size ``[]`` and cut to its own A agents.
    """

    context: SceneContext
    ranked: TensorDict

    @property
    def token_valid(self) -> Tensor:
        """``[A, T]`` bool."""
        return self.ranked[keys.TOKEN_VALID]


class OnPolicyStep:
    """Rolls the policy out in some scenes, ranks the rollouts, and learns from them.

    Rollouts come from a :class:`~dpa.rollout.RolloutCollector` with the weights of the moment, ranking is its
    post-processing. What a step draws depends on its number, the seed and the weights alone, so that a run that goes
    on does what it would have done.

    Args:
        model: to align.
        loss: of a batch; a loss module, or what the ranks wrapped it into.
        scenes: to learn from.
        context: how they are cut up.
        data: options of the method, of a kind in :data:`~recipes.alignment.data.ROLLED`.
        options: the section ``alignment``.
        seed: of the order of scenes and of what is drawn.
        device: of rollouts and batches.
        ranks: that pass a step together.

    Attributes:
        optimizer: of the model.
        schedule: of its learning rate.

    Raises:
        ValueError: options that cannot be.
    """

    def __init__(
        self,
        model: MotionLM,
        loss: Callable[[TensorDictBase], TensorDictBase],
        scenes: SceneSource,
        context: ContextOptions,
        data: DictConfig,
        options: DictConfig,
        seed: int,
        device: str,
        ranks: Ranks = ALONE,
    ) -> None:
        self.data, self.options, self.seed = check_data(data, 0), options, seed
        self.loss, self.contexts, self.device, self.ranks = loss, Contexts(scenes, context), device, ranks
        self.passes = data.get("passes", 1)
        self.optimizer = make_optimizer(model, options.lr, options.weight_decay)
        self.schedule = make_schedule(self.optimizer, self.passes * options.steps, self.passes * options.warmup)
        order = ShuffledOrder(len(scenes), options.scenes_per_step, seed)
        steps = [ranks.mine(order(step)) for step in range(options.steps)]
        workers = build(Workers, options.workers, "alignment.workers")
        most = rows_within(options.memory, model, context)
        sizes = [agents_of(scenes, some, context) for some in steps]
        tasks = [tasks_of(step, each, data.num_rollouts, most, workers.count) for step, each in enumerate(sizes)]
        self._ends = list(accumulate(len(each) for each in tasks))
        decoding, distance = check_rolling(data)
        job = RolloutJob(
            scenes,
            model,
            data.num_rollouts,
            decoding=decoding,
            options=context,
            seed=seed,
            make_postproc=partial(Ranked, num_rollouts=data.num_rollouts, distance=distance),
            device=device,
        )
        self.collector = RolloutCollector(job, [task for each in tasks for task in each], workers)
        self._batches: Iterator[TensorDictBase] | None = None

    def __call__(self, step: int) -> dict[str, Tensor | float]:
        """Take one step.

        Args:
            step: counted from 0.

        Returns:
            What the loss logs in the last pass, ``gradient_norm`` before clipping, what the rollouts are like
            (``rollout_distance``, ``rollout_ade`` [m]) and how long they and what is learnt from them take
            (``seconds_rollout``, ``seconds_learning``).
        """
        start = time.perf_counter()
        rolled = self._roll_out(step)
        told, before = self._told(rolled), time.perf_counter()
        for _ in range(self.passes):
            figures = accumulate_gradients(self.loss, self._parts(rolled, step), self.ranks)
            norm = clip_and_step(self.optimizer, self.options.max_norm, self.schedule)
        took = {"seconds_rollout": before - start, "seconds_learning": time.perf_counter() - before}
        return {**figures, "gradient_norm": norm, **told, **took}

    def _roll_out(self, step: int) -> list[Rolled]:
        """The groups of this rank's scenes, by the weights of the moment."""
        last = self._ends[step]
        first = self._ends[step - 1] if step else 0
        if self._batches is None:
            self.collector.load_state_dict({"next": first, "seed": self.seed})
            self._batches = iter(self.collector)
        self.collector.update_policy_weights_()
        groups = [group for _ in range(first, last) for group in next(self._batches)]
        if last == self._ends[-1]:
            self.collector.shutdown()
        return [self._of_scene(group) for group in groups]

    def _of_scene(self, ranked: TensorDictBase) -> Rolled:
        context = self.contexts[int(ranked[keys.SCENE])]
        agents = len(context.kind)
        of_agents = (keys.TOKENS, keys.OLD_LOG_PROB, keys.TOKEN_VALID)
        cut = {key: ranked[key][..., :agents, :] for key in of_agents}
        cut[keys.AGENT_DISTANCE] = ranked[keys.AGENT_DISTANCE][..., :agents]
        return Rolled(context, TensorDict({**cut, **{key: ranked[key] for key in (keys.DISTANCE, keys.ADE)}}))

    def _told(self, rolled: list[Rolled]) -> dict[str, float]:
        """Means over the rollouts of all ranks."""
        named = {"rollout_distance": keys.DISTANCE, "rollout_ade": keys.ADE}
        sums = [sum(float(one.ranked[key].mean()) for one in rolled) for key in named.values()]
        *totals, count = self.ranks.sum(torch.tensor([*sums, len(rolled)], dtype=torch.float64)).tolist()
        return {name: total / count for name, total in zip(named, totals, strict=True)}

    def _parts(self, rolled: list[Rolled], step: int) -> Iterator[tuple[TensorDict, float]]:
        if self.data.kind == "own_groups":
            return self._groups(rolled)
        return self._pairs(rolled, step)

    def _groups(self, rolled: list[Rolled]) -> Iterator[tuple[TensorDict, float]]:
        """Whole groups of scenes of similar size, each part with its share of the tokens of all ranks."""
        weights = plain(self.data.rewards)
        graded = [
            (one, advantages(reward_of(one.ranked[None], weights), baseline=self.data.baseline, scale=self.data.scale))
            for one in with_tokens(rolled)
        ]
        tokens = [int(one.token_valid.sum()) for one, _ in graded]
        total = max(1, int(self.ranks.sum(torch.tensor(sum(tokens)))))
        for part in micro_batches(
            [one.ranked[keys.TOKENS][..., 0].numel() for one, _ in graded], self.options.max_rows
        ):
            yield group_batch([graded[i] for i in part]).to(self.device), sum(tokens[i] for i in part) / total

    def _pairs(self, rolled: list[Rolled], step: int) -> Iterator[tuple[TensorDict, float]]:
        """Pairs of scenes of similar size, each part with its share of the scenes of all ranks that have any."""
        ranked_by = torch.stack([one.ranked[self.data.rank_by] for one in rolled])
        chosen = choose_pairs(self.data, ranked_by, self.seed, step, self.ranks.rank)
        groups = [
            paired(one, near, far, self.data)
            for one, (near, far) in zip(rolled, chosen, strict=True)
            if len(near) and one.token_valid.any()
        ]
        total = max(1, int(self.ranks.sum(torch.tensor(len(groups)))))
        if not groups:  # the other ranks wait for a pass of this one
            near, far = torch.tensor([0]), torch.tensor([1])
            yield make_batch([_all_of(paired(rolled[0], near, far, self.data))]).to(self.device), 0.0
        for part in micro_batches([group.preferred[..., 0].numel() for group in groups], self.options.max_rows):
            yield make_batch([_all_of(groups[i]) for i in part]).to(self.device), len(part) / total


class Ranked(RankRollouts):
    """Ranked groups that know how likely their tokens were when they were drawn, ``[S, K, A, T]`` [nats]."""

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Rank every group: ``[S * K, T]`` -> ``[S]``."""
        groups = super().forward(tensordict)
        likely = tensordict[keys.LOG_PROB].unflatten(0, (-1, self.num_rollouts))
        groups[keys.OLD_LOG_PROB] = likely.movedim(2, -1)
        return groups


def tasks_of(step: int, sizes: dict[int, int], num_rollouts: int, most: int, workers: int = 1) -> list[RolloutTask]:
    """What is rolled out in a step: each has rollouts of other numbers, so that no two steps draw alike.

    Args:
        step: counted from 0.
        sizes: scenes and their agents; one that a step has twice is rolled out once.
        num_rollouts: K.
        most: agents times rollouts that run side by side.
        workers: each of whom is to have a part.

    Examples:
        >>> tasks_of(2, {7: 3}, num_rollouts=4, most=100)
        [RolloutTask(scenes=(7,), pieces=(range(8, 12),))]
    """
    shift, rows = step * num_rollouts, num_rollouts * sum(sizes.values())
    most = min(most, max(1, -(-rows // workers)))
    return [
        replace(task, pieces=tuple(range(piece.start + shift, piece.stop + shift) for piece in task.pieces))
        for task in plan_tasks(sizes, num_rollouts, most)
    ]


def group_batch(graded: Sequence[tuple[Rolled, Tensor]]) -> TensorDict:
    """A batch of whole groups with their advantages, for :class:`~dpa.losses.PolicyGradientLoss`."""
    batch = collate_items([Item(one.context, one.ranked[keys.TOKENS], one.token_valid) for one, _ in graded])
    agents = batch[keys.TOKENS].shape[2]
    del batch[keys.LABELS]

    def padded(value: Tensor) -> Tensor:
        """``[K, A, ...]`` with as many agents as the batch."""
        return F.pad(value, (0, 0, 0, agents - value.shape[1]))

    batch[keys.OLD_LOG_PROB] = torch.stack([padded(one.ranked[keys.OLD_LOG_PROB]) for one, _ in graded])
    each = [advantage[0][..., None].expand(-1, len(one.token_valid), -1) for one, advantage in graded]
    batch[keys.ADVANTAGE] = torch.stack([padded(advantage) for advantage in each])
    return batch


def paired(one: Rolled, near: Tensor, far: Tensor, data: DictConfig) -> Group:
    """Pairs of one scene's rollouts."""
    tokens, say = one.ranked[keys.TOKENS], None
    if data.rank_by == keys.DISTANCE:
        say = agent_preference(one.ranked[keys.AGENT_DISTANCE][None], near[None], far[None])[0]
    return Group(one.context, tokens[near], tokens[far], one.token_valid, say)


def _all_of(group: Group) -> Draw:
    every = torch.arange(len(group.preferred))
    return Draw(group, every, every)
