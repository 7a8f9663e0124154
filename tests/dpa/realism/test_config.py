"""Configurations of the realism metric."""

from __future__ import annotations

from pathlib import Path

import pytest

from dpa.realism import RealismConfig
from dpa.realism.config import FOLDER


@pytest.mark.parametrize("year", ["2024", "2025"])
def test_weights_of_each_year_sum_to_one(year: str) -> None:
    assert sum(RealismConfig.load(year).weights.values()) == pytest.approx(1.0)


def test_a_path_is_read_like_a_name(tmp_path: Path) -> None:
    path = tmp_path / "2024.yaml"
    path.write_text((FOLDER / "2024.yaml").read_text())
    assert RealismConfig.load(path) == RealismConfig.load("2024")


def test_an_unknown_name_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"'1999'.*2024.*2025"):
        RealismConfig.load("1999")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("corner_rounding", "corner_roundness", r"unknown keys \['corner_roundness'\] and lacks \['corner_rounding'\]"),
        ("linear_speed:", "speed:", r"histograms has unknown keys \['speed'\]"),
        ("bins: 10", "bins: ten", r"bins must be of type int, got 'ten'"),
        ("bins: 10", "bins: 10, colour: 3", r"linear_speed has unknown keys \['colour'\]"),
        ("traffic_lights: true", "traffic_lights: false", r"weight 0\.05.*traffic_lights: false"),
        ("traffic_lights: true", "traffic_lights: 1", r"traffic_lights must be of type bool, got 1"),
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
