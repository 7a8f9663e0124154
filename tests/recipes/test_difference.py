"""Any two methods of an experiment, compared in every measure from the values of its scenes."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from dpa.report.experiment import read_experiment
from dpa.report.statistics import paired_bootstrap
from dpa.report.study import Evaluations
from recipes import difference
from recipes.difference import Difference, Side, differences, differences_of_files, differences_to_rung
from tests.dpa.report.runs import BEST, COMMON, SEEDS, likelihoods, values, write_experiment, write_runs


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_runs(tmp_path_factory.mktemp("study"))


def found(runs: Path, method: str, other: str, *at: tuple[float, float]) -> dict[str, Difference]:
    experiment = read_experiment(runs / "experiments" / "methods.json")
    return {
        each.measure: each
        for each in differences(Side(experiment, method), Side(experiment, other), Evaluations(runs), at)
    }


def test_each_method_stands_at_its_own_best_decoding(runs: Path) -> None:
    experiment = read_experiment(runs / "experiments" / "methods.json")
    (entry,) = (entry for entry in experiment.own_best.paired if entry["method"] == "dpa_omf")
    realism = found(runs, "dpa_omf", "reference")["realism"]
    mine, base = (
        np.array([values(name, seed, experiment.chosen[name])["realism"] for seed in SEEDS])
        for name in ("dpa_omf", "reference")
    )
    assert realism.interval.mean == pytest.approx(entry["realism_difference"])
    assert realism.interval == paired_bootstrap(mine, base)
    assert (realism.mine, realism.other) == pytest.approx((mine.mean(), base.mean()))
    assert realism.ahead == (mine.mean(1) > base.mean(1)).sum()


def test_tuning_scenes_are_not_paired_with_evaluation_scenes(tmp_path: Path) -> None:
    runs = write_runs(tmp_path)
    write_experiment(runs, "budgets", ["reference", "dpa_omf"], split="tune")
    two = (read_experiment(runs / "experiments" / f"{name}.json") for name in ("methods", "budgets"))
    sides = [Side(experiment, "dpa_omf") for experiment in two]
    with pytest.raises(
        ValueError, match="methods on .* evaluation scenes and budgets on .* tuning scenes; compare methods"
    ):
        list(differences(*sides, Evaluations(runs)))


def test_decodings_may_be_given_for_both_or_one_of_each(runs: Path) -> None:
    def mean(seeds: range, *side: object) -> float:
        return np.mean([values(side[0], seed, side[1])["realism"] for seed in seeds])

    both = found(runs, "dpa_omf", "reference", COMMON)["realism"]
    assert (both.mine, both.other) == pytest.approx((mean(SEEDS, "dpa_omf", COMMON), mean(SEEDS, "reference", COMMON)))
    each = found(runs, "dpa_omf", "reference", BEST, COMMON)["realism"]
    assert (each.mine, each.other) == pytest.approx((mean(SEEDS, "dpa_omf", BEST), mean(SEEDS, "reference", COMMON)))


def test_likelihoods_are_compared_too_and_a_scene_that_one_run_has_no_value_of_counts_nowhere(runs: Path) -> None:
    measures = found(runs, "dpa_omf", "dpa_adef")
    gain = np.mean(likelihoods("dpa_omf")["nll_preferred"]) - np.mean(likelihoods("dpa_adef")["nll_preferred"])
    assert measures["nll_preferred"].interval.mean == pytest.approx(gain)
    assert measures["red_light"].interval.num_scenes == measures["realism"].interval.num_scenes - 1


def test_seeds_that_both_have_are_paired_whichever_side_is_named_first(tmp_path: Path) -> None:
    mine = write_runs(tmp_path)
    path = mine / "experiments" / "methods.json"
    content = json.loads(path.read_text())

    def fewer(rows: list[dict]) -> list[dict]:
        return [row for row in rows if not (row["method"] == "dpa_adef" and row["seed"] == SEEDS[-1])]

    content["rows"], content["own_best"]["rows"] = fewer(content["rows"]), fewer(content["own_best"]["rows"])
    path.write_text(json.dumps(content))
    one = found(mine, "dpa_omf", "dpa_adef")["realism"]
    other = found(mine, "dpa_adef", "dpa_omf")["realism"]
    assert one.interval.num_seeds == other.interval.num_seeds == len(SEEDS) - 1
    assert one.interval.mean == pytest.approx(-other.interval.mean)


def test_a_method_of_another_experiment_is_named_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    mine = write_runs(tmp_path)
    content = json.loads((mine / "experiments" / "methods.json").read_text())
    (mine / "experiments" / "again.json").write_text(json.dumps(content | {"name": "again"}))
    told = []
    for other in ("dpa_adef", "again:dpa_adef"):
        monkeypatch.setattr(sys, "argv", ["difference", str(mine), "methods", "dpa_omf", other])
        difference.main()
        told.append([line.split() for line in capsys.readouterr().out.splitlines() if "realism" in line])
    assert told[0] == told[1] and len(told[0]) == 1


def test_evaluations_of_other_scenes_in_one_folder_are_not_paired(tmp_path: Path) -> None:
    mine = write_runs(tmp_path)
    experiment = read_experiment(mine / "experiments" / "methods.json")
    for method, scenes in (("dpa_omf", "other"), ("reference", "scene")):
        for row in (*experiment.own_best.rows, *experiment.at_common.rows):
            if row["method"] == method:
                path = mine / row["file"]
                content = json.loads(path.read_text())
                names = [f"{scenes} {place}" for place in range(len(content["per_scene"]["realism"]))]
                path.write_text(json.dumps(content | {"scenes": names}))
    with pytest.raises(ValueError, match=r"are of other scenes.*keep each study, and each archive of one, in a folder"):
        found(mine, "dpa_omf", "reference")


def test_a_file_that_is_lost_is_named(tmp_path: Path) -> None:
    mine = write_runs(tmp_path)
    experiment = read_experiment(mine / "experiments" / "methods.json")
    lost = next(row["file"] for row in experiment.own_best.rows if row["method"] == "dpa_omf")
    (mine / lost).unlink()
    with pytest.raises(ValueError, match=f"{lost} is not there, and it holds the values of every scene"):
        found(mine, "dpa_omf", "reference")


def test_likelihoods_are_told_of_the_policies_that_were_evaluated_alone(tmp_path: Path) -> None:
    mine = write_runs(tmp_path)
    path = mine / "experiments" / "methods.json"
    content = json.loads(path.read_text())
    for row in content["likelihood"]:
        row["file"] = row["file"].replace("/dpa_omf/", "/dpa_omf/step_30/")
    path.write_text(json.dumps(content))
    assert "realism" in found(mine, "dpa_omf", "reference") and "kl" not in found(mine, "dpa_omf", "reference")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["methods", "nobody"], "methods has no method 'nobody'; it has reference, dpa_omf"),
        (["method", "dpa_omf"], "has no experiment 'method'; it has methods, scaling, steps."),
        (["methods", "dpa_omf", "--at", "0.5,1"], "dpa_omf was not evaluated at top-p 0.5, but at top-p"),
        (["methods", "dpa_omf", "--at", "0.5"], "'0.5' is no TOP_P,TEMPERATURE; say for example 0.95,1"),
        (
            ["methods", "dpa_omf", "--at", "1,1", "1,1", "1,1"],
            "--at takes one decoding for both, or one of each, got 3",
        ),
    ],
)
def test_what_is_not_there_is_one_clear_sentence(
    runs: Path, arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(sys, "argv", ["difference", str(runs), *arguments])
    with pytest.raises(SystemExit) as stopped:
        difference.main()
    assert stopped.value.code == 2 and message in capsys.readouterr().err


METRIC = ["2024", "f0"]
EVALUATED = {"scenes": "a", "evaluation": {"num_rollouts": 32, "metric": METRIC}}
RUNG = {"scenes": "a", "num_rollouts": 32, "years": {"2023": ["2023", "e0"], "2024": METRIC}}


def with_rung(folder: Path, rung: dict | None) -> tuple[Path, Path, np.ndarray]:
    """Results whose evaluations say what decided them, a rung beside them, and its realism by scene."""
    runs = write_runs(folder / "runs")
    for path in runs.rglob("eval_*.json"):
        path.write_text(json.dumps(json.loads(path.read_text()) | {"options": EVALUATED}))
    realism = np.random.default_rng(0).uniform(0.7, 0.9, len(values("dpa_omf", 0, COMMON)["realism"]))
    scored = [{"2023": {"realism": 0.0}, "2024": {"realism": float(value)}} for value in realism]
    path = folder / "the_log.json"
    if rung is not None:
        path.write_text(json.dumps({"options": RUNG | rung, "per_scene": scored}))
    return runs, path, realism


def test_a_rung_stands_beside_every_seed_by_the_metric_of_the_evaluation(tmp_path: Path) -> None:
    runs, rung, realism = with_rung(tmp_path, {})
    experiment = read_experiment(runs / "experiments" / "methods.json")
    (found,) = differences_to_rung(Side(experiment, "dpa_omf"), rung, Evaluations(runs), COMMON)
    mine = np.array([values("dpa_omf", seed, COMMON)["realism"] for seed in SEEDS])
    assert found.interval == paired_bootstrap(mine, np.broadcast_to(realism, mine.shape))
    assert (found.measure, found.other) == ("realism", pytest.approx(realism.mean()))


@pytest.mark.parametrize(
    ("rung", "message"),
    [
        ({"scenes": "b"}, "the_log.json has scenes b and dpa_omf of seed 0 has a; run both with the same"),
        ({"num_rollouts": 8}, "the_log.json has num_rollouts 8 and dpa_omf of seed 0 has 32"),
        (
            {"years": {"2025": ["2025", "a0"]}},
            "was scored by 2025 (a0) and dpa_omf of seed 0 by 2024 (f0); run recipes.ladder with years=[2024]",
        ),
        (None, "the_log.json is no rung that recipes.ladder wrote; name a file of its folder"),
    ],
)
def test_a_rung_that_cannot_be_paired_is_refused(
    rung: dict | None,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    runs, path, _ = with_rung(tmp_path, rung)
    monkeypatch.setattr(sys, "argv", ["difference", str(runs), "methods", "dpa_omf", str(path)])
    with pytest.raises(SystemExit):
        difference.main()
    assert message in " ".join(capsys.readouterr().err.split())


def lay_out(folder: Path, method: str, **options: object) -> Path:
    """Evaluations of a method, one for each seed."""
    folder.mkdir()
    for seed in SEEDS:
        decided_by = {"seed": seed, "scenes": "a", "evaluation": {"num_rollouts": 32}, "ranking": {}, **options}
        content = {"options": decided_by, "per_scene": values(method, seed, COMMON)}
        (folder / f"{10 - seed}.json").write_text(json.dumps(content))
    return folder


def test_evaluations_by_seed_differ_as_the_methods_of_an_experiment_do(runs: Path, tmp_path: Path) -> None:
    mine, base = (lay_out(tmp_path / name, name) for name in ("dpa_omf", "reference"))
    expected = found(runs, "dpa_omf", "reference", COMMON)
    for each in differences_of_files(mine, base):
        assert each == expected[each.measure]
    (alone,) = [each for each in differences_of_files(mine / "10.json", base / "10.json") if each.measure == "realism"]
    assert alone.interval.num_seeds == 1 and alone.interval.over == "scenes"


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"scenes": "b"}, "were evaluated with other 'scenes', a and b; evaluate both with the same"),
        ({"evaluation": {"num_rollouts": 8}}, "with other 'evaluation', {'num_rollouts': 32} and {'num_rollouts': 8}"),
        ({"seed": 3}, "8.json are both of seed 3; give a folder with one for each"),
        (None, "has no evaluation, a file NAME.json"),
    ],
)
def test_evaluations_that_cannot_be_paired_are_refused(other: dict | None, message: str, tmp_path: Path) -> None:
    mine = lay_out(tmp_path / "mine", "dpa_omf")
    base = tmp_path / "base"
    if other is None:
        base.mkdir()
    else:
        lay_out(base, "reference", **other)
    with pytest.raises(ValueError, match=re.escape(message)):
        list(differences_of_files(mine, base))


def test_seeds_and_files_that_are_not_there_are_told(tmp_path: Path) -> None:
    mine = lay_out(tmp_path / "mine", "dpa_omf")
    with pytest.raises(ValueError, match="10.json has seeds 0; evaluate both with the same `seed`s"):
        list(differences_of_files(mine, mine / "10.json"))
    with pytest.raises(ValueError, match="nothing is no evaluation .*for two methods of an experiment say RUNS EXPER"):
        list(differences_of_files(mine, Path("nothing")))


def test_likelihoods_are_no_evaluations(tmp_path: Path) -> None:
    for name in ("mine", "base"):
        content = {"options": {"seed": 0, "scenes": "a"}, "per_scene": {"kl": [0.1]}}
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="mine.json is no evaluation .* its options lack evaluation, ranking"):
        list(differences_of_files(tmp_path / "mine.json", tmp_path / "base.json"))


@pytest.mark.parametrize("seeds", [1, 3])
def test_the_table_of_one_training_run_says_so(
    seeds: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    paths = [lay_out(tmp_path / name, name) for name in ("dpa_omf", "reference")]
    given = [str(path / "10.json" if seeds == 1 else path) for path in paths]
    monkeypatch.setattr(sys, "argv", ["difference", *given])
    difference.main()
    told = " ".join(capsys.readouterr().out.split())
    assert ("one training run: intervals are over its scenes alone" in told) == (seeds == 1)


def test_the_table_tells_what_is_certain_from_what_is_not(
    runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(sys, "argv", ["difference", str(runs), "methods", "dpa_omf"])
    difference.main()
    told = capsys.readouterr().out
    realism = found(runs, "dpa_omf", "reference")["realism"].interval
    assert "dpa_omf minus reference" in told
    assert f"{realism.mean:+.4f} [{realism.low:+.4f}, {realism.high:+.4f}]" in told
