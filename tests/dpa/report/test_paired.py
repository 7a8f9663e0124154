"""A figure is compared scene by scene, from the files behind its rows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dpa.report.paired import paired_figure, quiet_change
from dpa.report.statistics import Interval, paired_bootstrap
from dpa.report.study import Evaluations


@pytest.fixture
def evaluations(tmp_path: Path) -> Evaluations:
    scenes: dict[str, list[float | None]] = {
        "a0": [0.5, 0.7, None, 0.1], "a1": [0.6, 0.7, 0.4, 0.3],
        "b0": [0.4, 0.5, 0.5, None], "b1": [0.4, 0.6, 0.1, 0.2],
        "short": [0.1], "unknown": [None] * 4,
    }  # fmt: skip
    for name, values in scenes.items():
        (tmp_path / name).write_text(json.dumps({"per_scene": {"rate": values}}), encoding="utf-8")
    return Evaluations(tmp_path)


def rows(*files: str) -> list[dict[str, Any]]:
    return [{"seed": seed, "file": file} for seed, file in enumerate(files)]


def test_only_scenes_that_all_runs_have_a_value_for_count_and_seeds_are_paired(evaluations: Evaluations) -> None:
    found = paired_figure(rows("a0", "a1"), rows("b0", "b1")[::-1], "rate", evaluations)
    expected = paired_bootstrap([[0.5, 0.7], [0.6, 0.7]], [[0.4, 0.5], [0.4, 0.6]])
    assert found == expected
    assert found.mean == pytest.approx(np.mean([0.1, 0.2, 0.2, 0.1])) and found.num_scenes == 2


@pytest.mark.parametrize(
    ("mine", "base", "key"),
    [
        (rows("a0", "a1"), rows("b0"), "rate"),
        (rows("absent"), rows("b0"), "rate"),
        (rows("a0"), rows("short"), "rate"),
        (rows("a0"), rows("unknown"), "rate"),
        (rows("a0"), rows("b0"), "other"),
        ([], rows("b0"), "rate"),
    ],
    ids=["a seed without a partner", "no file", "other scenes", "no value", "no such figure", "no rows"],
)
def test_what_does_not_pair_has_no_difference(
    mine: list[dict[str, Any]], base: list[dict[str, Any]], key: str, evaluations: Evaluations
) -> None:
    found = paired_figure(mine, base, key, evaluations)
    assert found is None and quiet_change(found) == ""


def test_a_difference_stands_out_where_its_interval_does_not_hold_zero() -> None:
    apart, not_apart = (Interval(0.02, *ends, "seeds and scenes", 2, 9) for ends in ((0.01, 0.03), (-0.01, 0.05)))
    assert quiet_change(apart) == "<small><strong>+0.020</strong><br>[+0.010, +0.030]</small>"
    assert quiet_change(not_apart, 2) == "<small>+0.02<br>[−0.01, +0.05]</small>"


if __name__ == "__main__":
    pytest.main([__file__])
