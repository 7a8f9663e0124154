"""Run: an interrupted training run ends where an uninterrupted one does, bit for bit."""

from __future__ import annotations

import errno
import itertools
from pathlib import Path

import pytest
import torch
from torch import nn

from dpa.training.loggers import read_curve
from dpa.training.optim import clip_and_step, make_optimizer, make_schedule
from dpa.training.run import Run
from dpa.training.seeding import seed_everything
from envs.seeding import make_generator

STEPS = 10


class Interrupted(Exception):
    """Stands for a kill."""


def train(folder: Path, stop_at: int | None = None, total: int = STEPS, interval: int = 2, **config: int) -> Run:
    """A small run with dropout (global generator), per-step generators and a best loss."""
    seed_everything(0)
    net = nn.Sequential(nn.Linear(4, 8), nn.Dropout(0.5), nn.Linear(8, 1))
    optimizer = make_optimizer(net, lr=1e-2, weight_decay=0.1)
    schedule = make_schedule(optimizer, total, warmup_steps=2)
    run = Run(
        folder,
        {"net": net, "optimizer": optimizer, "schedule": schedule},
        config={"width": 8, **config},
        total_steps=total,
        checkpoint_interval=interval,
    )
    run.state.setdefault("best", float("inf"))
    with run:
        for step in run.steps():
            if step == stop_at:
                raise Interrupted
            loss = net(torch.randn(16, 4, generator=make_generator(0, "batch", step))).square().mean()
            loss.backward()
            clip_and_step(optimizer, 1.0, schedule)
            run.state["best"] = min(run.state["best"], loss.item())
            run.log({"train/loss": loss.detach()})
    return run


def weights(run: Run) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in run.parts["net"].parameters()])


def test_two_runs_in_one_folder_are_refused_before_the_second_writes(tmp_path: Path) -> None:
    def run() -> Run:
        return Run(tmp_path, {"net": nn.Linear(1, 1)}, config={}, total_steps=3, checkpoint_interval=1)

    def content() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}

    with run() as first:
        next(steps := first.steps())
        next(steps)
        before = content()
        with pytest.raises(ValueError, match=f"another command is at work in {tmp_path}"):
            run()
        assert content() == before and any("checkpoints" in name for name in before)
    with run() as again:
        assert list(again.steps()) == [1, 2]


def test_a_file_system_without_locks_is_told_and_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("envs.locks.fcntl.flock", refuse)
    assert train(tmp_path).first_step == 0
    assert f"{tmp_path} cannot be locked (No locks available)" in capsys.readouterr().err


@pytest.mark.parametrize("stop_at", [4, 5, 9])
def test_an_interrupted_run_ends_like_an_uninterrupted_one(tmp_path: Path, stop_at: int) -> None:
    whole = train(tmp_path / "whole")
    with pytest.raises(Interrupted):
        train(tmp_path / "parts", stop_at=stop_at)
    torch.manual_seed(99)
    resumed = train(tmp_path / "parts")
    assert resumed.first_step == stop_at // 2 * 2, "it goes on from the last checkpoint, not from the start"
    assert torch.equal(weights(resumed), weights(whole))
    assert resumed.state == whole.state
    for name in ("net", "optimizer", "schedule"):
        mine, theirs = (run.parts[name].state_dict() for run in (resumed, whole))
        assert str(mine) == str(theirs)
    curves = [read_curve(folder, "train/loss") for folder in (tmp_path / "parts", tmp_path / "whole")]
    assert curves[0] == curves[1]
    assert [step for step, _ in curves[0]] == list(range(1, STEPS + 1)), "no step is missing or written twice"


def test_a_run_that_died_before_its_first_checkpoint_starts_over(tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        train(tmp_path / "parts", stop_at=1)
    resumed = train(tmp_path / "parts")
    assert resumed.first_step == 0
    assert torch.equal(weights(resumed), weights(train(tmp_path / "whole")))


def test_a_finished_run_takes_no_further_step(tmp_path: Path) -> None:
    first = train(tmp_path)
    again = train(tmp_path, stop_at=0)
    assert again.first_step == STEPS
    assert torch.equal(weights(again), weights(first)) and again.state == first.state


def test_the_last_step_is_saved_whatever_the_interval(tmp_path: Path) -> None:
    train(tmp_path, total=5, interval=3)
    assert train(tmp_path, total=5, interval=3).first_step == 5


def test_speed_is_logged_with_every_checkpoint(tmp_path: Path) -> None:
    train(tmp_path)
    assert [step for step, _ in read_curve(tmp_path, "time/seconds_per_step")] == [2, 4, 6, 8, 10]


def test_the_time_of_a_step_counts_what_was_done_before_a_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dpa.training.run.time.perf_counter", itertools.count(0, 10).__next__)
    with pytest.raises(Interrupted):
        train(tmp_path, stop_at=5)
    train(tmp_path)
    # The clock is looked at once at the start and once with every second step: ten seconds for two steps.
    assert [value for _, value in read_curve(tmp_path, "time/seconds_per_step")] == [5, 5, 5, 5, 5]


def test_a_run_with_other_options_does_not_go_on_in_the_same_folder(tmp_path: Path) -> None:
    with pytest.raises(Interrupted):
        train(tmp_path, stop_at=5, depth=1)
    with pytest.raises(ValueError, match=r"'depth': 1 there, 2 here"):
        train(tmp_path, depth=2)


def test_an_interval_that_is_not_positive_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="checkpoint_interval must be positive, got 0"):
        train(tmp_path, interval=0)


if __name__ == "__main__":
    pytest.main([__file__])
