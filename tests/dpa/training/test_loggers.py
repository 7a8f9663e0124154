"""Curves: layout on disk, resume without repeated steps, and the further backends."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest
import torch

from dpa.training.loggers import make_logger, read_curve


def write(folder: Path, steps: range, resume_step: int | None = None, backend: str = "csv") -> None:
    logger = make_logger(backend, folder, {"lr": 0.1}, resume_step=resume_step)
    for step in steps:
        logger.log({"train/loss": torch.tensor(step / 2), "eval/realism": 1}, step)
    logger.close()


def test_each_metric_is_one_file_of_steps_and_values(tmp_path: Path) -> None:
    write(tmp_path, range(2))
    assert (tmp_path / "scalars" / "train" / "loss.csv").read_text() == "0,0.0\n1,0.5\n"
    assert json.loads((tmp_path / "config.json").read_text()) == {"lr": 0.1}


def test_the_layout_is_that_of_torchrl(tmp_path: Path) -> None:
    from torchrl.record.loggers.csv import CSVLogger

    theirs = CSVLogger("theirs", log_dir=str(tmp_path))
    for step in range(2):
        theirs.log_scalar("train/loss", step / 2, step=step)
    write(tmp_path / "ours", range(2))
    curve = Path("scalars", "train", "loss.csv")
    assert (tmp_path / "ours" / curve).read_text() == (tmp_path / "theirs" / curve).read_text()


def test_a_resumed_run_has_every_step_once(tmp_path: Path) -> None:
    write(tmp_path, range(6))
    write(tmp_path, range(4, 8), resume_step=3)
    assert read_curve(tmp_path, "train/loss") == [(step, step / 2) for step in range(8)]


def test_a_row_cut_short_by_a_crash_is_dropped(tmp_path: Path) -> None:
    write(tmp_path, range(3))
    with (tmp_path / "scalars" / "train" / "loss.csv").open("a") as file:
        file.write("3,1.")
    assert read_curve(tmp_path, "train/loss")[-1] == (2, 1.0)
    write(tmp_path, range(3, 5), resume_step=3)
    assert [step for step, _ in read_curve(tmp_path, "train/loss")] == [0, 1, 2, 3, 4]


def test_a_new_run_in_an_old_folder_starts_with_empty_curves(tmp_path: Path) -> None:
    write(tmp_path, range(6))
    write(tmp_path, range(1))
    assert read_curve(tmp_path, "train/loss") == [(0, 0.0)]


def test_an_unknown_curve_is_refused_naming_those_there_are(tmp_path: Path) -> None:
    write(tmp_path, range(1))
    with pytest.raises(FileNotFoundError, match="it has eval/realism, train/loss"):
        read_curve(tmp_path, "train/lsos")


def test_a_value_that_is_no_number_is_refused(tmp_path: Path) -> None:
    logger = make_logger("csv", tmp_path, {})
    with pytest.raises(ValueError, match=r"'loss': \(2,\)"):
        logger.log({"loss": torch.zeros(2)}, 0)


def test_an_unknown_backend_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="csv, wandb or tensorboard, got 'mlflow'"):
        make_logger("mlflow", tmp_path, {})


@pytest.mark.parametrize("backend", ["wandb", "tensorboard"])
def test_a_missing_package_is_named_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, backend: str
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=f"needs the package '{backend}'.*logger.backend=csv"):
        make_logger(backend, tmp_path, {})
    assert not list(tmp_path.iterdir())


def test_tensorboard_gets_the_same_numbers_and_forgets_what_a_resume_repeats(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write(tmp_path, range(4), backend="tensorboard")
    write(tmp_path, range(2, 4), resume_step=1, backend="tensorboard")
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [(e.step, e.value) for e in events.Scalars("train/loss")] == [(s, s / 2) for s in range(4)]
    assert read_curve(tmp_path, "train/loss") == [(s, s / 2) for s in range(4)]


@pytest.mark.slow
def test_wandb_offline_keeps_its_run_over_a_resume(tmp_path: Path) -> None:
    write(tmp_path, range(2), backend="wandb")
    run_id = (tmp_path / "wandb_id.txt").read_text()
    write(tmp_path, range(2, 4), resume_step=1, backend="wandb")
    assert (tmp_path / "wandb_id.txt").read_text() == run_id
    assert len(list((tmp_path / "wandb").glob(f"offline-run-*-{run_id.strip()}"))) >= 1
    assert [step for step, _ in read_curve(tmp_path, "train/loss")] == [0, 1, 2, 3]


if __name__ == "__main__":
    pytest.main([__file__])
