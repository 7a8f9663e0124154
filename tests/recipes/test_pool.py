"""Jobs of an experiment in worker processes: errors, stops and kills lose nothing and hide nothing."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from recipes.experiment.pool import Job, Workers


@pytest.fixture(scope="module")
def two() -> Iterator[Workers]:
    """Two workers that have started; each of them imports torch, so tests share them."""
    with Workers(2, threads=1) as workers:
        list(workers.run([Job(time.sleep, (0,), "start")] * 4, "warm"))
        yield workers


def made_in(folder: Path) -> list[Job]:
    """Twenty jobs that leave a trace of themselves."""
    folder.mkdir()
    return [Job(os.mkdir, (str(folder / str(number)),), str(number)) for number in range(20)]


def test_jobs_run_here_one_after_the_other() -> None:
    ran: list[int] = []
    with Workers(1, threads=1) as workers:
        ended = list(workers.run([Job(ran.append, (number,), f"job {number}") for number in range(3)], "jobs"))
    assert ran == [0, 1, 2]
    assert [name for name, *_ in ended] == ["job 0", "job 1", "job 2"] and all(seconds >= 0 for _, seconds, _ in ended)


def test_the_error_of_a_job_is_the_error_of_all_and_the_workers_go_on(two: Workers) -> None:
    with pytest.raises(ValueError, match="Expecting property name"):
        list(two.run([Job(json.loads, ("{",), "bad")], "jobs"))
    ((name, _, result),) = two.run([Job(json.loads, ("{}",), "good")], "jobs")
    assert (name, result) == ("good", {})


def test_jobs_under_way_beside_one_that_fails_are_not_lost_and_no_other_is_begun(
    two: Workers, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad, slow, ended = Job(json.loads, ("{",), "bad"), Job(time.sleep, (2,), "slow"), []
    with pytest.raises(ValueError, match="Expecting property name"):
        ended += (name for name, *_ in two.run([slow, bad, *made_in(tmp_path / "made")], "jobs"))
    assert ended == ["slow"] and not list((tmp_path / "made").iterdir())
    assert "bad: Expecting property name" in capsys.readouterr().err, "told at once"


def test_workers_that_are_told_to_stop_begin_no_job(two: Workers, tmp_path: Path) -> None:
    slow = Job(time.sleep, (1,), "slow")
    next(two.run([slow, slow, *made_in(tmp_path / "made")], "jobs"))
    list(two.run([slow, slow], "after"))  # begins when whatever waited before has ended
    assert len(list((tmp_path / "made").iterdir())) <= 1


@pytest.mark.slow
def test_workers_share_the_gpus_that_the_command_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    seen = []
    for spread in (True, False):
        with Workers(2, threads=1, spread=spread) as workers:
            jobs = [Job(os.getenv, ("CUDA_VISIBLE_DEVICES",), str(number)) for number in range(8)]
            seen.append({result for _, _, result in workers.run(jobs, "jobs")})
    assert seen[0] and seen[0] <= {"3", "5"} and seen[1] == {"3,5"}


def test_a_killed_worker_is_told_with_what_to_do() -> None:
    with Workers(2, threads=1) as workers, pytest.raises(ChildProcessError, match="'jobs' was killed.*workers=1"):
        list(workers.run([Job(os._exit, (1,), "dies")], "jobs"))


def test_a_number_of_workers_that_is_not_positive_is_refused() -> None:
    with pytest.raises(ValueError, match="workers must be 1 or more, got 0"):
        Workers(0, threads=1)


if __name__ == "__main__":
    pytest.main([__file__])
