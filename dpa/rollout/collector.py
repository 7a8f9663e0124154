"""The collector: tasks in order, whoever does them, and none lost with a worker."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from heapq import heapify, heappop, heappush
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import BaseCollector

from dpa.models import MotionModel
from dpa.models.precision import Precision
from dpa.models.sampling import Decoding
from dpa.rollout.crew import Crew, Outcome, Workers, hire
from dpa.rollout.job import PostProcess, RolloutJob
from dpa.rollout.plan import GIB, RolloutTask, collected_bytes, plan_tasks
from envs.episode import EpisodeOptions
from envs.participants import num_simulated
from envs.scene import SceneSource

MOST_LOSSES = 3
"""Workers that one task may cost before it is given up."""
AHEAD = 3
"""Tasks for each worker that may be under way or wait for their turn."""


class RolloutCollector(BaseCollector):
    """Whole episodes of all scenes, task by task, in the order of the tasks whoever does them.

    A worker that is killed costs the task that it was at: another one does it again. Weights and seed take effect with
    the next batch that is handed out, also where workers are ahead of it, so every crew gives the same batches. With a
    bound on staleness above 0 workers go on while the caller does, one task each, what they have made is kept, and
    :attr:`staleness` tells how old it is; that depends on the clock.

    Args:
        job: what is rolled out.
        tasks: see :func:`~dpa.rollout.plan.plan_tasks`; :meth:`add` gives more.
        workers: who does it.
        max_staleness: updates of weights or seed since a batch was begun that it may have missed.

    Attributes:
        staleness: updates that the batch that was handed out last has missed.

    Raises:
        ChildProcessError: while iterating, when a task cost :data:`MOST_LOSSES` workers.

    Iterating starts the workers; they end with the last batch, with :meth:`shutdown`, or when the loop is left.
    """

    def __init__(
        self,
        job: RolloutJob,
        tasks: Sequence[RolloutTask] = (),
        workers: Workers | None = None,
        max_staleness: int = 0,
    ) -> None:
        super().__init__()
        self.job, self.workers, self.max_staleness = job, workers or Workers(), max_staleness
        check_staleness(max_staleness, self.workers)
        self._tasks, self._known, self._next, self.staleness = dict(enumerate(tasks)), len(tasks), 0, 0
        self._weights: Mapping[str, Tensor] | None = None
        self._crew: Crew | None = None

    def __len__(self) -> int:
        return self._known

    def add(self, tasks: Sequence[RolloutTask]) -> None:
        """More tasks, after those that are known.

        Examples:
            >>> from dpa.models.motionlm import MotionLM
            >>> from dpa.tokens import VerletTokenizer
            >>> from envs.sources.synthetic import straight_road
            >>> job = RolloutJob([straight_road(2)], MotionLM("nano", VerletTokenizer()), num_rollouts=2)
            >>> collector = RolloutCollector(job)
            >>> batches = iter(collector)
            >>> for first in (0, 2):
            ...     collector.add([RolloutTask((0,), (range(first, first + 2),))])
            ...     next(batches).batch_size
            torch.Size([2, 16])
            torch.Size([2, 16])
        """
        numbers = range(self._known, self._known + len(tasks))
        self._tasks |= dict(zip(numbers, tasks, strict=True))
        self._known += len(tasks)
        if self._crew is not None:
            self._waiting += numbers  # larger than all others, so it stays a heap

    def iterator(self) -> Iterator[TensorDictBase]:
        """Batches of the tasks that are left: what the post-processing makes of ``[S * K, T]``."""
        try:
            self._begin()
            while self._next < self._known:
                if self.pre_collect_hook is not None:
                    self.pre_collect_hook()
                while self._next not in self._made:
                    self._feed()
                    self._take(*self._crew.wait())
                batch, version = self._made.pop(self._next)
                self.staleness = self._version - version
                del self._tasks[self._next]
                self._next += 1
                if self.max_staleness:
                    self._feed()  # who is through goes on while the caller does
                if self.post_collect_hook is not None:
                    self.post_collect_hook(batch)
                yield batch
        finally:
            self.shutdown()

    # --- who does what ----------------------------------------------------------------------------------------------
    def _begin(self) -> None:
        self.shutdown()
        self._crew = hire(self.job, self.workers)
        if self._weights is not None:
            self._crew.update(self._weights, self.job.seed)
        self._waiting = list(range(self._next, self._known))
        self._idle = list(range(self._crew.size))
        self._running: dict[int, tuple[int, int]] = {}
        self._made: dict[int, tuple[TensorDictBase, int]] = {}
        self._lost: Counter[int] = Counter()
        self._version = 0

    def _feed(self) -> None:
        """Give the first tasks that wait to those who have none, not too far ahead of the next batch."""
        last = self._next + AHEAD * self._crew.size
        while self._idle and self._waiting and self._waiting[0] < last:
            worker, number = self._idle.pop(), heappop(self._waiting)
            self._running[worker] = number, self._version
            self._crew.submit(worker, self._tasks[number])

    def _take(self, worker: int, outcome: Outcome) -> None:
        number, version = self._running.pop(worker)
        self._idle.append(worker)
        if outcome.error is not None:
            raise outcome.error
        if outcome.batch is None:
            self._lose(number)
        elif self._is_fresh(version):
            self._made[number] = outcome.batch, version
            return
        heappush(self._waiting, number)

    def _lose(self, number: int) -> None:
        self._lost[number] += 1
        if self._lost[number] == MOST_LOSSES:
            scenes = list(self._tasks[number].scenes)[:5]
            raise ChildProcessError(
                f"{MOST_LOSSES} workers were killed over the scenes {scenes}, perhaps for want of memory; give fewer "
                "workers or a smaller budget."
            )

    def _changed(self) -> None:
        """What was made ahead was made with what held before: where that is too old, it is done again."""
        if self._crew is None:
            return
        self._version += 1
        self._waiting += [number for number, (_, version) in self._made.items() if not self._is_fresh(version)]
        self._made = {number: made for number, made in self._made.items() if self._is_fresh(made[1])}
        heapify(self._waiting)
        self._crew.update(self._weights, self.job.seed)

    def _is_fresh(self, version: int) -> bool:
        return self._version - version <= self.max_staleness

    # --- TorchRL's collectors ---------------------------------------------------------------------------------------
    def update_policy_weights_(
        self,
        policy_or_weights: nn.Module | TensorDictBase | Mapping[str, Tensor] | None = None,
        *,
        weights: TensorDictBase | Mapping[str, Tensor] | None = None,
        policy: nn.Module | None = None,
    ) -> None:
        """Drive with other weights from the next batch on.

        Args:
            policy_or_weights: the model, its weights as a tensordict or by their names in ``state_dict``; by default
                those of the collector's own model, as they are now.

        Keyword Args:
            weights: the same by another name, as other collectors take them.
            policy: likewise.

        Raises:
            ValueError: several of them, or weights that the model does not have or has in another shape.
        """
        told = [each for each in (policy_or_weights, weights, policy) if each is not None]
        if len(told) > 1:
            raise ValueError("say one of policy_or_weights, weights and policy.")
        given = _by_name(told[0] if told else self.job.model)
        known = self.job.model.state_dict()
        if not given.keys() <= known.keys():
            raise ValueError(f"weights {sorted(given.keys() - known.keys())[:3]} are none of the model's.")
        if other := [name for name, value in given.items() if value.shape != known[name].shape]:
            shapes = f"{list(given[other[0]].shape)}, and the model's are {list(known[other[0]].shape)}"
            raise ValueError(f"weights {other[0]} are {shapes}; give those of a model of the same size.")
        self._weights = {name: value.detach().clone() for name, value in (known | given).items()}
        self._changed()

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the rollouts from the next batch on; returns the seed."""
        self.job = replace(self.job, seed=seed)
        self._changed()
        return seed

    def state_dict(self) -> OrderedDict[str, Any]:
        """Where the collector is."""
        return OrderedDict(next=self._next, seed=self.job.seed)

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go forward to where another collector of the same tasks was; iterate anew.

        Raises:
            ValueError: it was at a task that is not known here, or that has been handed out.
        """
        self.shutdown()
        if not self._next <= int(state_dict["next"]) <= self._known:
            raise ValueError(
                f"the collector is at task {self._next} of {self._known} and cannot go to {state_dict['next']}; make a "
                "new one with all tasks."
            )
        self._next = int(state_dict["next"])
        self._tasks = {number: task for number, task in self._tasks.items() if number >= self._next}
        self.job = replace(self.job, seed=int(state_dict["seed"]))

    def shutdown(self, *_: Any, **__: Any) -> None:
        """End the workers."""
        if self._crew is not None:
            self._crew.close()
            self._crew = None


def _by_name(given: nn.Module | TensorDictBase | Mapping[str, Tensor]) -> dict[str, Tensor]:
    if isinstance(given, nn.Module):
        return dict(given.state_dict())
    return given.flatten_keys(".").to_dict() if isinstance(given, TensorDictBase) else dict(given)


def make_collector(
    scenes: SceneSource,
    model: MotionModel,
    *,
    num_rollouts: int,
    indices: Sequence[int] | None = None,
    done: Collection[int] = (),
    decoding: Decoding | None = None,
    options: EpisodeOptions | None = None,
    seed: int = 0,
    make_postproc: Callable[[SceneSource], PostProcess] | None = None,
    workers: Workers | None = None,
    memory: float = 1.0,
    device: torch.device | str = "cpu",
    precision: Precision = "float32",
    compile: bool = False,
) -> RolloutCollector:
    """Roll all scenes out, each K times: a TorchRL collector, in this process, in several, or on a Ray cluster.

    A rollout depends on the scene, its number and the seed. Workers, budget and what is done already change how the
    work is cut up, and not what comes out.

    Args:
        scenes: where scenes come from.
        model: what drives.

    Keyword Args:
        num_rollouts: K.
        indices: scenes to roll out; all by default.
        done: scenes that are not needed.
        decoding: how tokens are drawn.
        options: of the episodes.
        seed: of the sampling.
        make_postproc: makes the post-processing of some scenes' rollouts; it runs in the workers.
        workers: who does it; this process by default.
        memory: budget of each worker for rollouts [GiB]; a crowded scene is rolled out in pieces.
        device: of environment and policy.
        precision: of the policy's linear layers: ``"bfloat16"`` is for GPUs.
        compile: the decoder, which pays for many scenes; see :class:`~dpa.models.MotionActor`.

    Examples:
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> for batch in make_collector([straight_road(2), straight_road(9)], model, num_rollouts=4):
        ...     batch["scene"][:, 0].tolist(), batch["agents", "token"].shape
        ([0, 0, 0, 0], torch.Size([4, 16, 2]))
        ([1, 1, 1, 1], torch.Size([4, 16, 9]))
    """
    if num_rollouts < 1:
        raise ValueError(f"num_rollouts must be 1 or more, got {num_rollouts}.")
    options = options or EpisodeOptions()
    job = RolloutJob(
        scenes,
        model,
        num_rollouts,
        decoding=decoding or Decoding(),
        options=options,
        seed=seed,
        make_postproc=make_postproc,
        device=device,
        precision=precision,
        compile=compile,
    )
    tasks = plan_tasks(agents_of(scenes, indices, options), num_rollouts, rows_within(memory, model), done)
    return RolloutCollector(job, tasks, workers)


def check_staleness(most: int, workers: Workers) -> None:
    """Refuse a bound on staleness below 0, or one above 0 of workers that cannot go on while the caller learns.

    Raises:
        ValueError: it is such.
    """
    if most < 0:
        raise ValueError(f"staleness must be 0 or more, got {most}.")
    if most > 0 and workers.backend == "local":
        raise ValueError(
            f"staleness={most} needs workers that roll out while the caller goes on, got backend=local; "
            "say backend=process, or staleness=0."
        )


def rows_within(memory: float, model: MotionModel) -> int:
    """Agents times rollouts that run side by side within a budget [GiB].

    Raises:
        ValueError: the budget does not hold one agent.
    """
    rows = int(memory * GIB) // (model.bytes_per_row() + collected_bytes(model.config.horizon, model.tokenizer.steps))
    if rows < 1:
        raise ValueError(f"memory must hold at least one agent, got {memory} GiB; give 0.1 or more.")
    return rows


def agents_of(scenes: SceneSource, indices: Sequence[int] | None, options: EpisodeOptions) -> dict[int, int]:
    """Simulated agents of some scenes (all by default) by index; without arrivals a store knows them by itself."""
    wanted = range(len(scenes)) if indices is None else indices
    known = None if options.arrivals else getattr(scenes, "num_agents", None)
    if known is not None:
        return {i: int(known[i]) for i in wanted}
    return {i: num_simulated(scenes[i], **options.cast) for i in wanted}
