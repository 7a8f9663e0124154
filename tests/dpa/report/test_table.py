"""The table says the same in a terminal, in Markdown and to a program."""

from __future__ import annotations

import io
import math
from typing import Any

import pytest
from rich.console import Console

from dpa.report.statistics import SEEDS_AND_SCENES as OVER
from dpa.report.table import cells, header, print_whole, summarise, to_markdown, to_rich


def test_rows_are_means_over_seeds_in_the_given_order(comparison: dict[str, Any]) -> None:
    records = summarise(comparison["rows"], comparison["paired"])
    assert [(r["method"], r["top_p"], r["n_seeds"]) for r in records] == [
        ("reference", 0.95, 1), ("reference", 0.85, 1), ("DPA-OMF", 0.95, 2), ("DPA-ADEF", 0.95, 2),
    ]  # fmt: skip
    assert records[2]["realism"] == pytest.approx(0.718)
    assert records[2]["pair_accuracy"] == pytest.approx(0.64)
    assert (records[2]["realism_difference"], records[2]["ci95"]) == (0.018, [0.006, 0.03])


def test_what_was_not_measured_is_none_to_a_program_and_a_dash_to_a_reader(comparison: dict[str, Any]) -> None:
    records = summarise(comparison["rows"], comparison["paired"])
    assert records[0]["pair_accuracy"] is None
    assert cells(records)[0][-2:] == ["–", "–"]


def test_a_mean_over_some_of_the_seeds_is_not_shown(comparison: dict[str, Any]) -> None:
    comparison["rows"][3]["pair_accuracy"] = None
    assert summarise(comparison["rows"])[2]["pair_accuracy"] is None


def test_columns_follow_the_papers_table(comparison: dict[str, Any]) -> None:
    titles = [title.split(" ")[0] for title in header(summarise(comparison["rows"]))]
    assert titles[3:8] == ["kinematic", "interactive", "map", "realism", "minADE"]
    assert titles[8:10] == ["collision", "off-road"]


def test_top_p_is_a_column_only_where_it_is_known() -> None:
    assert "top-p" not in header(summarise([{"method": "reference", "realism": 0.7}]))


def test_markdown_has_one_line_for_each_method_and_as_many_cells_everywhere(comparison: dict[str, Any]) -> None:
    records = summarise(comparison["rows"], comparison["paired"])
    lines = to_markdown(header(records), cells(records)).splitlines()
    assert len(lines) == 2 + 4
    assert len({line.count("|") for line in lines}) == 1
    assert "+0.018 [+0.006, +0.030]" in lines[4]
    assert "−0.004" in lines[5]


def test_a_bar_in_a_name_does_not_split_a_cell_of_markdown() -> None:
    assert to_markdown(["method", "realism"], [["a|b", "0.7"]]).splitlines()[2] == "| a\\|b | 0.7 |"


def test_a_narrow_terminal_neither_folds_nor_cuts_a_number(comparison: dict[str, Any]) -> None:
    out = io.StringIO()
    print_whole(to_rich(comparison["rows"], comparison["paired"], title="results"), Console(file=out, width=40))
    text = out.getvalue()
    assert "+0.018 [+0.006, +0.030]" in text
    assert "…" not in text
    assert sum("DPA-OMF" in line for line in text.splitlines()) == 1


def test_nan_is_refused_with_method_and_measure(comparison: dict[str, Any]) -> None:
    comparison["rows"][2]["min_ade"] = math.nan
    with pytest.raises(ValueError, match="DPA-OMF: min_ade is NaN"):
        summarise(comparison["rows"])


@pytest.mark.parametrize("entry", [{"method": "reference"}, {"method": "nobody"}, {"method": "DPA-OMF", "top_p": 0.5}])
def test_a_difference_that_fits_no_single_row_is_refused(entry: dict[str, Any], comparison: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=entry["method"]):
        summarise(comparison["rows"], [{**entry, "realism_difference": 0.0, "ci95": [0.0, 0.0], "over": OVER}])


def test_a_difference_with_a_top_p_goes_to_that_row(comparison: dict[str, Any]) -> None:
    entry = {"method": "reference", "top_p": 0.85, "realism_difference": 0.005, "ci95": [0.0, 0.01], "over": OVER}
    records = summarise(comparison["rows"], [entry])
    assert [record["realism_difference"] for record in records[:2]] == [None, 0.005]


def test_decodings_that_differ_in_temperature_alone_are_rows_of_their_own() -> None:
    rows = [
        {"method": "reference", "seed": 0, "top_p": 0.9, "temperature": temperature, "realism": temperature / 2}
        for temperature in (1.0, 0.8)
    ]
    where = {"method": "reference", "top_p": 0.9, "temperature": 0.8}
    sharper = where | {"realism_difference": -0.1, "ci95": [-0.2, 0.0], "over": OVER}
    records = summarise(rows, [sharper])
    assert [(record["temperature"], record["realism"]) for record in records] == [(1.0, 0.5), (0.8, 0.4)]
    assert [record["realism_difference"] for record in records] == [None, -0.1]
    assert header(records)[1:3] == ["top-p", "temperature"] and cells(records)[1][1:3] == ["0.90", "0.80"]


def test_the_temperature_is_not_told_where_it_is_one_everywhere() -> None:
    records = summarise([{"method": "reference", "top_p": 0.9, "temperature": 1.0, "realism": 0.5}])
    assert header(records)[1:3] == ["top-p", "seeds"]


if __name__ == "__main__":
    pytest.main([__file__])
