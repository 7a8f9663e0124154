"""What an experiment found, read back from the logs of each backend, without a network."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from tensorboard.backend.event_processing.plugin_event_accumulator import EventAccumulator

from dpa.report.experiment import read_experiment
from dpa.report.table import number
from dpa.report.text import likelihood_table
from recipes.experiment.logged import log_experiment
from tests.dpa.report.runs import BEST, COMMON, GRID, SEEDS, values, write_runs
from tests.dpa.training.offline import wandb_history

TABLES = {
    "common/methods", "common/safety", "own_best/methods", "own_best/safety", "likelihood/methods", "tuning/decodings",
}  # fmt: skip
PICTURES = {"own_best/differences", "scenes/likely"}


@pytest.fixture
def study(tmp_path: Path) -> Path:
    write_runs(tmp_path / "runs")
    return tmp_path / "runs"


@pytest.fixture
def likely(tmp_path: Path) -> Path:
    """A picture that the experiment has drawn."""
    Image.new("RGB", (60, 40), "white").save(tmp_path / "likely.png")
    return tmp_path / "likely.png"


def logged(study: Path, backend: str, likely: Path | None = None) -> tuple[Path, dict[str, Any]]:
    path = study / "experiments/methods.json"
    cfg: DictConfig = OmegaConf.create({"output": str(study), "logger": {"backend": backend, "mode": "offline"}})
    pictures = {} if likely is None else {"scenes/likely": likely}
    return log_experiment(cfg, read_experiment(path), pictures), json.loads(path.read_text())


def rows_of(folder: Path, table: str) -> list[dict[str, str]]:
    with (folder / "tables" / table / "0.csv").open() as file:
        return list(csv.DictReader(file))


def mean_realism(rows: list[dict[str, Any]], method: str, decoding: list[float]) -> float:
    wanted = [method, *decoding]
    values = [row["realism"] for row in rows if [row["method"], row["top_p"], row["temperature"]] == wanted]
    return sum(values) / len(values)


def test_files_hold_the_tables_numbers_and_picture_of_an_experiment(study: Path) -> None:
    folder, found = logged(study, "csv")
    rows = rows_of(folder, "own_best/methods")
    assert [row["method"] for row in rows] == found["methods"]
    for row in rows:
        mean = mean_realism(found["own_best"]["rows"], row["method"], found["chosen"][row["method"]])
        assert float(row["realism ↑"]) == pytest.approx(mean, abs=6e-4)
    assert (folder / "pictures/own_best/differences/0.png").read_bytes().startswith(b"\x89PNG")
    for method in found["methods"]:
        step, value = (folder / f"scalars/common/realism/{method}.csv").read_text().strip().split(",")
        assert step == "0" and float(value) == pytest.approx(mean_realism(found["rows"], method, found["common"]))


def test_safety_is_a_table_of_means_over_seeds_and_known_scenes(study: Path) -> None:
    folder, _ = logged(study, "csv")
    for name, decoding in (("common", COMMON), ("own_best", BEST)):
        row = next(row for row in rows_of(folder, f"{name}/safety") if row["method"] == "dpa_omf")
        assert (float(row["top-p"]), float(row["temperature"])) == decoding
        for key, title in {
            "red_light": "red light ↓",
            "harsh_jerk": "harsh jerk ↓",
            "offroad_rate": "off-road ↓",
        }.items():
            of_seeds = [[v for v in values("dpa_omf", seed, decoding)[key] if v is not None] for seed in SEEDS]
            mean = sum(sum(scenes) / len(scenes) for scenes in of_seeds) / len(SEEDS)
            assert float(row[title]) == pytest.approx(mean, rel=1e-4), (name, key)


def test_likelihoods_are_the_table_of_the_page(study: Path) -> None:
    folder, found = logged(study, "csv")
    rows = rows_of(folder, "likelihood/methods")
    titles, _, *lines = likelihood_table(
        read_experiment(study / "experiments/methods.json"), lambda file: None
    ).splitlines()
    shown = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [f" {title} " for title in rows[0]] == titles.strip("|").split("|")
    for row, (label, *numbers) in zip(rows, shown, strict=True):
        method, *logged_ = row.values()
        assert found["labels"][method] == label
        assert [
            number(float(value), len(told.partition(".")[2])) for value, told in zip(logged_, numbers, strict=True)
        ] == numbers


def test_every_decoding_that_was_tried_has_a_row_with_realism_and_spread(study: Path) -> None:
    folder, found = logged(study, "csv")
    rows = rows_of(folder, "tuning/decodings")
    assert [row["method"] for row in rows] == [method for method in found["methods"] for _ in GRID]
    for row in rows:
        decoding = float(row["top-p"]), float(row["temperature"])
        for key, title in (("realism", "realism ↑"), ("spread", "spread [m]")):
            scenes = [value for seed in SEEDS for value in values(row["method"], seed, decoding)[key]]
            assert float(row[title]) == pytest.approx(sum(scenes) / len(scenes), rel=1e-4)


def test_differences_to_another_method_are_numbers_beside_those_to_the_reference(study: Path) -> None:
    folder, found = logged(study, "csv")
    for entry in found["own_best"]["versus"]:
        ends = {"difference": entry["realism_difference"], "low": entry["ci95"][0], "high": entry["ci95"][1]}
        for end, value in ends.items():
            path = folder / f"scalars/own_best/realism_{end}_to_dpa_omf/{entry['method']}.csv"
            assert float(path.read_text().split(",")[1]) == pytest.approx(value)
    assert {path.stem for path in (folder / "scalars/own_best/realism_low").iterdir()} == set(found["methods"][1:])


def test_only_pictures_that_were_drawn_of_the_experiment_are_logged(study: Path, likely: Path) -> None:
    folder, _ = logged(study, "csv")
    assert not (folder / "pictures/scenes").exists()
    folder, _ = logged(study, "csv", likely)
    assert (folder / "pictures/scenes/likely/0.png").read_bytes() == likely.read_bytes()


def test_logs_are_written_anew_when_an_experiment_is_run_again(study: Path) -> None:
    folder, _ = logged(study, "csv")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.suffix == ".csv"}
    logged(study, "csv")
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.suffix == ".csv"} == before


def test_tensorboard_shows_the_same(study: Path, likely: Path) -> None:
    folder, found = logged(study, "tensorboard", likely)
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"tensors": 0}).Reload()
    tags = set(events.Tags()["tensors"])
    assert {tag.removesuffix("/text_summary") for tag in tags if tag.endswith("/text_summary")} == TABLES
    assert tags >= PICTURES
    numbers = {path.relative_to(folder / "scalars").with_suffix("").as_posix(): path for path in curves(folder)}
    assert tags >= set(numbers), "every number that is in the files"
    for tag, path in numbers.items():
        (event,) = events.Tensors(tag)
        assert event.tensor_proto.float_val[0] == pytest.approx(float(path.read_text().split(",")[1]), abs=1e-5)
    (table,) = events.Tensors("tuning/decodings/text_summary")
    lines = table.tensor_proto.string_val[0].decode().splitlines()
    assert lines[0] == "| method | top-p | temperature | realism ↑ | spread [m] |"
    assert lines[2].startswith("| reference | 0.95 | 1.0 | ") and len(lines) == 2 + len(found["methods"]) * len(GRID)


def curves(folder: Path) -> list[Path]:
    return sorted((folder / "scalars").rglob("*.csv"))


def test_wandb_gets_the_same_offline(study: Path, likely: Path) -> None:
    folder, _ = logged(study, "wandb", likely)
    (run,) = (folder / "wandb").glob("offline-run-*")
    tables = [json.loads(path.read_text()) for path in run.rglob("*.table.json")]
    assert sorted((len(table["data"]), table["columns"]) for table in tables) == sorted(
        (len(rows), list(rows[0])) for rows in (rows_of(folder, name) for name in TABLES)
    )
    assert all(table["columns"][0] == "method" and table["data"][0][0] == "reference" for table in tables)
    numbers = {path.relative_to(folder / "scalars").with_suffix("").as_posix(): path for path in curves(folder)}
    shown = {key: value for row in wandb_history(next(run.glob("*.wandb"))) for key, value in row.items()}
    assert shown.keys() >= numbers.keys() | {f"{name}/_type" for name in TABLES | PICTURES}
    for name, path in numbers.items():
        assert shown[name] == pytest.approx(float(path.read_text().split(",")[1])), name
    drawn = [folder / "pictures" / name / "0.png" for name in PICTURES]
    assert sorted(map(size, run.rglob("media/images/**/*.png"))) == sorted(map(size, drawn))


def size(picture: Path) -> tuple[int, int]:
    with Image.open(picture) as image:
        return image.size


if __name__ == "__main__":
    pytest.main([__file__])
