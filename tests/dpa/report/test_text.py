"""The tables of a study as a document: the numbers of the files, each under its own title."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpa.report.experiment import in_words, read_experiment
from dpa.report.matched import matched_difference
from dpa.report.statistics import paired_bootstrap
from dpa.report.study import Evaluations
from dpa.report.table import difference, number
from recipes.report import report
from tests.dpa.report.runs import BEST, COMMON, GRID, SEEDS, values, write_experiment, write_runs


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_runs(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def text(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    out = tmp_path_factory.mktemp("text") / "new" / "tables.md"
    assert report(runs, out) == out
    return out.read_text(encoding="utf-8")


def block(text: str, title: str) -> str:
    """One experiment."""
    return text.partition(f"## {title}\n")[2].partition("\n## ")[0]


def rows_of(text: str, start: str) -> dict[str, dict[str, list[str]]]:
    """The table after a line, ``{label: {column: cells}}``."""
    lines = text.partition(start)[2].partition("\n\n")[2].partition("\n\n")[0].splitlines()
    titles, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    found: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        for title, cell in zip(titles, row, strict=True):
            found.setdefault(row[0], {}).setdefault(title, []).append(cell)
    return found


def test_every_experiment_has_a_block_with_its_command_seeds_and_date(runs: Path, text: str) -> None:
    for path in (runs / "experiments").glob("*.json"):
        experiment = read_experiment(path)
        told = block(text, experiment.title)
        assert f"    {experiment.command}" in told and experiment.question in told
        assert f"seeds {', '.join(map(str, experiment.seeds))}" in told and experiment.date[:10] in told


def test_values_and_differences_are_those_of_the_files(runs: Path, text: str) -> None:
    methods = read_experiment(runs / "experiments" / "methods.json")
    told = block(text, methods.title)
    for start, comparison in (("**Each", methods.own_best), ("**All", methods.at_common)):
        table = rows_of(told, start)
        for record in comparison.records():
            shown = table[methods.labels[record["method"]]]
            assert number(record["realism"], 3) in shown["realism ↑"]
            assert difference(record["realism_difference"], record["ci95"]) in shown["Δ realism [95 %]"]
    own = rows_of(told, "**Each")
    for entry in methods.own_best.versus:
        expected = difference(entry["realism_difference"], entry["ci95"])
        assert own[methods.labels[entry["method"]]]["Δ to DPA-OMF"] == [expected]
    assert own["DPA-OMF"]["steps"] == ["60"] and own["reference"]["steps"] == ["–"]
    paper = own["*paper: DPA-OMF*"]
    assert (paper["realism ↑"], paper["interactive ↑"], paper["steps"]) == (["0.739"], ["–"], ["–"])


def test_what_was_sampled_in_one_way_alone_has_one_table(tmp_path: Path) -> None:
    write_experiment(tmp_path, "methods", ["reference", "dpa_omf", "dpa_adef"], grid=(COMMON,))
    told = report(tmp_path, tmp_path / "tables.md").read_text(encoding="utf-8")
    assert told.count("| method | steps |") == 1 and "**Each" not in told and "common decoding" not in told
    rows = rows_of(told, "**All at top-p 0.95**, the one decoding")
    assert list(rows) == ["reference", "DPA-OMF", "DPA-ADEF"] and "Δ to DPA-OMF" in rows["DPA-ADEF"]


def test_safety_has_rates_with_their_differences(runs: Path, text: str) -> None:
    methods = read_experiment(runs / "experiments" / "methods.json")
    table = rows_of(block(text, methods.title), "**Safety, and what it costs**")
    assert list(table["reference"])[1:] == [
        "wrong way",
        "red light",
        "close pass",
        "harsh jerk",
        "standing moved",
        "collision",
        "off-road",
        "minADE [m]",
        "spread [m]",
    ]
    mine, base = ([values(name, seed, BEST)["harsh_jerk"] for seed in SEEDS] for name in ("dpa_omf", "reference"))
    both = np.array([mine, base], dtype=float)
    both = both[:, :, ~np.isnan(both).any((0, 1))]
    change = paired_bootstrap(both[0], both[1])
    cell = f"{np.nanmean(np.array(mine, dtype=float)):.3f} ({difference(change.mean, (change.low, change.high))})"
    assert table["DPA-OMF"]["harsh jerk"] == [cell]


def test_what_safety_costs_is_told_at_the_common_decoding_too(runs: Path, text: str) -> None:
    methods = read_experiment(runs / "experiments" / "methods.json")
    table = rows_of(block(text, methods.title), "**Safety, and what it costs, at the common decoding**")
    others = {name for name in table if name.startswith("reference, ")}
    assert others == {f"reference, {in_words(each)}" for each in GRID} - {f"reference, {in_words(COMMON)}"}
    mine, base = (
        np.array([values(name, seed, COMMON)["spread"] for seed in SEEDS]) for name in ("dpa_omf", "reference")
    )
    change = paired_bootstrap(mine, base)
    assert table["DPA-OMF"]["spread [m]"] == [
        f"{mine.mean():.1f} ({difference(change.mean, (change.low, change.high), 1)})"
    ]


def test_likelihoods_are_means_over_seeds(runs: Path, text: str) -> None:
    methods = read_experiment(runs / "experiments" / "methods.json")
    mine = [row["nll_preferred"] for row in methods.likelihood if row["method"] == "dpa_omf"]
    table = rows_of(block(text, methods.title), "**Likelihood**")
    assert table["DPA-OMF"]["NLL preferred"] == [f"{number(sum(mine) / len(mine), 3)} (−0.300 [−0.300, −0.300])"]
    assert table["reference"]["NLL preferred"] == ["2.000"]


def test_table_3_has_both_learners_their_differences_and_the_papers(text: str, runs: Path) -> None:
    methods = read_experiment(runs / "experiments" / "methods.json")
    table = rows_of(block(text, methods.title), "**Who learns the ranking**")
    assert list(table) == [
        "DPA-OMF", "adversarial AFD", "DPA-OMF − adversarial AFD", "DPA-OMF − reference", "*paper: DPA-OMF*",
        "*paper: adversarial AFD*",
    ]  # fmt: skip
    assert [row["pair accuracy ↑"] for row in table.values()] == [
        ["0.650"], ["0.510"], ["+0.140 [+0.140, +0.140]"], ["+0.140 [+0.140, +0.140]"], ["0.840"], ["–"],
    ]  # fmt: skip
    mine, base = (np.array([values(m, s, COMMON)["realism"] for s in SEEDS]) for m in ("dpa_omf", "adversarial_afd"))
    found = paired_bootstrap(mine, base)
    assert table["DPA-OMF − adversarial AFD"]["realism ↑"] == [difference(found.mean, (found.low, found.high))]
    scaling = read_experiment(runs / "experiments" / "scaling.json")
    assert "Who learns" not in block(text, scaling.title), "its methods are not there"


def test_equal_sharpness_is_of_the_reported_scenes_for_every_method_at_its_best_and_at_the_common_decoding(
    text: str, runs: Path
) -> None:
    methods, files = read_experiment(runs / "experiments" / "methods.json"), Evaluations(runs)
    base = [methods.at_common.of("reference", decoding) for decoding in GRID]
    expected: dict[str, list[str]] = {}
    for method in methods.methods[1:]:
        compared = {methods.chosen[method]: methods.own_best, methods.common: methods.at_common}
        found = [matched_difference(each.of(method, at), base, files) for at, each in compared.items()]
        told = [difference(each.change.mean, (each.change.low, each.change.high)) for each in found if each is not None]
        assert len(told) == len(compared)
        expected[methods.labels[method]] = told
    table = rows_of(block(text, methods.title), "**At equal sharpness**")
    assert {name: cells["Δ realism [95 %]"] for name, cells in table.items()} == expected


def test_minutes_are_told_until_each_snapshot_where_snapshots_were_evaluated(text: str, runs: Path) -> None:
    steps = read_experiment(runs / "experiments" / "steps.json")
    table = rows_of(block(text, steps.title), "**Minutes of one worker**")
    assert table.keys() == {steps.labels[method] for method in steps.compute}
    taken = steps.own_best.steps
    for method in steps.compute:
        policies = sorted((m for m in steps.methods if m.partition("@")[0] == method), key=lambda m: taken[m])
        until = ", ".join(f"{5 + 10 * taken[m] / 60:.1f}" for m in policies)
        cells = table[steps.labels[method]]
        assert (cells["before training"], cells["until each snapshot, all in all"]) == (["5.0"], [until])
    methods = read_experiment(runs / "experiments" / "methods.json")
    assert "**Minutes of one worker**" not in block(text, methods.title), "none of its snapshots was evaluated"


def test_the_account_has_every_experiment_and_adds_up(text: str, runs: Path) -> None:
    titles, _, *lines = block(text, "Time of one worker").strip().splitlines()
    names = [cell.strip() for cell in titles.strip("|").split("|")]
    rows = [dict(zip(names, (cell.strip() for cell in line.strip("|").split("|")), strict=True)) for line in lines]
    assert names[0] == "experiment" and rows[-1]["experiment"] == "all, each job once"
    assert (rows[-1]["pretrain"], rows[-1]["all"]) == ("1 h 30 min", "2 h 0 min")
    titles_of = [read_experiment(path).title for path in (runs / "experiments").glob("*.json")]
    assert sorted(row["experiment"] for row in rows[:-1]) == sorted(titles_of)
    assert {(row["pretrain"], row["align"], row["all"]) for row in rows[:-1]} == {
        ("1 h 30 min", "2 min 5 s", "1 h 32 min")
    }


if __name__ == "__main__":
    pytest.main([__file__])
