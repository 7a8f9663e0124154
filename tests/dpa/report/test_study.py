"""Every section of a study's page shows the numbers of its files, and what is missing is named."""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpa.report.charts import _rounded
from dpa.report.experiment import Comparison
from dpa.report.matched import matched_difference
from dpa.report.page import write_study
from dpa.report.sections.results import DPO
from dpa.report.statistics import paired_bootstrap
from dpa.report.study import Evaluations, read_study
from dpa.report.table import difference, number, signed
from recipes import report as recipe
from recipes.report import report
from tests.dpa.report.parsed import Page
from tests.dpa.report.runs import AXIS, BEST, COMMON, GRID, ROLLED, SEEDS, label, values, write, write_experiment


@pytest.fixture(scope="module")
def page(study_page: Path) -> Page:
    return Page(study_page.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def methods(runs: Path) -> dict[str, Any]:
    return read(runs, "experiments/methods.json")


@pytest.fixture
def copied(runs: Path, tmp_path: Path) -> Path:
    """Results that a test may change."""
    return Path(shutil.copytree(runs, tmp_path / "copy"))


def read(runs: Path, name: str) -> Any:
    return json.loads((runs / name).read_text(encoding="utf-8"))


def table(page: Page, *head: str) -> list[list[str]]:
    """Rows of the first table whose titles begin like this."""
    for rows in page.tables:
        if tuple(clean(cell) for cell in rows[0][: len(head)]) == head:
            return [[clean(cell) for cell in row] for row in rows[1:]]
    raise AssertionError(f"no table {head}; there are {[rows[0] for rows in page.tables]}")


def clean(text: str) -> str:
    return text.replace("\N{NO-BREAK SPACE}", " ").replace("\N{NON-BREAKING HYPHEN}", "-")


KINEMATIC = "kinematic\N{NO-BREAK SPACE}↑"
"""Title by which a table of results is known."""


def stacked(mean: float, ci95: Any, digits: int = 3) -> str:
    """A difference and its interval as a cell has them, one above the other."""
    return f"{signed(mean, digits)}[{', '.join(signed(end, digits) for end in ci95)}]"


def paired(key: str, method: str, other: str, decoding: tuple[float, float]) -> str:
    """Difference of a figure with its interval, from the values of every scene."""
    mine, base = (np.array([values(m, s, decoding)[key] for s in SEEDS], dtype=float) for m in (method, other))
    known = ~np.isnan([*mine, *base]).any(0)
    found = paired_bootstrap(mine[:, known], base[:, known])
    return stacked(found.mean, (found.low, found.high))


def figures(page: Page, axis: str) -> list[dict[str, Any]]:
    """Figures whose x axis has this title."""
    plots = [data for data in page.data if "layout" in data]
    return [plot for plot in plots if plot["layout"]["xaxis"]["title"]["text"] == axis]


def trace(figure: dict[str, Any], name: str) -> dict[str, Any]:
    return next(each for each in figure["data"] if each.get("name") == name and each["x"] != [None])


def mean(rows: list[dict[str, Any]], method: str, key: str, decoding: tuple[float, float]) -> float:
    found = [row[key] for row in rows if (row["method"], row["top_p"], row["temperature"]) == (method, *decoding)]
    assert len(found) == len(SEEDS)
    return sum(found) / len(found)


def test_the_page_is_balanced_html_that_forbids_the_network(study_page: Path, page: Page) -> None:
    text = study_page.read_text(encoding="utf-8")
    policy = "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
    assert policy in text
    assert "<!--{" not in text
    identities = [value for _, name, value in page.attributes if name == "id"]
    assert len(identities) == len(set(identities))
    links = [value for tag, name, value in page.attributes if name == "href"]
    assert links and {link.removeprefix("#") for link in links} <= set(identities)
    assert not [value for _, name, value in page.attributes if name == "src" and not value.startswith("data:")]


def test_text_of_others_is_shown_and_not_run(page: Page) -> None:
    for wanted in ("Is <this> a test?", "made & up <by hand>", "'name=<b>'", '"mark": "<!--{title}-->"'):
        assert wanted in page.text


def test_the_headline_has_the_difference_at_own_best_and_the_common_one_beside_it(
    page: Page, methods: dict[str, Any]
) -> None:
    own, common = (
        next(entry for entry in paired if entry["method"] == "dpa_omf")
        for paired in (methods["own_best"]["paired"], methods["paired"])
    )
    gain = f"{own['realism_difference']:.3f} more realistic than the reference on 12 evaluation scenes"
    assert f"DPA-OMF is {gain}" in page.text
    assert "of the experiment Made-up methods" in page.text
    for entry in (own, common):
        low, high = entry["ci95"]
        assert f"+{entry['realism_difference']:.3f} [+{low:.3f}, +{high:.3f}] realism, 95 %" in spaced(page)


def spaced(page: Page) -> str:
    return re.sub(r"(?<=\d)\[", " [", page.text)


@pytest.mark.parametrize("common", [False, True])
def test_a_table_has_means_over_seeds_intervals_and_published_numbers(
    common: bool, page: Page, methods: dict[str, Any]
) -> None:
    tables = [rows for rows in page.tables if rows[0][:2] == ["method", KINEMATIC]]
    of = methods if common else methods["own_best"]
    rows, (entry, *_) = of["rows"], of["paired"]
    decoding = COMMON if common else BEST
    cells = next(row for row in tables[int(common)] if row[0] == f"DPA-OMFtop-p {decoding[0]:g}, 60 steps")
    published = {"kinematic": "paper 0.415", "realism": "paper 0.739", "min_ade": "paper 1.413"}
    for cell, key in zip(cells[1:6], ("kinematic", "interactive", "map_based", "realism", "min_ade"), strict=True):
        change = paired(key, "dpa_omf", "reference", decoding)
        if key == "realism":
            change = stacked(entry["realism_difference"], entry["ci95"])
        assert cell == number(mean(rows, "dpa_omf", key, decoding), 3) + change + published.get(key, ""), key
    assert all(f"seed_{seed}/dpa_omf/eval_top_p_{decoding[0]:g}_t_1.json" in cells[-1] for seed in SEEDS)


def test_methods_are_compared_with_the_headlines_in_a_column_and_a_forest(page: Page, methods: dict[str, Any]) -> None:
    head, *rows = next(rows for rows in page.tables if rows[0][:2] == ["method", KINEMATIC])
    place = [clean(title) for title in head].index("Δ realism to DPA-OMF")
    cells = {row[0].partition("top-p 0.85")[0]: row[place] for row in rows}
    versus = {entry["method"]: entry for entry in methods["own_best"]["versus"]}
    assert set(versus) == {"dpa_adef", "adversarial_afd"}
    for method, entry in versus.items():
        assert cells[label(method)] == stacked(entry["realism_difference"], entry["ci95"])
    assert cells["reference"] == cells["DPA-OMF"] == "–"
    forest = trace(figures(page, "difference in realism to DPA-OMF")[0], "own best")
    assert forest["x"] == [_rounded(entry["realism_difference"]) for entry in versus.values()]
    low, high = figures(page, "difference in realism to DPA-OMF")[0]["layout"]["xaxis"]["range"]
    assert low < 0 < high, "0 is in sight, though all are worse"
    assert "against DPA-OMF at top-p 0.85" in forest["hovertext"][0] and "by seed: " in forest["hovertext"][0]
    assert "Against DPA-OMF, worse: DPA-ADEF; adversarial AFD." in page.text


def test_safety_is_paired_scene_by_scene_where_all_have_a_value(page: Page) -> None:
    cells = next(row for row in table(page, "method", "wrong way ↓") if row[0] == "DPA-OMF")
    assert len(cells) == 3
    assert cells[2].endswith(paired("red_light", "dpa_omf", "reference", BEST))


def test_safety_that_the_ranking_sees_stands_apart(page: Page) -> None:
    assert [clean(cell) for cell in safety(page, "collision ↓")] == ["method", "collision ↓", "off-road ↓"]
    assert [clean(cell) for cell in safety(page, "wrong way ↓")] == ["method", "wrong way ↓", "red light ↓"]
    related = ["method", "close pass ↓", "harsh jerk ↓", "standing moved ↓"]
    assert [clean(cell) for cell in safety(page, "close pass ↓")] == related
    assert "Safety that neither the paper's preference distance nor the metric sees" in page.text


def test_red_lights_stand_apart_where_the_metric_weighs_them(copied: Path, tmp_path: Path) -> None:
    change(copied, "methods", metric="2025")
    page = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    assert "Safety that the metric of 2025 sees, and the paper's preference distance does not" in page.text
    assert [clean(cell) for cell in safety(page, "red light ↓")] == ["method", "red light ↓"]
    assert "red light ↓" not in map(clean, safety(page, "wrong way ↓"))


def safety(page: Page, title: str) -> list[str]:
    """Titles of the first table whose second column is this."""
    return next(rows[0] for rows in page.tables if clean(rows[0][1]) == title)


def change(runs: Path, name: str, **changes: Any) -> None:
    """Other entries in an experiment's file."""
    path = runs / "experiments" / f"{name}.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | changes), encoding="utf-8")


def test_a_method_that_did_not_run_has_no_row_of_the_papers(copied: Path, tmp_path: Path) -> None:
    change(copied, "methods", published={"dpa_omf": {"realism": 0.739}, "nobody": {"realism": 0.1234}})
    told = report(copied, tmp_path / "tables.md").read_text(encoding="utf-8")
    assert "*paper: DPA-OMF*" in told and "0.123" not in told


def test_a_folder_with_a_dot_in_its_name_holds_a_page(copied: Path, tmp_path: Path) -> None:
    (tmp_path / "v0.1").mkdir()
    assert report(copied, tmp_path / "v0.1") == tmp_path / "v0.1" / "index.html"


def test_safety_without_the_files_behind_it_has_no_intervals(copied: Path, tmp_path: Path) -> None:
    for file in copied.glob("seed_*/dpa_omf/eval_*.json"):
        file.unlink()
    page = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    cells = next(row for row in table(page, "method", "collision ↓") if row[0] == "DPA-OMF")
    assert all(re.fullmatch(r"\d\.\d{3}", cell) for cell in cells[1:])
    cells = next(row for row in table(page, "method", "kinematic ↑") if row[0].startswith("DPA-OMF"))
    assert re.fullmatch(r"\d\.\d{3}", cells[2])


def test_the_forest_holds_every_interval_with_its_seeds(page: Page, methods: dict[str, Any]) -> None:
    forest = figures(page, "difference in realism")[0]
    for kind, paired in (("own best", methods["own_best"]["paired"]), ("common", methods["paired"])):
        assert sorted(trace(forest, kind)["x"]) == sorted(_rounded(entry["realism_difference"]) for entry in paired)
    hover = trace(forest, "own best")["hovertext"][0]
    entry = methods["own_best"]["paired"][0]
    assert difference(entry["realism_difference"], entry["ci95"]) in hover and "3 seeds" in hover
    assert "against the reference at top-p 0.85" in hover and "by seed: " in hover
    assert len(trace(forest, "common")["x"]) == 5  # the reference at the two other decodings too


def test_decoding_matched_curves_have_realism_over_spread_and_mark_the_chosen_decoding(
    page: Page, methods: dict[str, Any], runs: Path
) -> None:
    figure = figures(page, "spread of the rollouts of a scene [m]")[0]
    line = trace(figure, "DPA-OMF")
    assert line["x"] == sorted(line["x"])
    place = line["marker"]["size"].index(max(line["marker"]["size"]))
    assert line["x"][place] == _rounded(mean(methods["tuning"], "dpa_omf", "spread", BEST))
    assert line["y"][place] == _rounded(mean(methods["tuning"], "dpa_omf", "realism", BEST))
    assert "DPA-OMF, chosen" in line["hovertext"][place]
    files = Evaluations(runs)
    tuned = Comparison(methods["tuning"], [])
    base = [tuned.of("reference", decoding) for decoding in GRID]
    at = {_rounded(mean(methods["tuning"], "dpa_omf", "spread", each)): each for each in GRID}
    bars = zip(line["error_y"]["array"], line["error_y"]["arrayminus"], strict=True)
    for x, hover, (up, down) in zip(line["x"], line["hovertext"], bars, strict=True):
        found = matched_difference(tuned.of("dpa_omf", at[x]), base, files)
        assert found is not None and "at equal sharpness" in hover
        change = found.change
        assert (up, down) == pytest.approx((change.high - change.mean, change.mean - change.low), rel=1e-4)
    assert any(line["error_y"]["array"]) and "error_y" not in trace(figure, "reference")


def test_table_3_has_pair_accuracy_realism_and_min_ade(page: Page, methods: dict[str, Any]) -> None:
    first, second, to_afd, to_reference = table(page, "method", "pair accuracy ↑", "realism ↑")
    realism = number(mean(methods["rows"], "dpa_omf", "realism", COMMON), 3)
    assert first[:3] == ["DPA-OMF", "0.650paper 0.840", f"{realism}paper 0.739"]
    assert second[:2] == ["adversarial AFD", "0.510"]
    for cells, other in ((to_afd, "adversarial_afd"), (to_reference, "reference")):
        assert cells[:2] == [f"DPA-OMF − {label(other)}", "+0.140[+0.140, +0.140]"]
        assert cells[2:] == [paired(key, "dpa_omf", other, COMMON) for key in ("realism", "min_ade")]


def test_likelihood_is_a_table_that_names_its_files(page: Page) -> None:
    cells = next(row for row in table(page, "method", "pair accuracy ↑", "reward accuracy ↑") if row[0] == "DPA-OMF")
    assert cells[1:3] == ["0.650+0.140[+0.140, +0.140]", "0.700+0.200[+0.200, +0.200]"]
    assert cells[3:5] == ["1.700−0.300[−0.300, −0.300]", "2.500+0.400[+0.400, +0.400]"]
    assert cells[5:7] == ["4.0000.000[0.000, 0.000]", "1.9000.000[0.000, 0.000]"]
    scenes = np.tile(0.3 + np.linspace(-0.1, 0.1, 12), (3, 1))
    kl = paired_bootstrap(scenes, 0 * scenes)
    assert cells[7] == "0.3000" + stacked(kl.mean, (kl.low, kl.high), 4)
    assert "seed_2/dpa_omf/likelihood_eval.json" in cells[8]


def test_likelihood_along_training_has_a_line_for_each_seed_and_their_mean(page: Page) -> None:
    figure = figures(page, "step")[0]
    lines = [each for each in figure["data"] if each["name"] == "preferred"]
    assert [each["line"]["width"] for each in lines] == [1, 1, 1, 2.6]
    assert {line["y"][0] for line in lines} == {0} and lines[0]["x"][-1] == 60
    assert lines[0]["y"][-1] == pytest.approx(-0.3) and lines[3]["y"][-1] == pytest.approx(-0.3)
    shown = {figure["layout"]["yaxis"]["title"]["text"] for figure in figures(page, "step")}
    assert shown == {
        "change of NLL [nats per token]", "standard deviation of the logits", "share of pairs", "KL per token [nats]",
        "entropy per token [nats]",
    }  # fmt: skip


def test_scaling_stands_over_its_axis_with_intervals(page: Page, runs: Path) -> None:
    (figure,) = figures(page, "rankings per scene")
    paired = read(runs, "experiments/scaling.json")["own_best"]["paired"]
    line = trace(figure, "own best")
    assert (line["x"], figure["layout"]["xaxis"]["type"]) == ([1, 4, 16], "log")
    assert line["y"] == [_rounded(entry["realism_difference"]) for entry in paired]
    assert line["error_y"]["array"] == [_rounded(e["ci95"][1] - e["realism_difference"]) for e in paired]


def test_snapshots_stand_over_their_distance_from_the_reference_in_order_of_steps(page: Page, runs: Path) -> None:
    figure = next(
        each for each in figures(page, "KL to the reference [nats per token]") if "DPA-OMF" in each["data"][0]["name"]
    )
    line = trace(figure, "DPA-OMF, own best")
    assert line["x"] == pytest.approx([0, 0.1, 0.2, 0.3])
    paired = {entry["method"]: entry for entry in read(runs, "experiments/steps.json")["own_best"]["paired"]}
    gains = [paired[name]["realism_difference"] for name in ("dpa_omf@20", "dpa_omf@40", "dpa_omf")]
    assert line["y"] == pytest.approx([0, *gains], rel=1e-4)


def test_what_is_scaled_stands_over_the_distance_from_the_reference_too(page: Page, runs: Path) -> None:
    figure = next(
        each for each in figures(page, "KL to the reference [nats per token]") if "rankings" in each["data"][0]["name"]
    )
    line = trace(figure, "rankings per scene, own best")
    found = read(runs, "experiments/scaling.json")
    kl = [np.mean([row["kl"] for row in found["likelihood"] if row["method"] == name]) for name in ("r1", "r4", "r16")]
    assert line["x"] == pytest.approx(kl, rel=1e-4) and line["text"] == ["1", "4", "16"]
    assert line["y"] == [_rounded(entry["realism_difference"]) for entry in found["own_best"]["paired"]]
    assert line["error_y"]["array"] == [
        _rounded(e["ci95"][1] - e["realism_difference"]) for e in found["own_best"]["paired"]
    ]


def test_what_was_sampled_in_one_way_alone_is_shown_once(copied: Path, tmp_path: Path) -> None:
    for path in copied.glob("experiments/*.json"):
        if path.stem != "scaling":
            path.unlink()
    write_experiment(copied, "scaling", ["reference", "r1", "r4", "r16"], headline="r16", axis=AXIS, grid=(COMMON,))
    page = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    assert len(table(page, "method", "kinematic ↑")) == 4 and "one decoding, top-p 0.95" in page.text
    assert "best decoding" not in page.text and "common decoding" not in page.text
    assert page.text.count("Sampled alike at top-p 0.95") == 2, "the headline, and the other methods to it"
    for axis in ("difference in realism", "difference in realism to 16 rankings", "rankings per scene"):
        (figure,) = figures(page, axis)
        assert {each["name"] for each in figure["data"] if each.get("name")} == {"top-p 0.95"}
    assert "5 differences of realism" in page.text, "three to the reference, two to the headline"


def test_the_validity_of_a_distance_is_a_figure_and_a_table(page: Page, runs: Path) -> None:
    omf = read(runs, "validity/summary.json")["rankings"]["omf"]
    (figure,) = figures(page, "distance over the scene's mean")
    assert trace(figure, "omf")["y"] == [_rounded(window["mean"]) for window in omf["realism"]]
    assert table(page, "ranking", "Spearman")[0][1] == told(omf["correlation"])
    assert page.text.count("12 tuning scenes, 1 policy, 16 rollouts of each scene.") == 3


def test_what_options_change_is_a_figure_and_a_table(page: Page, runs: Path) -> None:
    found = read(runs, "sensitivity/summary.json")
    names = list(found["variants"])
    (heat,) = figures(page, "gap of the pair")
    shares = [[margin[name]["mean"] for margin in found["margins"].values()] for name in names]
    assert heat["data"][0]["z"] == _rounded(shares)
    cells = {row[0]: row[1:] for row in table(page, "variant", "Spearman")}
    variant = found["variants"]["time-aligned"]
    means = [number(variant[key]["mean"], 3) for key in ("correlation", "overlap", "turned")]
    assert [cell.split()[0] for cell in cells["time-aligned"]] == [*means, "0.400"]
    assert "python -m recipes.sensitivity" in page.text


def test_what_a_discriminator_ranks_by_is_a_table_with_the_answer_below(page: Page, runs: Path) -> None:
    found = read(runs, "discriminator/summary.json")
    rows = {row[0]: row[1:] for row in table(page, "within a scene", "discriminator")}
    assert rows["collision rate"] == ["–"] * 4
    assert rows["preference distance"][0] == told(found["correlation"]["distance"]["discriminator"])
    answer = found["jerk_minus_distance"]
    assert answer["ci95"][0] > 0
    assert f"How much more strongly by jerk than by the preference distance: {told(answer)}." in page.text
    assert "Held-out AUC for each policy, the best of all looks, by which training stops: 0 0.910." in page.text


def test_studies_say_which_code_made_them_and_on_what(page: Page, runs: Path, copied: Path, tmp_path: Path) -> None:
    made = read(runs, "validity/summary.json")["made"]
    versions = ", ".join(f"{name} {version}" for name, version in made["versions"].items())
    for told_ in (made["date"], made["revision"], made["machine"], versions):
        assert page.text.count(str(told_)) >= 3, "in each of the studies"
    older = read(copied, "validity/summary.json")
    for key in ("date", "revision", "machine", "versions"):
        del older["made"][key]
    write(copied / "validity/summary.json", older)
    again = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    assert again.text.count(versions) == page.text.count(versions) - 1, "what was not kept is a dash, not a guess"


def told(value: dict[str, Any]) -> str:
    return difference(value["mean"], value["ci95"])


def test_stages_cards_and_the_way_to_make_it_again_are_there(page: Page) -> None:
    *experiments, every = table(page, "experiment", "pretrain")
    assert len(experiments) > 1 and {tuple(row[1:]) for row in experiments} == {
        ("1 h 30 min", "2 min 5 s", "1 h 32 min")
    }
    assert every == ["all, each job once", "1 h 30 min", "30 min 0 s", "2 h 0 min"]
    (hours,) = figures(page, "hours")
    assert hours["data"][0]["x"] == [1.5, 0.5]
    (titles,) = (rows[0] for rows in page.tables if rows[0][0] == "store")
    stores = table(page, "store", "scenes", "rollouts per scene")
    assert [row[0] for row in stores] == ["seed 0, train", "seed 1, train"]
    assert [row[2] for row in stores] == ["8", "8"] and "distance made of speed" in titles
    wanted = ("recipes.compare experiment=methods", "torch 2.13.0", "Linux x86_64, 2 CPU cores", "2026-11-21")
    for each in (*wanted, "worker time1 h 32 min", "code0123abc"):
        assert each in page.text
    assert table(page, "method", "steps")[0] == ["DPA-OMF", "60", "960", "reference"]


def test_the_scenes_of_every_split_have_a_data_card(page: Page) -> None:
    (head,) = (rows[0] for rows in page.tables if [*map(clean, rows[0][:2])] == ["split", "from"])
    rows = [dict(zip(map(clean, head), row, strict=True)) for row in table(page, "split", "from")]
    assert [row["split"] for row in rows] == ["training", "tuning", "evaluation"]
    assert {row["from"] for row in rows} == {"made & up"}
    assert [row["scenes"] for row in rows] == ["2", "1", "1"]
    assert [row["scenes with traffic lights"] for row in rows] == ["0 (0%)", "1 (100%)", "0 (0%)"]
    assert rows[0]["agents at the current step"] == "5 (2.5 in a scene)" and rows[0]["vehicle"] == "5"
    assert rows[0]["valid states"] == "100% of agents x 91 steps"
    assert list(rows[0])[-1] == "lacks"
    classes = table(page, "agents at the current step", "in all")
    assert classes[0] == ["training, vehicle", "5", "2.5", "10-11 / 10-11 m/s", "9-10 s", "90-100 m", "4.5-5 m"]
    assert table(page, "split", "source")[2] == ["evaluation", "made & up", "<any>", "1", "some/folder"]
    assert table(page, "map, in a scene", "polylines")[0][0] == "training, lane"


def test_a_study_without_data_cards_of_its_scenes_says_how_to_get_them(copied: Path, tmp_path: Path) -> None:
    (copied / "scenes.json").unlink()
    change(copied, "methods", command="python -m recipes.compare experiment=methods 'seeds=[0,1,2]' output=elsewhere")
    page = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    assert not [rows for rows in page.tables if rows[0][:2] == ["split", "from"]]
    again = f"python -m recipes.compare experiment=methods 'seeds=[0,1,2]' output={copied}"
    assert f"data cards of the scenes: {again}" in page.text.partition("Not here yet")[2]


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        (["splits"], [], "['splits'] is []"),
        (["splits", "eval"], {"counts": {}}, "['splits']['eval'] is {'counts': {}}"),
        (["splits", "eval", "counts", "scenes", "all"], 0.5, "['scenes']['all'] is 0.5"),
        (["splits", "tune", "origins"], [{"source": "womd"}], "['origins'][0] is {'source': 'womd'}"),
    ],
)
def test_data_cards_of_another_shape_are_told(copied: Path, path: list[str], value: Any, told: str) -> None:
    content = read(copied, "scenes.json")
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    (copied / "scenes.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"scenes\.json is no account of what the scenes of a study hold") as error:
        read_study(copied)
    assert told in str(error.value)


@pytest.mark.parametrize(
    "counts",
    [
        {},
        {"scenes": {"all": 0, "with lights": 0}, "states": {"all": 0, "valid": 0}},
        {"agents": {"vehicle": 3}, "speed vehicle": {}},
        {"agents": {"vehicle": 3}, "speed vehicle": {"fast": 3}},
        {"agents": {"vehicle": 3}, "speed vehicle": {"9" * 400: 3}},
        {"polylines": {"lane": 3}, "points": {}},
    ],
)
def test_counts_that_make_no_card_are_told(copied: Path, counts: dict[str, Any]) -> None:
    content = read(copied, "scenes.json")
    known = content["splits"]["eval"]["counts"]
    content["splits"]["eval"]["counts"] = known | counts if counts else {}
    (copied / "scenes.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"scenes\.json is no account of what the scenes of a study hold"):
        read_study(copied)


def test_methods_that_train_on_more_are_named(copied: Path, tmp_path: Path) -> None:
    budget = read(copied, "experiments/methods.json")["budget"]
    budget["dpa_adef"] |= {"steps": 120, "rollouts": 1920}
    change(copied, "methods", budget=budget)
    page = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    told = "Budgets differ. Against that of DPA-OMF, 2 times the steps, 2 times the rollouts: DPA-ADEF."
    assert page.text.count(told) == 2  # at the top, and beside the tables


def test_methods_whose_loss_saturated_are_named_with_their_seeds(page: Page, copied: Path, tmp_path: Path) -> None:
    for seed in SEEDS:
        for method, warned in (("dpa_omf", False), ("dpa_adef", seed > 0)):
            result = {"options": {}} | ({"saturated": "75 % of the pairs"} if warned else {})
            write(copied / f"seed_{seed}" / method / "result.json", result)
    told = "Saturated: DPA-ADEF (2 of 3 seeds)."
    assert Page(report(copied, tmp_path / "out").read_text(encoding="utf-8")).text.count(told) == 1
    assert report(copied, tmp_path / "tables.md").read_text(encoding="utf-8").count(told) == 1
    assert "Saturated: " not in page.text


def test_what_the_papers_method_is_here_is_said_below_its_table(page: Page, copied: Path, tmp_path: Path) -> None:
    told = "DPA-OMF here is eq. 4 with the reference term, which is DPO."
    assert page.text.count(told) == 2  # of either decoding
    for other in ({"reference": False}, {"link": "squared"}, {"conservative": 0.5}):
        change(copied, "methods", config=ROLLED | {"methods": {"dpa_omf": {"loss": DPO | other}}})
        assert told not in Page(report(copied, tmp_path / "out").read_text(encoding="utf-8")).text


def test_an_experiment_on_the_tuning_scenes_says_so_everywhere(tmp_path: Path) -> None:
    write_experiment(tmp_path, "settings", ["reference", "dpa_omf", "dpa_adef"], split="tune")
    page = Page(report(tmp_path, tmp_path / "out").read_text(encoding="utf-8"))
    assert "DPA-OMF is " in page.text, "the headline is of the first experiment where there is no 'methods'"
    for wanted in (
        "more realistic than the reference on 12 tuning scenes",
        "numbers are of the 12 tuning scenes",
        "Means over seeds on 12 tuning scenes",
        "ranked rollouts of the 12 tuning scenes",
        "Paired scene by scene on 12 tuning scenes",
    ):
        assert wanted in page.text
    assert "evaluation scenes" not in page.text.replace("8 training, 12 tuning and 12 evaluation scenes", "")
    assert page.text.count("Decodings were chosen on these very tuning scenes") == 2


def test_the_player_has_its_scenes(page: Page) -> None:
    data = next(data for data in page.data if "scenes" in data)
    assert [scene["id"] for scene in data["scenes"]] == ["</script><b>made up"]


def test_what_is_missing_is_named_with_its_command(copied: Path, tmp_path: Path) -> None:
    for name in ("validity", "discriminator"):
        shutil.rmtree(copied / name)
    (copied / "players.json").unlink()
    (copied / "experiments" / "steps.json").unlink()
    given = (
        "python -m recipes.compare scenes=made experiment=methods experiment.checkpoints=last '~methods.cpl' "
        "'only=[dpa_omf]' decoding.chosen=runs/first 'seeds=[0,1,2]' output=elsewhere"
    )
    scenes = {"source": "sumo", "train": "num_scenes=120,split=train", "tune": 16, "eval": "split=test", "limit": None}
    scenes |= {"select": {"max_agents": 24, "complete_in": ["lights"]}, "shard_size": 256}
    change(copied, "methods", command=given, config=ROLLED | {"scenes": scenes})
    study = read_study(copied)
    page = Page(write_study(tmp_path / "p.html", study, experiments=["methods", "steps"]).read_text(encoding="utf-8"))
    missing = page.text.partition("Not here yet")[2]
    for wanted in (
        "experiment steps: python -m recipes.compare experiment=steps scenes=made experiment.checkpoints=last "
        f"'seeds=[0,1,2]' output={copied}",
        "validity: python -m recipes.validity 'scenes.source=\"sumo\"' 'scenes.train=\"num_scenes=120,split=train\"' "
        "scenes.tune=16 'scenes.eval=\"split=test\"' scenes.limit=null scenes.select.max_agents=24 "
        "'scenes.select.complete_in=[\"lights\"]' scenes.shard_size=256 'policies=[POLICY.pt]'",
        "scenes to play: python -m recipes.compare scenes=made experiment.checkpoints=last 'seeds=[0,1,2]' "
        f"output={copied} pictures.scenes=3",
    ):
        assert wanted in missing
    assert "sensitivity: " not in missing and "experiment methods" not in missing
    assert "player-data" not in [value for _, _, value in page.attributes]


def test_a_study_of_rankings_alone_makes_a_page_without_a_claim(copied: Path, tmp_path: Path) -> None:
    shutil.rmtree(copied / "experiments")
    page = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    assert "No claim: the study has no experiment that compares methods." in page.text
    for name in ("p.png", "t.md"):
        with pytest.raises(ValueError, match=rf"holds no experiments/\*\.json, and {name} would show nothing else"):
            report(copied, tmp_path / name)
    assert table(page, "variant", "Spearman")


@pytest.mark.parametrize(
    ("name", "lacking", "told"),
    [
        ("validity", "rankings", "lacks 'rankings'"),
        pytest.param("sensitivity", "made", "lacks 'made'", marks=pytest.mark.slow),
        pytest.param("discriminator", "jerk_minus_distance", "lacks 'jerk_minus_distance'", marks=pytest.mark.slow),
    ],
)
def test_a_summary_that_lacks_an_entry_is_refused_with_its_file_and_recipe(
    name: str, lacking: str, told: str, copied: Path, tmp_path: Path
) -> None:
    path = copied / name / "summary.json"
    content = read(copied, f"{name}/summary.json")
    del content[lacking]
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ValueError, match=rf"{re.escape(str(path))} {told}; run python -m recipes\.{name} output="):
        report(copied, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_broken_file_behind_a_number_is_named_and_the_old_page_is_kept(copied: Path, tmp_path: Path) -> None:
    page = report(copied, tmp_path / "out")
    before = page.read_bytes()
    broken = copied / "seed_1" / "dpa_omf" / "eval_top_p_0.85_t_1.json"
    for text, told in (("{", "is no JSON"), ("{}", "has no 'per_scene'")):
        broken.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=told) as error:
            report(copied, tmp_path / "out")
        assert str(broken) in str(error.value)
    assert [file.name for file in page.parent.iterdir()] == ["index.html"] and page.read_bytes() == before


def test_the_command_writes_a_page_or_says_one_sentence(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["report", str(runs), str(tmp_path / "a" / "paper.html")])
    recipe.main()
    assert capsys.readouterr().out.strip() == str(tmp_path / "a" / "paper.html")
    monkeypatch.setattr(sys, "argv", ["report", str(tmp_path / "a"), str(tmp_path)])
    with pytest.raises(SystemExit, match="2"):
        recipe.main()
    told = capsys.readouterr().err
    assert told.startswith("error: ") and told.count("\n") == 1 and "holds no results" in told


def test_an_account_of_another_shape_is_told(copied: Path) -> None:
    (copied / "stages.json").write_text('{"pretrain": [1, 2]}')
    with pytest.raises(ValueError, match=r"stages\.json is no account of worker-seconds"):
        read_study(copied)


if __name__ == "__main__":
    pytest.main([__file__])
