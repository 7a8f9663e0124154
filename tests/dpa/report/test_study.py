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
from PIL import Image

from dpa.report.charts import _rounded
from dpa.report.page import write_study
from dpa.report.sections.safety import RESAMPLES
from dpa.report.statistics import paired_bootstrap
from dpa.report.study import read_study
from dpa.report.table import difference, number
from recipes import report as recipe
from recipes.report import report
from tests.dpa.report.parsed import Page
from tests.dpa.report.runs import BEST, COMMON, SEEDS, values


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
    assert f"DPA-OMF is {own['realism_difference']:.3f} more realistic than the reference on 12 scenes" in page.text
    for entry in (own, common):
        low, high = entry["ci95"]
        assert f"+{entry['realism_difference']:.3f} [+{low:.3f}, +{high:.3f}] realism, 95 %" in spaced(page)


def spaced(page: Page) -> str:
    return re.sub(r"(?<=\d)\[", " [", page.text)


@pytest.mark.parametrize("common", [False, True])
def test_a_table_has_means_over_seeds_intervals_and_published_numbers(
    common: bool, page: Page, methods: dict[str, Any]
) -> None:
    tables = [rows for rows in page.tables if rows[0][:2] == ["method", "decoding"]]
    rows, paired = (methods["rows"], methods["paired"]) if common else methods["own_best"].values()
    decoding = COMMON if common else BEST
    cells = next(row for row in tables[int(common)] if row[0] == "DPA-OMF")
    assert cells[1] == f"top-p {decoding[0]:g}"
    published = {"kinematic": "0.415", "realism": "0.739", "min_ade": "1.413"}
    for cell, key in zip(cells[2:7], ("kinematic", "interactive", "map_based", "realism", "min_ade"), strict=True):
        assert cell == number(mean(rows, "dpa_omf", key, decoding), 3) + published.get(key, ""), key
    entry = next(entry for entry in paired if entry["method"] == "dpa_omf")
    assert cells[7] == difference(entry["realism_difference"], entry["ci95"])
    assert all(f"seed_{seed}/dpa_omf/eval_top_p_{decoding[0]:g}_t_1.json" in cells[8] for seed in SEEDS)


def test_safety_is_paired_scene_by_scene_where_all_have_a_value(page: Page) -> None:
    cells = next(row for row in table(page, "method", "collision ↓") if row[0] == "DPA-OMF")
    assert len(cells) == 7
    scenes = [[values(m, seed, BEST)["red_light"][1:] for seed in SEEDS] for m in ("dpa_omf", "reference")]
    found = paired_bootstrap(*np.array(scenes, dtype=float), RESAMPLES)
    assert cells[4].endswith(difference(found.mean, (found.low, found.high)).replace(" [", "["))


def test_safety_without_the_files_behind_it_has_no_intervals(copied: Path, tmp_path: Path) -> None:
    for file in copied.glob("seed_*/dpa_omf/eval_*.json"):
        file.unlink()
    page = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    cells = next(row for row in table(page, "method", "collision ↓") if row[0] == "DPA-OMF")
    assert all(re.fullmatch(r"\d\.\d{3}", cell) for cell in cells[1:])


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
    page: Page, methods: dict[str, Any]
) -> None:
    figure = figures(page, "distance between the rollouts of a scene [m]")[0]
    line = trace(figure, "DPA-OMF")
    assert line["x"] == sorted(line["x"])
    place = line["marker"]["size"].index(max(line["marker"]["size"]))
    assert line["x"][place] == _rounded(mean(methods["tuning"], "dpa_omf", "spread", BEST))
    assert line["y"][place] == _rounded(mean(methods["tuning"], "dpa_omf", "realism", BEST))
    assert "DPA-OMF, chosen" in line["hovertext"][place]


def test_table_3_has_pair_accuracy_realism_and_min_ade(page: Page, methods: dict[str, Any]) -> None:
    first, second = table(page, "method", "pair accuracy ↑", "realism ↑")
    realism = number(mean(methods["rows"], "dpa_omf", "realism", COMMON), 3)
    assert first[:3] == ["DPA-OMF", "0.6500.840", f"{realism}0.739"]
    assert second[:2] == ["adversarial AFD", "0.510"]


def test_likelihood_is_a_table_that_names_its_files(page: Page) -> None:
    cells = next(row for row in table(page, "method", "pair accuracy ↑", "NLL preferred") if row[0] == "DPA-OMF")
    assert cells[1:7] == ["0.650", "1.70", "2.50", "4.00", "1.90", "0.30"]
    assert "seed_2/dpa_omf/likelihood_eval.json" in cells[7]


def test_likelihood_along_training_has_a_line_for_each_seed_and_their_mean(page: Page) -> None:
    figure = figures(page, "step")[0]
    lines = [each for each in figure["data"] if each["name"] == "preferred"]
    assert [each["line"]["width"] for each in lines] == [1, 1, 1, 2.6]
    assert lines[0]["y"][-1] == pytest.approx(1.8) and lines[3]["y"][-1] == pytest.approx(1.82)
    shown = {figure["layout"]["yaxis"]["title"]["text"] for figure in figures(page, "step")}
    assert shown == {"negative log-likelihood", "train/logit_std", "train/saturated", "train/kl", "train/entropy"}


def test_scaling_stands_over_its_axis_with_intervals(page: Page, runs: Path) -> None:
    (figure,) = figures(page, "rankings per scene")
    paired = read(runs, "experiments/scaling.json")["own_best"]["paired"]
    line = trace(figure, "own best decoding")
    assert (line["x"], figure["layout"]["xaxis"]["type"]) == ([1, 4, 16], "log")
    assert line["y"] == [_rounded(entry["realism_difference"]) for entry in paired]
    assert line["error_y"]["array"] == [_rounded(e["ci95"][1] - e["realism_difference"]) for e in paired]


def test_snapshots_stand_over_their_distance_from_the_reference_in_order_of_steps(page: Page, runs: Path) -> None:
    (figure,) = figures(page, "KL to the reference")
    line = trace(figure, "DPA-OMF, own best")
    assert line["x"] == pytest.approx([0, 0.1, 0.2, 0.3])
    paired = {entry["method"]: entry for entry in read(runs, "experiments/steps.json")["own_best"]["paired"]}
    gains = [paired[name]["realism_difference"] for name in ("dpa_omf@20", "dpa_omf@40", "dpa_omf")]
    assert line["y"] == pytest.approx([0, *gains], rel=1e-4)


def test_studies_of_rankings_are_figures_and_tables(page: Page) -> None:
    (validity,) = figures(page, "distance over the scene's mean")
    assert trace(validity, "omf")["y"] == pytest.approx([0.014, 0.0035, -0.0035, -0.014])
    assert table(page, "ranking", "Spearman")[0][1] == "−0.700 [−0.750, −0.650]"
    (heat,) = figures(page, "gap of the pair")
    assert heat["data"][0]["z"] == [[0.55, 0.95], [0.55, 0.95]]
    assert table(page, "variant", "Spearman")[1][1:] == [
        "0.600 [0.550, 0.650]", "0.500 [0.450, 0.550]", "0.100 [0.050, 0.150]", "0.400",
    ]  # fmt: skip
    assert "python -m recipes.sensitivity policies=[a.pt]" in page.text
    assert "Held-out AUC for each policy: 0 0.910." in page.text
    assert table(page, "within a scene", "discriminator")[1] == ["collision rate", "–", "–", "–", "–"]


def test_stages_cards_and_the_way_to_make_it_again_are_there(page: Page) -> None:
    assert table(page, "stage", "time") == [
        ["pretrain", "1 h 30 min", "3"], ["align", "30 min 0 s", "9"], ["all", "2 h 0 min", "12"],
    ]  # fmt: skip
    (hours,) = figures(page, "hours")
    assert hours["data"][0]["x"] == [1.5, 0.5]
    card = {name: cells for name, *cells in table(page, "store", "seed 0, train")}
    assert card["rollouts per scene"] == ["8", "8"] and "distance made of speed" in card
    for wanted in ("recipes.compare experiment=methods", "torch 2.13.0", "Linux x86_64, 2 CPU cores", "2026-11-21"):
        assert wanted in page.text


def test_the_player_has_its_scenes(page: Page) -> None:
    data = next(data for data in page.data if "scenes" in data)
    assert [scene["id"] for scene in data["scenes"]] == ["</script><b>made up"]


def test_what_is_missing_is_named_with_its_command(copied: Path, tmp_path: Path) -> None:
    for name in ("validity", "discriminator"):
        shutil.rmtree(copied / name)
    (copied / "players.json").unlink()
    (copied / "experiments" / "steps.json").unlink()
    study = read_study(copied)
    page = Page(write_study(tmp_path / "p.html", study, experiments=["methods", "steps"]).read_text(encoding="utf-8"))
    missing = page.text.partition("Not here yet")[2]
    for wanted in (
        f"experiment steps: python -m recipes.compare experiment=steps output={copied}",
        "validity: python -m recipes.validity policies=[POLICY.pt]",
        "scenes to play: python -m recipes.compare",
    ):
        assert wanted in missing
    assert "sensitivity: " not in missing and "experiment methods" not in missing
    assert "player-data" not in [value for _, _, value in page.attributes]


def test_a_study_of_rankings_alone_makes_a_page_without_a_claim(copied: Path, tmp_path: Path) -> None:
    shutil.rmtree(copied / "experiments")
    page = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    assert "No claim: the study has no experiment 'methods'" in page.text
    with pytest.raises(ValueError, match=r"holds no experiments/\*\.json, and p\.png is a picture of one"):
        report(copied, tmp_path / "p.png")
    assert table(page, "variant", "Spearman")


def test_a_summary_that_lacks_an_entry_is_shown_by_its_picture_or_refused(copied: Path, tmp_path: Path) -> None:
    (copied / "validity" / "summary.json").write_text("{}", encoding="utf-8")
    with pytest.raises(
        ValueError, match=r"validity/summary\.json lacks 'rankings'; run python -m recipes\.validity again"
    ):
        report(copied, tmp_path / "out")
    Image.new("RGB", (4, 4)).save(copied / "validity" / "validity.png")
    page = Page(report(copied, tmp_path / "out").read_text(encoding="utf-8"))
    assert [value[:22] for tag, name, value in page.attributes if name == "src"] == ["data:image/png;base64,"]
    assert "validity/summary.json lacks 'rankings': its pictures stand here" in page.text


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


if __name__ == "__main__":
    pytest.main([__file__])
