"""Configurations of the realism metric."""

from __future__ import annotations

from pathlib import Path

import pytest

from dpa.realism import Kernel, RealismConfig
from dpa.realism.config import FOLDER


@pytest.mark.parametrize(("year", "total"), [("2023", 0.99), ("2024", 1.0), ("2025", 1.0)])
def test_weights_of_each_year_sum_to_what_the_challenge_says(year: str, total: float) -> None:
    assert sum(RealismConfig.load(year).weights.values()) == pytest.approx(total)


def test_a_kernel_density_may_take_the_place_of_a_histogram(tmp_path: Path) -> None:
    text = (FOLDER / "2025.yaml").read_text()
    line = next(line for line in text.splitlines() if line.strip().startswith("linear_speed:"))
    path = tmp_path / "mine.yaml"
    path.write_text(text.replace(line, "  linear_speed: {bandwidth: 0.5, weight: 0.05, pooled: true}"))
    assert RealismConfig.load(path).continuous["linear_speed"] == Kernel(bandwidth=0.5, weight=0.05, pooled=True)


def test_a_path_is_read_like_a_name(tmp_path: Path) -> None:
    path = tmp_path / "2024.yaml"
    path.write_text((FOLDER / "2024.yaml").read_text())
    assert RealismConfig.load(path) == RealismConfig.load("2024")


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'1999'.*2024.*2025"):
        RealismConfig.load("1999")


def test_a_part_of_which_nothing_counts_is_refused(tmp_path: Path) -> None:
    lines = (FOLDER / "2024.yaml").read_text().splitlines()
    kinematic = ("linear_", "angular_")
    without = [line.replace("0.05}", "0}") if line.strip().startswith(kinematic) else line for line in lines]
    (tmp_path / "mine.yaml").write_text("\n".join(without))
    with pytest.raises(ValueError, match="weighs nothing of kinematic.*give one of linear_speed, .*above 0"):
        RealismConfig.load(tmp_path / "mine.yaml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("corner_rounding", "corner_roundness", r"unknown keys \['corner_roundness'\] and lacks \['corner_rounding'\]"),
        ("linear_speed:", "speed:", r"continuous has unknown keys \['speed'\]"),
        ("bins: 10", "bins: ten", r"bins must be of type int, got 'ten'"),
        ("bins: 10", "bins: 10, colour: 3", r"linear_speed has unknown keys \['colour'\]"),
        ("traffic_lights: true", "traffic_lights: false", r"weight 0\.05.*traffic_lights: false"),
        (
            "differences: central",
            "differences: forward",
            r"differences must be one of central, backward, got",
        ),
        ("last_ttc", "first_ttc", r"quirks must be one of .*last_ttc.*, got 'first_ttc'"),
        ("traffic_lights: true", "traffic_lights: 1", r"traffic_lights must be of type bool, got 1"),
        ("bins: 10", "bins: 0", r"mine\.yaml: continuous\.linear_speed: bins must be 1 or more, got 0"),
        ("high: 25.0", "high: -1.0", r"low must be less than high, got 0\.0 and -1\.0"),
        ("pseudocount: 0.1", "pseudocount: -1", r"pseudocount must be 0 or more, got -1"),
        ("weight: 0.05", "weight: .nan", r"weight must be 0 or more, got nan"),
    ],
)
def test_a_wrong_file_is_refused_with_what_is_wrong(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text((FOLDER / "2025.yaml").read_text().replace(old, new, 1))
    with pytest.raises(ValueError, match=message):
        RealismConfig.load(path)


@pytest.mark.parametrize("text", ["", "- 1", "a: [", "3"])
def test_a_file_that_is_no_mapping_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"mine\.yaml"):
        RealismConfig.load(path)
