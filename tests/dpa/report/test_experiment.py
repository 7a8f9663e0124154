"""An experiment's file is read whole, or refused with the entry that is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dpa.report.experiment import in_words, read_experiment
from dpa.report.study import read_study
from tests.dpa.report.runs import BEST, COMMON, SEEDS, write_experiment

Broken = Callable[[dict[str, Any]], None]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_experiment(tmp_path, "methods", ["reference", "dpa_omf", "dpa_omf@20"])
    return tmp_path / "experiments" / "methods.json"


def test_an_experiment_is_read_with_both_comparisons(file: Path) -> None:
    experiment = read_experiment(file)
    assert (experiment.common, experiment.chosen["dpa_omf"]) == (COMMON, BEST)
    assert [row["seed"] for row in experiment.own_best.of("dpa_omf", BEST)] == list(SEEDS)
    assert experiment.own_best.entry("dpa_omf")["against_top_p"] == BEST[0]
    assert experiment.at_common.entry("dpa_omf")["top_p"] == COMMON[0]
    assert len(experiment.grid()) == 3


def test_an_experiment_that_repeats_nothing_of_the_paper_outside_a_repository_is_read(file: Path) -> None:
    content = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(json.dumps(content | {"paper": None, "revision": None}), encoding="utf-8")
    experiment = read_experiment(file)
    assert experiment.paper is experiment.revision is None


def test_the_scenes_that_numbers_are_of_are_told_in_words(file: Path) -> None:
    assert read_experiment(file).reported == "12 evaluation scenes"


def test_rollouts_of_a_scene_are_those_of_the_split_that_is_reported(file: Path) -> None:
    content = json.loads(file.read_text(encoding="utf-8"))
    assert read_experiment(file).num_rollouts == content["config"]["evaluation"]["num_rollouts"]
    file.write_text(json.dumps(content | {"split": "tune"}), encoding="utf-8")
    assert read_experiment(file).num_rollouts == content["config"]["decoding"]["num_rollouts"]


def test_a_temperature_of_one_is_not_told() -> None:
    assert (in_words((0.9, 1.0)), in_words((0.9, 0.8))) == ("top-p 0.9", "top-p 0.9, temperature 0.8")


def without(key: str) -> Broken:
    return lambda content: content.pop(key)


def entry(name: str, **changes: Any) -> Broken:
    return lambda content: content[name][0].update(changes)


@pytest.mark.parametrize(
    ("break_", "told"),
    [
        (without("common"), r"methods\.json has no common; make it again"),
        (lambda c: c.update(seeds=3), r"seeds must be list, got 3"),
        (lambda c: c.update(headline="other"), r"methods must hold 'reference', the headline 'other'"),
        (lambda c: c.update(versus="other"), r"methods must hold .* and versus 'other', got reference"),
        (lambda c: c["steps"]["common"].pop("dpa_omf"), r"steps\.common has no dpa_omf"),
        (lambda c: c["labels"].pop("dpa_omf@20"), r"labels has no entry for 'dpa_omf@20'"),
        (lambda c: c["labels"].update(dpa_omf=3e-4), r"labels\.dpa_omf must be str, got 0\.0003"),
        (
            lambda c: c["published"].update(dpa_omf={"realism": "abc"}),
            r"published\.dpa_omf\.realism must be a number, got 'abc'",
        ),
        (lambda c: c["published"].update(dpa_omf=3), r"published\.dpa_omf must be a table of named values, got 3"),
        (lambda c: c["budget"]["dpa_omf"].update(start="x"), r"labels has no entry for 'x'"),
        (lambda c: c["budget"].update(dpa_omf={}), r"budget\.dpa_omf has no steps, rollouts, start"),
        (lambda c: c.update(split="train"), r"split must be one of eval, tune, got 'train'"),
        (lambda c: c["own_best"].pop("versus"), r"own_best has no versus"),
        (lambda c: c["own_best"]["versus"][0].update(against="x"), r"versus\[0\] must be against 'dpa_omf', got 'x'"),
        (lambda c: c["config"].pop("decoding"), r"config\.decoding must be a table of named values, got None"),
        (lambda c: c["chosen"].pop("dpa_omf"), r"chosen has no dpa_omf"),
        (lambda c: c["chosen"].update(dpa_omf=[0.9]), r"of dpa_omf must be \[top_p, temperature\], got \[0\.9\]"),
        (entry("rows", method="x"), r"rows\[0\] is of 'x', which is none of methods"),
        (entry("rows", realism="high"), r"rows\[0\]: realism must be a number or null, got 'high'"),
        (entry("paired", ci95=[0.2, 0.1]), r"paired\[0\]: ci95 must be \[low, high\], got \[0\.2, 0\.1\]"),
        (lambda c: c["likelihood"][0].pop("file"), r"likelihood\[0\] has no file"),
        (lambda c: c["rows"].append(3), r"rows\[\d+\] must be a table of named values, got 3"),
        (lambda c: c.update(axis={"name": "x"}), r"axis has no values, log"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_the_file(break_: Broken, told: str, file: Path) -> None:
    content = json.loads(file.read_text(encoding="utf-8"))
    break_(content)
    file.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ValueError, match=told) as error:
        read_experiment(file)
    assert str(file) in str(error.value)


@pytest.mark.parametrize("text", ["{", '{"realism": NaN}', "[Infinity]", "\ufffd"])
def test_a_broken_json_is_named(text: str, file: Path) -> None:
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"methods\.json is no JSON that this page can read"):
        read_experiment(file)


def test_a_list_is_no_experiment(file: Path) -> None:
    file.write_text("[]", encoding="utf-8")
    with pytest.raises(ValueError, match=r"methods\.json holds list, not the result of an experiment"):
        read_experiment(file)


def test_a_folder_without_results_is_refused_with_the_command_that_makes_them(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"holds no results.*python -m recipes\.compare experiment=methods"):
        read_study(tmp_path)
    with pytest.raises(ValueError, match=r"absent is no folder"):
        read_study(tmp_path / "absent")


if __name__ == "__main__":
    pytest.main([__file__])
