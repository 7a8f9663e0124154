"""What an experiment found, read back from its logs; what back ends make of them is with dpa.training.loggers."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from tensorboard.backend.event_processing.plugin_event_accumulator import EventAccumulator

from dpa.report.cards import read_preference_cards
from dpa.report.experiment import read_experiment
from dpa.report.likelihoods import LEARNT, who_learns
from dpa.report.matched import equal_sharpness
from dpa.report.scenes import read_scene_cards
from dpa.report.study import Evaluations
from dpa.report.table import number
from dpa.report.text import likelihood_table
from recipes.experiment.logged import log_experiment
from tests.dpa.report.runs import BEST, COMMON, GRID, SEEDS, values, write_runs

TABLES = {
    "common/methods", "common/safety", "own_best/methods", "own_best/safety", "likelihood/methods", "tuning/decodings",
    "equal_sharpness/methods", "account/stages", "scenes/train", "scenes/tune", "scenes/eval", "learnt/methods",
    "preferences/stores",
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_runs(tmp_path_factory.mktemp("made") / "runs")


@pytest.fixture(scope="module")
def files(made: Path) -> tuple[Path, dict[str, Any]]:
    """Logs as files and the experiment; tests may write the same again, and nothing else."""
    return logged(made)


@pytest.fixture
def study(made: Path, tmp_path: Path) -> Path:
    """A study that a test may change and log."""
    return Path(shutil.copytree(made, tmp_path / "runs", ignore=shutil.ignore_patterns("pictures", "tables")))


@pytest.fixture
def likely(tmp_path: Path) -> Path:
    """A picture that the experiment has drawn."""
    Image.new("RGB", (60, 40), "white").save(tmp_path / "likely.png")
    return tmp_path / "likely.png"


def logged(study: Path, likely: Path | None = None) -> tuple[Path, dict[str, Any]]:
    path = study / "experiments/methods.json"
    cfg: DictConfig = OmegaConf.create({"output": str(study), "logger": {"backend": "csv", "mode": "offline"}})
    pictures = {} if likely is None else {"scenes/likely": likely}
    return log_experiment(cfg, read_experiment(path), pictures), json.loads(path.read_text())


def rows_of(folder: Path, table: str) -> list[dict[str, str]]:
    with (folder / "tables" / table / "0.csv").open() as file:
        return list(csv.DictReader(file))


def mean_realism(rows: list[dict[str, Any]], method: str, decoding: list[float]) -> float:
    wanted = [method, *decoding]
    values = [row["realism"] for row in rows if [row["method"], row["top_p"], row["temperature"]] == wanted]
    return sum(values) / len(values)


def test_files_hold_the_tables_numbers_and_picture_of_an_experiment(files: tuple[Path, dict[str, Any]]) -> None:
    folder, found = files
    assert {path.parent.relative_to(folder / "tables").as_posix() for path in folder.rglob("tables/**/0.csv")} == TABLES
    rows = rows_of(folder, "own_best/methods")
    assert [row["method"] for row in rows] == found["methods"]
    for row in rows:
        mean = mean_realism(found["own_best"]["rows"], row["method"], found["chosen"][row["method"]])
        assert float(row["realism ↑"]) == pytest.approx(mean, abs=6e-4)
    assert (folder / "pictures/own_best/differences/0.png").read_bytes().startswith(b"\x89PNG")
    for method in found["methods"]:
        step, value = (folder / f"scalars/common/realism/{method}.csv").read_text().strip().split(",")
        assert step == "0" and float(value) == pytest.approx(mean_realism(found["rows"], method, found["common"]))


def test_safety_is_a_table_of_means_over_seeds_and_known_scenes(files: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = files
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


def test_likelihoods_are_the_table_of_the_page(files: tuple[Path, dict[str, Any]]) -> None:
    folder, found = files
    rows = rows_of(folder, "likelihood/methods")
    titles, _, *lines = likelihood_table(read_experiment(folder.with_suffix(".json")), lambda file: None).splitlines()
    shown = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert [f" {title} " for title in rows[0]] == titles.strip("|").split("|")
    for row, (label, *numbers) in zip(rows, shown, strict=True):
        method, *logged_ = row.values()
        assert found["labels"][method] == label
        assert [
            number(float(value), len(told.partition(".")[2])) for value, told in zip(logged_, numbers, strict=True)
        ] == numbers


def test_every_decoding_that_was_tried_has_a_row_with_realism_and_spread(files: tuple[Path, dict[str, Any]]) -> None:
    folder, found = files
    rows = rows_of(folder, "tuning/decodings")
    assert [row["method"] for row in rows] == [method for method in found["methods"] for _ in GRID]
    for row in rows:
        decoding = float(row["top-p"]), float(row["temperature"])
        for key, title in (("realism", "realism ↑"), ("spread", "spread [m]")):
            scenes = [value for seed in SEEDS for value in values(row["method"], seed, decoding)[key]]
            assert float(row[title]) == pytest.approx(sum(scenes) / len(scenes), rel=1e-4)


def test_realism_at_equal_sharpness_is_the_table_of_the_page(files: tuple[Path, dict[str, Any]]) -> None:
    folder, found = files
    experiment = read_experiment(folder.with_suffix(".json"))
    rows = rows_of(folder, "equal_sharpness/methods")
    expected = list(equal_sharpness(experiment, Evaluations(folder.parents[1])))
    assert {row["method"] for row in rows} == {*found["methods"]} - {"reference"}
    for row, (method, decoding, (change, spread, beyond)) in zip(rows, expected, strict=True):
        assert (row["method"], float(row["top-p"]), float(row["temperature"])) == (method, *decoding)
        told = [float(row[title]) for title in ("spread [m]", "beyond [m]", "Δ realism", "low", "high")]
        assert told == pytest.approx([spread, beyond, change.mean, change.low, change.high], rel=1e-4)


def test_hours_and_data_cards_are_tables(files: tuple[Path, dict[str, Any]], study: Path) -> None:
    folder, found = files
    rows = {row["stage"]: float(row["seconds of one worker"]) for row in rows_of(folder, "account/stages")}
    assert rows == found["stages"]
    for split, card in read_scene_cards(study / "scenes.json").items():
        assert {row["of all scenes"]: row[split] for row in rows_of(folder, f"scenes/{split}")} == dict(card.facts)
    (study / "scenes.json").unlink()
    assert not (logged(study)[0] / "tables/scenes").exists(), "an older study has no cards"


def test_who_learns_the_ranking_is_the_table_of_the_page(files: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = files
    learnt = who_learns(read_experiment(folder.with_suffix(".json")), Evaluations(folder.parents[1]))
    rows = {row["of"]: row for row in rows_of(folder, "learnt/methods")}
    assert list(rows) == [*learnt.means, *learnt.changes]
    for name, cells in learnt.means.items():
        assert [float(rows[name][title]) for title in LEARNT.values()] == pytest.approx(
            [cell.mean for cell in cells], rel=1e-4
        )
        assert rows[name]["realism ↑ low"] == "", "a mean has no interval here"
    for name, changes in learnt.changes.items():
        for title, change in zip(LEARNT.values(), changes, strict=True):
            told = [float(rows[name][column]) for column in (title, f"{title} low", f"{title} high")]
            assert told == pytest.approx([change.mean, change.low, change.high], rel=1e-4, abs=1e-9)


def test_the_cards_of_ranked_rollouts_are_a_table(files: tuple[Path, dict[str, Any]], made: Path) -> None:
    rows = rows_of(files[0], "preferences/stores")
    assert [row["store"] for row in rows] == ["seed 0, train", "seed 1, train"]
    for row, card in zip(rows, read_preference_cards(made).values(), strict=True):
        assert (row["scenes"], row["pairs"]) == ("3", str(3 * card.pairs))


def test_the_experiment_along_an_axis_has_its_figure_in_tensorboard(study: Path) -> None:
    cfg: DictConfig = OmegaConf.create({"output": str(study), "logger": {"backend": "tensorboard", "mode": "offline"}})
    folder = log_experiment(cfg, read_experiment(study / "experiments/scaling.json"), {})
    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"tensors": 0}).Reload()
    assert "figures/scaling" in events.Tags()["tensors"]


def test_figures_of_the_page_are_pictures(files: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = files
    names = {path.parent.name for path in (folder / "pictures/figures").rglob("*.png")}
    assert names == {"sharpness", "compute", "likelihood", "health"}, "methods along no axis have none of scaling"


def test_differences_to_another_method_are_numbers_beside_those_to_the_reference(
    files: tuple[Path, dict[str, Any]],
) -> None:
    folder, found = files
    for entry in found["own_best"]["versus"]:
        ends = {"difference": entry["realism_difference"], "low": entry["ci95"][0], "high": entry["ci95"][1]}
        for end, value in ends.items():
            path = folder / f"scalars/own_best/realism_{end}_to_dpa_omf/{entry['method']}.csv"
            assert float(path.read_text().split(",")[1]) == pytest.approx(value)
    assert {path.stem for path in (folder / "scalars/own_best/realism_low").iterdir()} == set(found["methods"][1:])


def test_only_pictures_that_were_drawn_of_the_experiment_are_logged(
    files: tuple[Path, dict[str, Any]], study: Path, likely: Path
) -> None:
    assert not (files[0] / "pictures/scenes").exists()
    folder, _ = logged(study, likely)
    assert (folder / "pictures/scenes/likely/0.png").read_bytes() == likely.read_bytes()


def test_logs_are_written_anew_when_an_experiment_is_run_again(made: Path, files: tuple[Path, dict[str, Any]]) -> None:
    folder, _ = files
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.suffix == ".csv"}
    assert before and logged(made)[0] == folder
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.suffix == ".csv"} == before


if __name__ == "__main__":
    pytest.main([__file__])
