"""Histograms and indicators."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import gaussian_kde

from dpa.realism import Histogram, Indicator, Kernel, RealismConfig
from dpa.realism.estimators import histogram_edges, indicator_log_likelihood, log_likelihood

UNIT = Histogram(low=0.0, high=4.0, bins=4, pseudocount=0.1, weight=1.0)


def score_of(log: list[float], simulated: torch.Tensor, config: Histogram | Kernel = UNIT, **options) -> torch.Tensor:
    """Probabilities of one agent's logged values; the log is padded to the steps of the rollouts ``[R, 1, T]``."""
    padded = torch.zeros(1, simulated.shape[2])
    padded[0, : len(log)] = torch.tensor(log)
    return log_likelihood(padded, simulated, config, **options).exp()[0, : len(log)]


def test_probability_is_the_smoothed_count_of_the_bin() -> None:
    simulated = torch.tensor([[[0.5, 1.0, 0.2, 0.1]], [[1.5, 3.5, 0.3, 0.4]]])
    torch.testing.assert_close(score_of([0.0, 1.9, 2.0, 4.0], simulated), torch.tensor([5.1, 2.1, 0.1, 1.1]) / 8.4)


def test_values_outside_fall_into_the_end_bins_and_nan_into_the_last() -> None:
    simulated = torch.tensor([[[-9.0, 99.0, torch.nan]]])
    torch.testing.assert_close(score_of([-1.0, 5.0], simulated), torch.tensor([1.1, 2.1]) / 3.4)
    without = score_of([-1.0, 5.0], simulated, keep_nan=False)
    torch.testing.assert_close(without, torch.tensor([1.1, 1.1]) / 2.4)


def test_only_counted_samples_take_part() -> None:
    simulated, counted = torch.tensor([[[0.5, 3.5, 3.5]]]), torch.tensor([[True, False, False]])
    torch.testing.assert_close(score_of([0.5, 3.5], simulated, counted=counted), torch.tensor([1.1, 0.1]) / 1.4)


def test_agents_and_steps_share_a_distribution_or_have_their_own() -> None:
    simulated = torch.tensor([[[0.5, 1.5], [2.5, 3.5]]])  # one rollout, two agents, two steps
    log = torch.full((2, 2), 0.5)

    def scores(**options: bool) -> list[list[float]]:
        return log_likelihood(log, simulated, replace(UNIT, **options)).exp().tolist()

    torch.testing.assert_close(torch.tensor(scores()), torch.tensor([[1.1] * 2, [0.1] * 2]) / 2.4)
    torch.testing.assert_close(torch.tensor(scores(pooled=True)), torch.full((2, 2), 1.1 / 4.4))
    torch.testing.assert_close(torch.tensor(scores(per_step=True)), torch.tensor([[1.1, 0.1], [0.1, 0.1]]) / 1.4)
    torch.testing.assert_close(
        torch.tensor(scores(pooled=True, per_step=True)), torch.tensor([[1.1, 0.1], [1.1, 0.1]]) / 2.4
    )


def test_a_kernel_density_equals_that_of_scipy() -> None:
    generator = torch.Generator().manual_seed(0)
    simulated, log = torch.randn(20, 1, 6, generator=generator), torch.randn(1, 6, generator=generator)
    score = log_likelihood(log, simulated, Kernel(bandwidth=0.3, weight=1.0))
    samples = simulated.flatten().double().numpy()
    density = gaussian_kde(samples, bw_method=0.3 / samples.std(ddof=1))(log.flatten().double().numpy())
    expected = np.log(density * math.sqrt(2 * math.pi) * 0.3)
    np.testing.assert_allclose(score[0].numpy(), expected, rtol=1e-5)


def test_agents_share_the_probability_of_an_event_if_pooled() -> None:
    simulated = torch.tensor([[True, False], [True, False]])
    score = indicator_log_likelihood(torch.tensor([True, True]), simulated, Indicator(0.0, 1.0, pooled=True))
    assert score.exp().tolist() == pytest.approx([0.5, 0.5])


def test_each_agent_has_a_histogram_of_its_own() -> None:
    simulated = torch.tensor([[[0.5], [3.5]]])
    score = log_likelihood(torch.tensor([[0.5], [0.5]]), simulated, UNIT)
    torch.testing.assert_close(score.exp(), torch.tensor([[1.1], [0.1]]) / 1.4)


def test_indicator_scores_what_the_log_did() -> None:
    simulated = torch.zeros(32, 3, dtype=torch.bool)
    simulated[:8, 1] = True
    score = indicator_log_likelihood(torch.tensor([True, True, False]), simulated, Indicator(0.001, 1.0))
    expected = [math.log(0.001 / 32.002), math.log(8.001 / 32.002), math.log(32.001 / 32.002)]
    assert score.tolist() == pytest.approx(expected, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("year", ["2023", "2024", "2025"])
def test_edges_and_weights_equal_the_official_ones(shared: Path, year: str) -> None:
    official = json.loads((shared / "realism" / "golden" / "edges.json").read_text())[f"cfg{year}"]
    config = RealismConfig.load(year)
    for name, histogram in config.continuous.items():
        assert histogram_edges(histogram).tolist() == official[name]["edges"], name
        assert histogram.pseudocount == pytest.approx(official[name]["pseudocount"])
        assert histogram.weight == pytest.approx(official[name]["weight"])
    for name in official.keys() & config.indicators.keys():  # 2023 has no traffic lights
        indicator = config.indicators[name]
        assert indicator.pseudocount == pytest.approx(official[name]["bernoulli_pseudocount"])
        assert indicator.weight == pytest.approx(official[name]["weight"])
