"""Steps that learn from rollouts of the policy as it is, drawn and ranked anew each time (RLOO, GRPO, own pairs)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from dpa.models import Contexts, MotionModel
from dpa.models.context import Context
from dpa.preferences import nearest_farthest
from dpa.rewards import REWARDS, RewardRollouts, advantages, check_horizon
from dpa.rollout import RolloutCollector, RolloutJob, RolloutTask, Workers, plan_tasks
from dpa.rollout.collector import agents_of, check_staleness, rows_within
from dpa.training.batches import Item, ShuffledOrder, collate_items, micro_batches, with_tokens
from dpa.training.distributed import ALONE, Ranks
from dpa.training.optim import accumulate_gradients, clip_and_step, make_optimizer, make_schedule
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import SceneSource
from envs.seeding import make_generator
from recipes.alignment.candidates import Chosen, Group, group_of, pair_up
from recipes.alignment.data import check_data, check_rolling, rewards_of
from recipes.alignment.draws import Draw, make_batch
from recipes.common.cli import build

OF_AGENTS = {keys.TOKENS: 1, keys.SAMPLE_LOG_PROB: -2, keys.TOKEN_VALID: -2, keys.AGENT_DISTANCE: -1,
             keys.AGENT_RANKED: -1, keys.AGENT_KIND: -1, keys.SPREAD: -1}  # fmt: skip
"""Entries of a ranked group with one row for each agent, and the dimension of these rows."""


class Rolled(NamedTuple):
    """What a step has rolled out of one scene.

    Attributes:
        scene: index.
        context: uncollated.
        ranked: its group, of batch size ``[]`` and cut to its own A agents, on the CPU.
        staleness: steps that the weights behind it lay behind.
    """

    scene: int
    context: Context
    ranked: TensorDict
    staleness: int

    @property
    def token_valid(self) -> Tensor:
        """``[A, T]`` bool."""
        return self.ranked[keys.TOKEN_VALID]


def check_workers(options: DictConfig, model: MotionModel) -> tuple[Workers, int]:
    """Who rolls out for a method that does so in every step, and agents times rollouts side by side.

    Args:
        options: the section ``alignment``: ``workers``, ``staleness`` and ``memory``.
        model: to align.

    Raises:
        ValueError: options that cannot be.
    """
    workers = build(Workers, options.workers, "alignment.workers")
    check_staleness(options.staleness, workers)
    return workers, rows_within(options.memory, model)


class OnPolicyStep:
    """Rolls the policy out in some scenes, ranks the rollouts, and learns from them.

    Rollouts come from a :class:`~dpa.rollout.RolloutCollector` with the weights of the moment, ranking is its
    post-processing. What a step draws depends on its number, the seed and the weights alone, so that a run that goes
    on does what it would have done, on any number of ranks. A scene that a step has twice counts twice.

    With ``staleness`` workers roll the next steps out while this one learns, by weights that are so many steps old at
    most. How old they are depends on the clock, and so does what is learnt.

    Args:
        model: to align.
        loss: of a batch; a loss module, or what the ranks wrapped it into.
        scenes: to learn from.
        episode: options of their episodes.
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
        model: MotionModel,
        loss: Callable[[TensorDictBase], TensorDictBase],
        scenes: SceneSource,
        episode: EpisodeOptions,
        data: DictConfig,
        options: DictConfig,
        seed: int,
        device: str,
        ranks: Ranks = ALONE,
    ) -> None:
        self.data, self.options, self.seed = check_data(data, 0), options, seed
        self.loss, self.device, self.ranks = loss, device, ranks
        self.contexts = Contexts(scenes, model.featurize, episode)
        self.passes, self.rewards = data.get("passes", 1), rewards_of(data)
        self.tells_likelier = data.kind == "own_groups" and model.distribution.discrete
        self.optimizer = make_optimizer(model, options.lr, options.weight_decay)
        self.schedule = make_schedule(self.optimizer, self.passes * options.steps, self.passes * options.warmup)
        self.order = ShuffledOrder(len(scenes), options.scenes_per_step, seed)
        self.workers, self.most = check_workers(options, model)
        self.sizes = partial(agents_of, scenes, options=episode)
        decoding, distance = check_rolling(data)
        self.ranked_by = "missed" if data.ranking.get("kind") == "realism" else "distance"
        check_horizon(self.rewards, episode.steps)
        paid = {name: REWARDS[name] for name in self.rewards}
        job = RolloutJob(
            scenes,
            model,
            data.num_rollouts,
            decoding=decoding,
            options=episode,
            seed=seed,
            make_postproc=partial(RewardRollouts, num_rollouts=data.num_rollouts, distance=distance, rewards=paid),
            device=device,
        )
        self.collector = RolloutCollector(job, (), self.workers, max_staleness=options.staleness)
        self._batches: Iterator[TensorDictBase] | None = None
        self._tasks: dict[int, int] = {}
        """How many there are of each step whose rollouts are under way."""

    def __call__(self, step: int) -> dict[str, Tensor | float]:
        """Take one step.

        Args:
            step: counted from 0.

        Returns:
            What the loss logs in the last pass, ``gradient_norm`` before clipping, what the rollouts are like
            (``rollout_distance``, or, ranked by realism, ``rollout_missed`` of it; ``rollout_ade`` and
            ``rollout_spread`` [m]; of a policy gradient ``rollout_pair_accuracy``: how often the nearer of a pair of
            them is the likelier one), the rewards
            (``reward_NAME``), the ``staleness`` of their weights [steps], and how long they and what is learnt from
            them take (``seconds_rollout``; of it ``seconds_ranking``, added up over workers; ``seconds_learning``).
        """
        start = time.perf_counter()
        rolled = self._roll_out(step)
        told, before = self._told(rolled), time.perf_counter()
        parts = list(self._groups(rolled) if self.data.kind == "own_groups" else self._pairs(rolled, step))
        for _ in range(self.passes):
            figures = accumulate_gradients(self.loss, parts, self.ranks)
            norm = clip_and_step(self.optimizer, self.options.max_norm, self.schedule)
        took = {"seconds_rollout": before - start, "seconds_learning": time.perf_counter() - before}
        took["seconds_ranking"] = sum(float(one.ranked[keys.RANKED_IN]) for one in rolled)
        return {**figures, "gradient_norm": norm, **told, **took}

    def _roll_out(self, step: int) -> list[Rolled]:
        """The groups of this rank's scenes, by the weights of the moment or, within the bound, of some steps before."""
        if self._batches is None:
            self._batches = iter(self.collector)
        self.collector.update_policy_weights_()
        for ahead in range(step, min(step + self.options.staleness + 1, self.options.steps)):
            self._begin(ahead)
        rolled = {}
        for _ in range(self._tasks.pop(step)):
            groups = next(self._batches)
            rolled |= {each.scene: each for each in map(self._of_scene, groups)}
        if step == self.options.steps - 1:
            self.collector.shutdown()
        return [rolled[scene] for scene in self._scenes(step)]

    def _scenes(self, step: int) -> list[int]:
        return self.ranks.mine(self.order(step))

    def _begin(self, step: int) -> None:
        """Have the scenes of a step rolled out, unless they are."""
        if step not in self._tasks:
            sizes = self.sizes(self._scenes(step))
            tasks = tasks_of(step, sizes, self.data.num_rollouts, self.most, self.workers.count)
            self._tasks[step] = len(tasks)
            self.collector.add(tasks)

    def _of_scene(self, ranked: TensorDictBase) -> Rolled:
        scene, ranked = int(ranked[keys.SCENE]), ranked.cpu()
        context = self.contexts[scene]
        rewards = {(keys.REWARDS, name): -2 for name in self.rewards}
        for key, agents in (OF_AGENTS | rewards).items():
            ranked[key] = ranked[key].narrow(agents, 0, len(context.episode.kind))
        return Rolled(scene, context, ranked, self.collector.staleness)

    def _told(self, rolled: list[Rolled]) -> dict[str, float]:
        """Means over the scenes of all ranks in which somebody was moved."""
        told = [self._told_of(one) for one in with_tokens(rolled)]
        sums = torch.tensor([*(sum(each[name] for each in told) for name in told[0]), len(told)], dtype=torch.float64)
        *totals, count = self.ranks.sum(sums).tolist()
        return {name: total / count for name, total in zip(told[0], totals, strict=True)}

    def _told_of(self, one: Rolled) -> dict[str, float]:
        """What a scene's rollouts are like; rewards are those of whole episodes, means over agents that were moved."""
        ranked, moved = one.ranked, one.token_valid.any(-1)
        each = moved / moved.sum().clamp(min=1)
        paid = {name: ranked[keys.REWARDS, name][..., 0].mean(0) for name in self.rewards}
        return {
            f"rollout_{self.ranked_by}": float(ranked[keys.DISTANCE].mean()),
            "rollout_ade": float(ranked[keys.ADE].mean()),
            "rollout_spread": float((each * ranked[keys.SPREAD]).sum()),
            "staleness": float(one.staleness),
            **({"rollout_pair_accuracy": self._accuracy(one)} if self.tells_likelier else {}),
            **{f"reward_{name}": float((each * value).sum()) for name, value in paid.items()},
        }

    def _accuracy(self, one: Rolled) -> float:
        """How often the nearer rollout of a pair, nearest against farthest quarter, is the likelier one."""
        likely = (one.ranked[keys.SAMPLE_LOG_PROB] * one.token_valid).sum((-1, -2))
        (near,), (far,) = nearest_farthest(one.ranked[keys.DISTANCE][None], max(1, len(likely) // 4))
        return float((likely[near] > likely[far]).float().mean())

    def _groups(self, rolled: list[Rolled]) -> Iterator[tuple[TensorDict, float]]:
        """Rollouts with their advantages, each part with its share of the tokens of all ranks."""
        rolled, rollouts = with_tokens(rolled), self.data.num_rollouts
        graded = [self._graded(one) for one in rolled]
        tokens = [int(one.token_valid.sum()) for one in rolled]
        total = max(1, int(self.ranks.sum(torch.tensor(sum(tokens)))))
        for rows, some in parts_within([len(one.token_valid) for one in rolled], rollouts, self.options.max_rows):
            share = sum(tokens[row] for row in rows) * len(some) / rollouts / total
            yield group_batch([(rolled[row], graded[row]) for row in rows], some).to(self.device), share

    def _graded(self, one: Rolled) -> Tensor:
        """``[K, A, T]``: advantages of a scene's rollouts; of several rewards each is scaled by itself."""
        how = {"baseline": self.data.baseline, "scale": self.data.scale}
        return sum(w * advantages(one.ranked[keys.REWARDS, name][None], **how)[0] for name, w in self.rewards.items())

    def _pairs(self, rolled: list[Rolled], step: int) -> Iterator[tuple[TensorDict, float]]:
        """Pairs of rollouts, each part with its share of those of all ranks."""
        groups = [self._paired(one, step) for one in with_tokens(rolled)]
        counted = sum(bool(group.token_valid.any()) for group in groups)
        total, num = max(1, int(self.ranks.sum(torch.tensor(counted)))), len(groups[0].preferred)
        for rows, some in parts_within([len(group.token_valid) for group in groups], num, self.options.max_rows):
            pairs = torch.arange(some.start, some.stop)
            batch = make_batch([Draw(groups[row], pairs, pairs) for row in rows]).to(self.device)
            yield batch, (counted > 0) * len(rows) * len(some) / num / total

    def _paired(self, one: Rolled, step: int) -> Group:
        """Pairs of one scene's rollouts, as many as of any other."""
        draw = make_generator(self.seed, "random_pairs", step, one.scene)
        near, far = pair_up(self.data, one.ranked[self.data.rank_by][None], draw)
        return group_of(self.data, one.context, one.ranked, Chosen(near[0], far[0]))


def tasks_of(step: int, sizes: dict[int, int], num_rollouts: int, most: int, workers: int = 1) -> list[RolloutTask]:
    """What is rolled out in a step: each has rollouts of other numbers, so that no two steps draw alike.

    Args:
        step: counted from 0.
        sizes: scenes and their agents.
        num_rollouts: K.
        most: agents times rollouts that run side by side.
        workers: that share the scenes of the step, as far as there are as many.

    Examples:
        >>> tasks_of(2, {7: 3}, num_rollouts=4, most=100)
        [RolloutTask(scenes=(7,), pieces=(range(8, 12),))]
        >>> [task.scenes for task in tasks_of(0, {0: 3, 1: 3, 2: 4}, num_rollouts=4, most=100, workers=3)]
        [(0,), (1,), (2,)]
    """
    shift, rows = step * num_rollouts, num_rollouts * sum(sizes.values())
    most = min(most, max(-(-rows // workers), num_rollouts * max(sizes.values())))
    return [
        replace(task, pieces=tuple(range(piece.start + shift, piece.stop + shift) for piece in task.pieces))
        for task in plan_tasks(sizes, num_rollouts, most)
    ]


def parts_within(agents: Sequence[int], rollouts: int, max_rows: int) -> Iterator[tuple[list[int], range]]:
    """Rollouts of scenes that are passed together: those of small scenes side by side, those of large ones in parts.

    Args:
        agents: of each scene.
        rollouts: of each scene.
        max_rows: bound on rollouts times agents; one rollout of a scene may exceed it.

    Returns:
        Scenes, by their place, and which of their rollouts.

    Examples:
        >>> list(parts_within([2, 9, 2], rollouts=4, max_rows=18))
        [([0, 2], range(0, 4)), ([1], range(0, 2)), ([1], range(2, 4))]
    """
    for rows in micro_batches([each * rollouts for each in agents], max_rows):
        most = max(1, max_rows // max(agents[row] for row in rows))
        for first in range(0, rollouts, most):
            yield rows, range(first, min(first + most, rollouts))


def group_batch(graded: Sequence[tuple[Rolled, Tensor]], some: range) -> TensorDict:
    """A batch for :class:`~dpa.losses.PolicyGradientLoss`.

    Args:
        graded: scenes with the advantages ``[K, A, T]`` of all their rollouts.
        some: the rollouts that are in the batch.
    """
    part = slice(some.start, some.stop)
    batch = collate_items([Item(one.context, one.ranked[keys.TOKENS][part], one.token_valid) for one, _ in graded])
    agents = batch[keys.TOKENS].shape[2]

    def padded(value: Tensor) -> Tensor:
        """``[K, A, ...]`` with as many agents as the batch."""
        return F.pad(value, (0, 0, 0, agents - value.shape[1]))

    likely = [padded(one.ranked[keys.SAMPLE_LOG_PROB][part]) for one, _ in graded]
    each = [padded(value[part]) for _, value in graded]
    return batch.update({keys.SAMPLE_LOG_PROB: torch.stack(likely), keys.ADVANTAGE: torch.stack(each)})
