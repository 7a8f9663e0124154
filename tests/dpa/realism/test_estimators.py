"""Histograms and indicators."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from dpa.realism import Histogram, Indicator, RealismConfig
from dpa.realism.estimators import histogram_edges, histogram_log_likelihood, indicator_log_likelihood

UNIT = Histogram(low=0.0, high=4.0, bins=4, pseudocount=0.1, weight=1.0)


def test_probability_is_the_smoothed_count_of_the_bin() -> None:
    simulated = torch.tensor([[[0.5, 1.0]], [[1.5, 3.5]]])
    score = histogram_log_likelihood(torch.tensor([[0.0, 1.9, 2.0, 4.0]]), simulated, UNIT)
    expected = torch.tensor([[1.1, 2.1, 0.1, 1.1]]) / 4.4
    torch.testing.assert_close(score.exp(), expected)


def test_values_outside_fall_into_the_end_bins_and_nan_into_the_last() -> None:
    simulated = torch.tensor([[[-9.0, 99.0, torch.nan]]])
    score = histogram_log_likelihood(torch.tensor([[-1.0, 5.0]]), simulated, UNIT)
    torch.testing.assert_close(score.exp(), torch.tensor([[1.1, 2.1]]) / 3.4)


def test_each_agent_has_a_histogram_of_its_own() -> None:
    simulated = torch.tensor([[[0.5], [3.5]]])
    score = histogram_log_likelihood(torch.tensor([[0.5], [0.5]]), simulated, UNIT)
    torch.testing.assert_close(score.exp(), torch.tensor([[1.1], [0.1]]) / 1.4)


def test_indicator_scores_what_the_log_did() -> None:
    simulated = torch.zeros(32, 3, dtype=torch.bool)
    simulated[:8, 1] = True
    score = indicator_log_likelihood(torch.tensor([True, True, False]), simulated, Indicator(0.001, 1.0))
    expected = [math.log(0.001 / 32.002), math.log(8.001 / 32.002), math.log(32.001 / 32.002)]
    assert score.tolist() == pytest.approx(expected, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("year", ["2024", "2025"])
def test_edges_and_weights_equal_the_official_ones(shared: Path, year: str) -> None:
    official = json.loads((shared / "realism" / "golden" / "edges.json").read_text())[f"cfg{year}"]
    config = RealismConfig.load(year)
    for name, histogram in config.histograms.items():
        assert histogram_edges(histogram).tolist() == official[name]["edges"], name
        assert histogram.pseudocount == pytest.approx(official[name]["pseudocount"])
        assert histogram.weight == pytest.approx(official[name]["weight"])
    for name, indicator in config.indicators.items():
        assert indicator.pseudocount == pytest.approx(official[name]["bernoulli_pseudocount"])
        assert indicator.weight == pytest.approx(official[name]["weight"])
