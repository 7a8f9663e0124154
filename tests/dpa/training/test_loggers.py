"""Curves, tables and pictures: layout on disk, resume without repetition, and what the further backends hold."""

from __future__ import annotations

import csv
import importlib.util
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from dpa.training.loggers import make_logger, read_curve, read_curves
from tests.dpa.training.offline import wandb_history

HEADER = ["method", "realism", "scenes"]
ROWS = [["reference", 0.5625, 54], ["a|b, c", None, 7]]
PIXELS = (np.arange(4 * 6 * 3) * 3).astype(np.uint8).reshape(4, 6, 3)


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
    assert read_curves(tmp_path / "theirs") == {"train/loss": [(0, 0.0), (1, 0.5)]}


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


def test_a_broken_row_is_named_with_file_and_line(tmp_path: Path) -> None:
    (tmp_path / "scalars").mkdir()
    (tmp_path / "scalars/loss.csv").write_text("0,1.0\n1\n")
    with pytest.raises(ValueError, match=r"loss\.csv:2: expected 'step,value', got '1'"):
        read_curves(tmp_path)


def test_a_folder_without_curves_has_none(tmp_path: Path) -> None:
    assert read_curves(tmp_path) == {}


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


# --- tables and pictures ---------------------------------------------------------------------------------------------


def show(folder: Path, steps: range, backend: str = "csv") -> None:
    """A run that logs a number, a table and a picture at each step."""
    logger = make_logger(backend, folder, {"lr": 0.1})
    for step in steps:
        logger.log({"train/loss": step / 2}, step)
        logger.table("eval/methods", HEADER, [*ROWS, ["step", torch.tensor(step / 4), np.int64(step)]], step)
        Image.fromarray(PIXELS + np.uint8(step)).save(folder / "drawn.png")
        logger.picture("eval/scene", folder / "drawn.png", step)
    logger.close()


def decoded(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)))


def test_a_table_and_a_picture_are_a_file_for_each_step(tmp_path: Path) -> None:
    show(tmp_path, range(2))
    with (tmp_path / "tables" / "eval" / "methods" / "1.csv").open(newline="") as file:
        cells = [["reference", "0.5625", "54"], ["a|b, c", "", "7"], ["step", "0.25", "1"]]
        assert list(csv.reader(file)) == [HEADER, *cells]
    for step in range(2):
        picture = (tmp_path / "pictures" / "eval" / "scene" / f"{step}.png").read_bytes()
        assert np.array_equal(decoded(picture), PIXELS + step)


def test_a_picture_file_is_kept_to_the_byte(tmp_path: Path) -> None:
    logger = make_logger("csv", tmp_path / "run", {})
    for step, name in enumerate(("drawn.png", "taken.jpeg")):
        Image.fromarray(PIXELS).save(tmp_path / name)
        logger.picture("eval/scene", tmp_path / name, step)
    logger.close()
    kept = tmp_path / "run" / "pictures" / "eval" / "scene"
    assert (kept / "0.png").read_bytes() == (tmp_path / "drawn.png").read_bytes()
    assert (kept / "1.jpg").read_bytes() == (tmp_path / "taken.jpeg").read_bytes()


def test_a_new_run_drops_all_of_an_earlier_one_and_one_that_goes_on_drops_nothing(tmp_path: Path) -> None:
    show(tmp_path, range(3))
    tables, pictures = tmp_path / "tables/eval/methods", tmp_path / "pictures/eval/scene"
    write(tmp_path, range(1, 2), resume_step=1)
    assert sorted(path.name for path in tables.iterdir()) == ["0.csv", "1.csv", "2.csv"]
    show(tmp_path, range(1))
    assert [path.name for path in (*tables.iterdir(), *pictures.iterdir())] == ["0.csv", "0.png"]


@pytest.mark.parametrize(
    ("name", "header", "rows", "message"),
    [
        ("", HEADER, ROWS, "the name of a table must be like group/name, got ''"),
        ("../eval", HEADER, ROWS, "must be like group/name, got '../eval'"),
        ("eval", "method", ROWS, "needs a header of column names, got 'method'"),
        ("eval", [], [], "needs a header of column names"),
        ("eval", ["a", "a"], [[1, 2]], "has a column twice"),
        ("eval", HEADER, [["reference", 0.5]], r"which the row \['reference', 0.5\] does not fit"),
        ("eval", HEADER, ["abc"], "which the row 'abc' does not fit"),
        ("eval", HEADER, [["a", torch.zeros(2), 1]], "in the column 'realism' that is neither text nor number: Tensor"),
        ("eval", HEADER, [["a", {}, 1]], "neither text nor number: dict"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, name: str, header: Any, rows: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_logger("csv", tmp_path, {}).table(name, header, rows, 0)
    assert not (tmp_path / "tables").exists()


@pytest.mark.parametrize("path", ["nowhere.png", __file__])
def test_what_is_no_picture_is_refused(tmp_path: Path, path: str) -> None:
    with pytest.raises(ValueError, match=f"{Path(path).name} is no PNG or JPEG file that can be read"):
        make_logger("csv", tmp_path, {}).picture("eval/scene", path, 0)
    assert not (tmp_path / "pictures").exists()


def test_tensorboard_holds_every_table_and_picture(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.plugin_event_accumulator import EventAccumulator
    from tensorboard.util.tensor_util import make_ndarray

    show(tmp_path, range(4), backend="tensorboard")
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    tables = events.Tensors("eval/methods/text_summary")
    assert [event.step for event in tables] == [0, 1, 2, 3]
    text = make_ndarray(tables[3].tensor_proto).item().decode()
    assert text.splitlines() == [
        "| method | realism | scenes |",
        "| --- | --- | --- |",
        "| reference | 0.5625 | 54 |",
        r"| a\|b, c | – | 7 |",
        "| step | 0.75 | 3 |",
    ]
    pictures = events.Tensors("eval/scene")
    assert [event.step for event in pictures] == [0, 1, 2, 3]
    for event in pictures:
        width, height, content = make_ndarray(event.tensor_proto)
        assert (int(width), int(height)) == (6, 4)
        assert np.array_equal(decoded(content), PIXELS + event.step)


def test_wandb_holds_the_numbers_the_cells_and_the_pixels(tmp_path: Path) -> None:
    show(tmp_path, range(1, 3), backend="wandb")
    (run,) = (tmp_path / "wandb").glob("offline-run-*")
    rows = wandb_history(next(run.glob("*.wandb")))
    assert [(row["step"], row["train/loss"]) for row in rows if "train/loss" in row] == [(1, 0.5), (2, 1.0)]
    for kind in ("table", "image"):
        assert [row["step"] for row in rows if any(f"{kind}-file" in str(value) for value in row.values())] == [1, 2]
    tables = sorted((run / "files" / "media" / "table" / "eval").iterdir())
    for step, table in zip((1, 2), tables, strict=True):
        shown = json.loads(table.read_text())
        assert shown["columns"] == HEADER and shown["data"] == [*ROWS, ["step", step / 4, step]]
    pictures = sorted((run / "files" / "media" / "images" / "eval").iterdir())
    for step, picture in zip((1, 2), pictures, strict=True):
        assert np.array_equal(decoded(picture.read_bytes()), PIXELS + step)


if __name__ == "__main__":
    pytest.main([__file__])
