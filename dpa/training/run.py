"""One training run in one folder: resumes by itself, shows its progress, keeps its curves and checkpoints."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

from dpa.training.checkpoint import Checkpointer, Stateful, capture, restore
from dpa.training.distributed import ALONE, Ranks
from dpa.training.loggers import Backend, make_logger, read_curve
from envs.locks import alone_in
from envs.options import differences
from envs.progress import progress

SECONDS = "time/seconds_per_step"
"""Curve of what a step takes [s], the mean from the first one on."""


def seconds_trained(folder: Path) -> float:
    """What the steps of a training run took [s], whichever processes made them.

    Raises:
        FileNotFoundError: the folder has no curve of it.
    """
    steps, seconds_per_step = read_curve(folder, SECONDS)[-1]
    return steps * seconds_per_step


def _refuse_other_options(folder: Path, config: Mapping[str, Any]) -> None:
    """A run that was killed before its first checkpoint is a run too: its folder is not for other options."""
    written, policy = folder / "config.json", folder / "policy.pt"
    if not written.is_file():
        if policy.is_file():
            raise ValueError(f"{policy} was not trained there; name another output folder, or remove it.")
        return
    try:
        there = dict(json.loads(written.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{written} is damaged ({error}); remove {folder} and run again.") from None
    differ = differences(there, config)
    if differ:
        raise ValueError(
            f"{folder} holds a run with other options ({differ}); name another output folder, or remove it."
        )


class Run:
    """The frame of a training loop that the recipe itself writes.

    Args:
        folder: of the run; checkpoints and curves live here.
        parts: what training changes: network, optimiser, schedule.

    Keyword Args:
        config: all that decides the run, compared on resume.
        total_steps: updates of the whole run.
        checkpoint_interval: updates between two checkpoints: what a kill can cost at most.
        backend: where curves go beside CSV.
        mode: of Weights & Biases.
        description: of the progress bar.
        ranks: that train together, each with its own ``Run``. All go on from the same checkpoint, and the main one
            alone writes files and shows progress.

    The folder is locked from here to the end of ``with run``, in which results are written too.

    Raises:
        ValueError: the folder holds a run with other options, another process trains there, or ranks do not see the
            same folder.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> net = torch.nn.Linear(1, 1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with Run(folder, {"net": net}, config={}, total_steps=3, checkpoint_interval=2) as run:
        ...         for step in run.steps():
        ...             run.log({"train/loss": step})
        ...     with Run(folder, {"net": net}, config={}, total_steps=3, checkpoint_interval=2) as again:
        ...         list(again.steps())  # nothing is left to do
        []
    """

    def __init__(
        self,
        folder: str | Path,
        parts: Mapping[str, Stateful],
        *,
        config: Mapping[str, Any],
        total_steps: int,
        checkpoint_interval: int,
        backend: Backend = "csv",
        mode: Literal["online", "offline"] = "offline",
        description: str = "train",
        ranks: Ranks = ALONE,
    ) -> None:
        if checkpoint_interval < 1:
            raise ValueError(f"checkpoint_interval must be positive, got {checkpoint_interval}.")
        self.folder, self.parts = Path(folder), parts
        self.total_steps, self.checkpoint_interval = total_steps, checkpoint_interval
        self.description, self.ranks = description, ranks
        self.state: dict[str, Any] = {}
        """Plain values that are kept in every checkpoint, for the recipe's own use."""
        self._spent = 0.0
        self._checkpoints = Checkpointer(self.folder / "checkpoints", config=config)
        with ExitStack() as held:
            if ranks.main:
                held.enter_context(alone_in(self.folder))
            _refuse_other_options(self.folder, config)
            saved = self._checkpoints.latest()
            if saved is not None:
                restore(saved, parts)
                self.state, self._spent = dict(saved["progress"]["recipe"]), saved["progress"]["seconds"]
            step = None if saved is None else saved["step"]
            self.first_step = self._step = ranks.agree(step or 0, "a checkpoint of step", self.folder)
            self._logger = None
            if ranks.main:
                self._logger = make_logger(backend, self.folder, config, resume_step=step, mode=mode)
            self._held = held.pop_all()

    def steps(self) -> Iterator[int]:
        """Steps that are left, counted from 0; saves a checkpoint after every interval and after the last one.

        :data:`SECONDS` counts what earlier processes took for the steps that this one goes on from.
        """
        start = time.perf_counter() - self._spent
        with progress(
            total=self.total_steps,
            description=self.description,
            initial=self.first_step,
            unit="step",
            disable=not self.ranks.main,
        ) as bar:
            for step in range(self.first_step, self.total_steps):
                self._step = step + 1
                yield step
                bar.update()
                done = step + 1
                if done % self.checkpoint_interval == 0 or done == self.total_steps:
                    seconds = time.perf_counter() - start
                    self.log({SECONDS: seconds / done})
                    if self.ranks.main:
                        progressed = {"recipe": self.state, "seconds": seconds}
                        self._checkpoints.save(done, capture(self.parts, progress=progressed))

    def log(self, metrics: Mapping[str, Any], step: int | None = None) -> None:
        """Write numbers, as ``"<group>/<name>"``, on the main rank only.

        Args:
            metrics: numbers, or tensors of one element.
            step: updates that were made before; by default with the one at hand.
        """
        if self._logger is not None:
            self._logger.log(metrics, self._step if step is None else step)

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *_: object) -> None:
        with self._held:
            if self._logger is not None:
                self._logger.close()
