"""The stages of a study, one after the other, and the account of what each took."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from recipes.cli import write_json
from recipes.pool import Job, Workers


class Stages:
    """Runs stages and keeps how long each job took when it was done for the first time.

    Several experiments share an account, as they share what the jobs make: reading a result back costs nothing in it.
    Seconds are those of one worker. What a kill cut short is not in the account, only what was left to do afterwards.

    Args:
        workers: that run the jobs.
        path: of the account, a JSON ``{stage: {job: seconds}}``.
    """

    def __init__(self, workers: Workers, path: Path) -> None:
        self.workers, self.path = workers, path
        self.account = read_account(path)

    def run(self, name: str, job: Callable[..., None], config: Any, arguments: Sequence[tuple]) -> None:
        """Run one job for each tuple of arguments.

        Args:
            name: of the stage.
            job: of a module, so that a worker can import it.
            config: its first argument, the same for all jobs.
            arguments: the others; they name the job.
        """
        if not arguments:
            return
        jobs = [Job(job, (config, *each), " ".join(map(str, (name, *each)))) for each in arguments]
        kept = self.account.setdefault(name, {})
        for done, seconds in self.workers.run(jobs, name):
            if done not in kept:
                kept[done] = seconds
                write_json(self.path, self.account)

    @property
    def seconds(self) -> dict[str, float]:
        """Worker-seconds of each stage."""
        return {name: sum(jobs.values()) for name, jobs in self.account.items()}


def read_account(path: Path) -> dict[str, dict[str, float]]:
    """``{stage: {job: seconds}}``, empty where nothing has run yet."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
