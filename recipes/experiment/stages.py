"""The stages of a study, one after the other, and the account of what each took and what made it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dpa.report.experiment import read_json
from envs.files import write_json
from recipes.common.provenance import merged
from recipes.experiment.pool import Job, Workers


class Stages:
    """Runs stages and keeps how long each job took when it was done for the first time, and by what code and machine.

    Several experiments share an account, as they share what the jobs make: reading a result back costs nothing in it.
    Seconds are those of one worker. Of training they count all steps; of other jobs that a kill or an error beside them
    cut short only what was left to do afterwards.

    Args:
        workers: that run the jobs.
        path: of the account, a JSON ``{stage: {job: seconds}}``; beside it stands ``origins.json``, ``{"made": [...],
            "jobs": {stage: {job: place in made}}}``.
        made: :func:`~recipes.common.provenance.provenance` of the jobs that run now.
    """

    def __init__(self, workers: Workers, path: Path, made: Mapping[str, Any]) -> None:
        self.workers, self.path, self._made = workers, path, made
        self.account = read_account(path)
        self._origins_path = origins_beside(path)
        self._origins = read_json(self._origins_path) if self._origins_path.is_file() else {"made": [], "jobs": {}}
        self._asked: dict[str, set[str]] = {}

    def run(
        self, name: str, job: Callable[..., dict[str, float] | None], config: Any, arguments: Sequence[tuple]
    ) -> None:
        """Run one job for each tuple of arguments.

        Args:
            name: of the stage.
            job: of a module, so that a worker can import it. It may give seconds that it spent, by stage; the
                clock tells the rest.
            config: its first argument, the same for all jobs.
            arguments: the others; they name the job.
        """
        if not arguments:
            return
        jobs = [Job(job, (config, *each), " ".join(map(str, (name, *each)))) for each in arguments]
        for done, seconds, others in self.workers.run(jobs, name):
            spent = {name: seconds - sum((others or {}).values())} | (others or {})
            for stage, part in spent.items():
                self._book(stage, done, part)

    def _book(self, stage: str, job: str, seconds: float) -> None:
        self._asked.setdefault(stage, set()).add(job)
        kept = self.account.setdefault(stage, {})
        if job not in kept:
            self._sign(stage, job)
            kept[job] = seconds
            write_json(self.path, self.account)

    def _sign(self, stage: str, job: str) -> None:
        made = self._origins["made"]
        if self._made not in made:
            made.append(dict(self._made))
        self._origins["jobs"].setdefault(stage, {})[job] = made.index(self._made)
        write_json(self._origins_path, self._origins)

    @property
    def seconds(self) -> dict[str, float]:
        """Worker-seconds of each stage, of the jobs that were asked for here."""
        return {name: sum(self.account[name][job] for job in sorted(jobs)) for name, jobs in self._asked.items()}

    @property
    def made(self) -> dict[str, Any]:
        """What made the jobs that were asked for here, see :func:`~recipes.common.provenance.merged`."""
        unsigned = {**self._made, "versions": {}, "revision": "unknown", "machine": "unknown"}
        made, jobs = [*self._origins["made"], unsigned], self._origins["jobs"]
        asked = [(stage, job) for stage, each in self._asked.items() for job in sorted(each)]
        return merged([made[jobs.get(stage, {}).get(job, -1)] for stage, job in asked])


def origins_beside(path: Path) -> Path:
    """What made the jobs of an account."""
    return path.with_name("origins.json")


def read_account(path: Path) -> dict[str, dict[str, float]]:
    """``{stage: {job: seconds}}``, empty where nothing has run yet."""
    return read_json(path) if path.is_file() else {}
