"""Gains against the competence of references, from finished comparisons."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.dpa.report.runs import SCENES, SEEDS, write_experiment

METHODS = ["reference", "dpa_omf", "adversarial_afd"]


@pytest.fixture(scope="module")
def studies(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two finished comparisons."""
    first = tmp_path_factory.mktemp("studies") / "first"
    write_experiment(first, "methods", METHODS)
    shutil.copytree(first, first.parent / "second")
    return [first, first.parent / "second"]


def told(studies: list[Path], output: Path, *more: str) -> list[str]:
    runs = ",".join(map(str, studies))
    return [f"runs=[{runs}]", "name=methods", "methods=[dpa_omf,adversarial_afd]", f"output={output}", *more]


def test_the_table_has_the_differences_of_the_comparisons_and_the_realism_of_their_references(
    run: Callable, studies: list[Path], tmp_path: Path
) -> None:
    outcome = run("gains", *told(studies, tmp_path))
    assert outcome.status == 0, outcome.err
    assert (tmp_path / "gains.png").is_file() and "first" in outcome.out and "second" in outcome.out
    (table,) = (tmp_path / "tables/gains").rglob("*.csv")
    rows = {row["runs"]: row for row in csv.DictReader(table.read_text(encoding="utf-8").splitlines())}
    content = json.loads((studies[0] / "experiments/methods.json").read_text())
    (entry,) = [each for each in content["own_best"]["paired"] if each["method"] == "dpa_omf"]
    assert float(rows["first"]["gain of DPA-OMF"]) == pytest.approx(entry["realism_difference"])
    assert float(rows["first"]["gain of DPA-OMF low"]) == pytest.approx(entry["ci95"][0])
    own = [row for row in content["own_best"]["rows"] if row["method"] == "reference"]
    values = [json.loads((studies[0] / row["file"]).read_text())["per_scene"]["realism"] for row in own]
    mean = sum(map(sum, values)) / (len(SEEDS) * SCENES)
    assert float(rows["second"]["realism of the reference"]) == pytest.approx(mean)


def test_each_of_the_runs_may_have_an_experiment_of_its_own(run: Callable, studies: list[Path], tmp_path: Path) -> None:
    write_experiment(tmp_path / "third", "losses", METHODS)
    outcome = run("gains", *told([studies[0], tmp_path / "third"], tmp_path / "out", "name=[methods,losses]"))
    assert outcome.status == 0 and "first" in outcome.out and "third" in outcome.out, outcome.err


def test_gains_stand_beside_those_of_the_first_where_the_scenes_are_the_same(
    run: Callable, studies: list[Path], tmp_path: Path
) -> None:
    better = tmp_path / "better"
    shutil.copytree(studies[0], better)
    content = json.loads((better / "experiments/methods.json").read_text())
    for file in {row["file"] for row in content["own_best"]["rows"] if row["method"] == "dpa_omf"}:
        values = json.loads((better / file).read_text())
        values["per_scene"]["realism"] = [each + 0.125 for each in values["per_scene"]["realism"]]
        (better / file).write_text(json.dumps(values))
    elsewhere, fewer = tmp_path / "elsewhere", tmp_path / "fewer"
    for folder, options in ((elsewhere, {"scenes": "of another town"}), (fewer, {"evaluation": {"num_rollouts": 16}})):
        shutil.copytree(studies[0], folder)
        for file in folder.rglob("eval_*.json"):
            values = json.loads(file.read_text())
            file.write_text(json.dumps(values | {"options": values["options"] | options}))
    outcome = run("gains", *told([studies[0], better, elsewhere, fewer], tmp_path / "out"))
    assert outcome.status == 0, outcome.err
    (table,) = (tmp_path / "out/tables/gains_minus_first").rglob("*.csv")
    rows = {row["runs"]: row for row in csv.DictReader(table.read_text(encoding="utf-8").splitlines())}
    assert rows.keys() == {"better", "elsewhere", "fewer"}
    gained = [float(rows["better"][f"gain of DPA-OMF{end}"]) for end in ("", " low", " high")]
    assert gained[0] == pytest.approx(0.125) and gained[1] <= 0.125 <= gained[2]
    assert float(rows["better"]["gain of adversarial AFD"]) == pytest.approx(0)
    assert rows["elsewhere"]["gain of DPA-OMF"] == "", (
        "nothing can be said across scenes, even if they are called alike"
    )
    assert rows["fewer"]["gain of DPA-OMF"] == "", "nor across numbers of rollouts"


def test_gains_by_two_metrics_are_refused(run: Callable, studies: list[Path], tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(studies[0], other)
    path = other / "experiments/methods.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"metric": "2025"}))
    outcome = run("gains", *told([studies[0], other], tmp_path / "out"))
    assert outcome.status == 2 and "first of 2024" in outcome.err and "other of 2025" in outcome.err


def test_an_archive_tells_family_tokens_and_size_of_a_reference_of_the_zoo(run: Callable, tmp_path: Path) -> None:
    write_experiment(tmp_path / "runs", "methods", METHODS)
    path = tmp_path / "runs/experiments/methods.json"
    content = json.loads(path.read_text())
    content["config"]["reference"] = ["zoo:motionlm-nano-sumo"]
    path.write_text(json.dumps(content))
    outcome = run("gains", *told([tmp_path / "runs"], tmp_path / "out"))
    assert outcome.status == 0, outcome.err
    (table,) = (tmp_path / "out/tables/gains").rglob("*.csv")
    (row,) = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    assert float(row["parameters [M]"]) == pytest.approx(0.15, abs=0.01)
    assert (row["family"], row["tokens"]) == ("motionlm", "verlet, 169")
    titles, _, line = (tmp_path / "out/gains.md").read_text(encoding="utf-8").partition("\n\n")[0].splitlines()
    assert titles.startswith("| runs | family | tokens |") and line.startswith("| runs | motionlm | verlet, 169 |")


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("name=competent", "has no experiment 'competent'"),
        ("methods=[rloo]", "does not compare 'rloo' with its reference; it has dpa_omf, adversarial_afd"),
        ("name=[methods]", "name=['methods'] must be one name for all, or one for each of runs="),
        ("runs=[]", "runs=[] and methods=['dpa_omf', 'adversarial_afd'] must name one or more each"),
        ("runs=[{0},{0}]", "two of the runs are called 'first'"),
    ],
)
def test_what_is_not_there_is_told(
    run: Callable, studies: list[Path], tmp_path: Path, option: str, message: str
) -> None:
    outcome = run("gains", *told(studies, tmp_path / "out", option.format(studies[0])))
    assert outcome.status == 2 and message in outcome.err and outcome.err.count("error:") == 1, outcome.err
