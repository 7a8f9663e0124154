"""A crew of Ray actors: workers on any machine of a cluster."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dpa.rollout.crew import Outcome, Workers
from dpa.rollout.job import RolloutJob, RolloutWorker
from dpa.rollout.plan import RolloutTask
from envs.allocator import keep_freed_memory
from envs.progress import message

PATIENCE = 60.0
"""Seconds without an answer after which the state of the cluster is told."""


class RayCrew:
    """Ray actors, each with its threads of CPU and, where the job runs on ``cuda``, a GPU of its own.

    A cluster that runs already is used (``address``, or that of the session at hand); otherwise one is started here.

    Args:
        job: what they do. Scenes must be at the same path on every machine.
        workers: how many.
    """

    def __init__(self, job: RolloutJob, workers: Workers) -> None:
        import ray  # an extra, which Workers has looked for

        self._ray = ray
        if not self._ray.is_initialized():
            self._ray.init(address=workers.address, include_dashboard=False, log_to_driver=False, logging_level="error")
        self.size = workers.count
        device = torch.device(job.device).type  # without an index: Ray shows a worker its own GPU as the only one
        needs = {"num_cpus": workers.threads, "num_gpus": int(device == "cuda")}
        self._needs = f"{needs['num_cpus']} CPUs and {needs['num_gpus']} GPUs"
        self._hire = self._ray.remote(**needs, max_restarts=0)(_Hand).remote
        self._threads = workers.threads
        self._job = self._ray.put(replace(job, model=copy.deepcopy(job.model).cpu(), device=device))
        self._latest: tuple[Any, int] = (None, job.seed)
        self._hands = [self._start() for _ in range(self.size)]
        self._told = [self._tell(hand) for hand in self._hands]
        self._running: dict[Any, int] = {}

    def submit(self, worker: int, task: RolloutTask) -> None:
        """See :class:`~dpa.rollout.crew.Crew`."""
        self._running[self._hands[worker].run.remote(task)] = worker

    def wait(self) -> tuple[int, Outcome]:
        """See :class:`~dpa.rollout.crew.Crew`."""
        ready = self._ready()
        worker = self._running.pop(ready)
        try:
            _, batch = self._ray.get([self._told[worker], ready])  # weights that could not be loaded are told as well
            return worker, Outcome(batch)
        except self._ray.exceptions.RayTaskError as error:
            return worker, Outcome(error=error.cause)
        except self._ray.exceptions.RayActorError as error:
            if getattr(error, "actor_init_failed", False):
                told = f"a Ray worker could not start: {str(error).strip().splitlines()[-1]}"
                return worker, Outcome(error=ChildProcessError(told))
            return self._lost(worker)
        except self._ray.exceptions.OutOfMemoryError:
            return self._lost(worker)

    def _lost(self, worker: int) -> tuple[int, Outcome]:
        self._hands[worker] = self._start()
        self._told[worker] = self._tell(self._hands[worker])
        return worker, Outcome()

    def _ready(self) -> Any:
        """The next task that is done. A cluster that lacks what the workers need lets them wait without a word."""
        while True:
            ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=PATIENCE)
            if ready:
                return ready[0]
            free, have = self._ray.available_resources(), self._ray.cluster_resources()
            told = ", ".join(f"{free.get(kind, 0):g} of {have.get(kind, 0):g} {kind}s free" for kind in ("CPU", "GPU"))
            message(
                f"no Ray worker has answered for {PATIENCE:g} s: the cluster has {told}, a worker needs {self._needs}."
            )

    def update(self, weights: Mapping[str, Tensor] | None, seed: int) -> None:
        """See :class:`~dpa.rollout.crew.Crew`."""
        kept = (
            self._latest[0]
            if weights is None
            else self._ray.put({name: value.cpu() for name, value in weights.items()})
        )
        self._latest = (kept, seed)
        self._told = [self._tell(hand) for hand in self._hands]

    def close(self) -> None:
        """See :class:`~dpa.rollout.crew.Crew`; the cluster stays."""
        for hand in self._hands:
            self._ray.kill(hand)

    def _start(self) -> Any:
        return self._hire(self._job, self._threads)

    def _tell(self, hand: Any) -> Any:
        return hand.update.remote(*self._latest)


class _Hand:
    """The actor."""

    def __init__(self, job: RolloutJob, threads: int) -> None:
        torch.set_num_threads(threads)
        keep_freed_memory()
        self._worker = RolloutWorker(job)

    def update(self, weights: Mapping[str, Tensor] | None, seed: int) -> None:
        self._worker.update(weights, seed)

    def run(self, task: RolloutTask) -> TensorDictBase:
        return self._worker.run(task).cpu()
