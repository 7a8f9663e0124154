"""What an experiment found, read back from the logs of each backend, without a network."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf
from tensorboard.backend.event_processing.plugin_event_accumulator import EventAccumulator

from recipes.experiment.logged import log_experiment
from tests.dpa.report.runs import write_runs


@pytest.fixture
def study(tmp_path: Path) -> Path:
    write_runs(tmp_path / "runs")
    return tmp_path / "runs"


def logged(study: Path, backend: str) -> tuple[Path, dict[str, Any]]:
    found = json.loads((study / "experiments/methods.json").read_text())
    logger = {"backend": backend, "mode": "offline"}
    cfg: DictConfig = OmegaConf.create({"output": str(study), "logger": logger})
    return log_experiment(cfg, found), found


def mean_realism(rows: list[dict[str, Any]], method: str, decoding: list[float]) -> float:
    wanted = [method, *decoding]
    values = [row["realism"] for row in rows if [row["method"], row["top_p"], row["temperature"]] == wanted]
    return sum(values) / len(values)


def test_files_hold_the_tables_numbers_and_picture_of_an_experiment(study: Path) -> None:
    folder, found = logged(study, "csv")
    with (folder / "tables/own_best/methods/0.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == found["methods"]
    for row in rows:
        mean = mean_realism(found["own_best"]["rows"], row["method"], found["chosen"][row["method"]])
        assert float(row["realism ↑"]) == pytest.approx(mean, abs=6e-4)
    assert (folder / "pictures/own_best/differences/0.png").read_bytes().startswith(b"\x89PNG")
    for method in found["methods"]:
        step, value = (folder / f"scalars/common/realism/{method}.csv").read_text().strip().split(",")
        assert step == "0" and float(value) == pytest.approx(mean_realism(found["rows"], method, found["common"]))


def test_logs_are_written_anew_when_an_experiment_is_run_again(study: Path) -> None:
    folder, _ = logged(study, "csv")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.suffix == ".csv"}
    logged(study, "csv")
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.suffix == ".csv"} == before


def test_tensorboard_shows_the_same(study: Path) -> None:
    folder, found = logged(study, "tensorboard")
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"tensors": 0}).Reload()
    assert "own_best/differences" in " ".join(events.Tags()["tensors"]), "the picture"
    assert any("common/methods" in tag for tag in events.Tags()["tensors"]), "the table"
    tag = f"common/realism/{found['methods'][1]}"
    (event,) = events.Tensors(tag)
    value = event.tensor_proto.float_val[0]
    assert value == pytest.approx(mean_realism(found["rows"], found["methods"][1], found["common"]), abs=1e-6)


def test_wandb_gets_the_same_offline(study: Path) -> None:
    folder, found = logged(study, "wandb")
    (run,) = (folder / "wandb").glob("offline-run-*")
    tables = [json.loads(path.read_text()) for path in run.rglob("*.table.json")]
    assert sorted(len(table["data"]) for table in tables) == sorted(
        len({(row["method"], row["top_p"], row["temperature"]) for row in rows})
        for rows in (found["rows"], found["own_best"]["rows"])
    )
    assert all(table["columns"][0] == "method" and table["data"][0][0] == "reference" for table in tables)
    (picture,) = run.rglob("media/images/**/*.png")
    assert picture.stat().st_size > 1000


if __name__ == "__main__":
    pytest.main([__file__])
