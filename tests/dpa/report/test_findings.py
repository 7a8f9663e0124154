"""The headline claims no more than the interval, and the reservations are not forgotten."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from dpa.report.experiment import Comparison, Experiment, read_experiment
from dpa.report.findings import headline, reservations


@pytest.fixture(scope="module")
def found(runs: Path) -> Experiment:
    return read_experiment(runs / "experiments" / "methods.json")


def with_difference(found: Experiment, **changes: Any) -> Experiment:
    """The experiment with another difference of DPA-OMF at own best decodings."""
    entries = [{**e, **changes} if e["method"] == "dpa_omf" else e for e in found.own_best.paired]
    return dataclasses.replace(found, own_best=Comparison(found.own_best.rows, entries))


def test_an_interval_above_zero_is_a_gain(found: Experiment) -> None:
    found = with_difference(found, realism_difference=0.018, ci95=[0.006, 0.03])
    assert headline(found) == (
        "Each at its own best decoding, DPA-OMF is 0.018 more realistic than the reference on 12 scenes "
        "(95 % interval [+0.006, +0.030])."
    )


def test_an_interval_below_zero_is_a_loss(found: Experiment) -> None:
    found = with_difference(found, realism_difference=-0.061, ci95=[-0.07, -0.05])
    assert "DPA-OMF is 0.061 less realistic than the reference" in headline(found)


@pytest.mark.parametrize("ci95", [[-0.01, 0.03], [0.0, 0.02], [-0.02, 0.0]])
def test_an_interval_that_holds_or_touches_zero_is_no_claim(ci95: list[float], found: Experiment) -> None:
    found = with_difference(found, realism_difference=sum(ci95) / 2, ci95=ci95)
    assert headline(found).startswith("No claim: each at its own best decoding, DPA-OMF differs from the reference by")


def test_a_gain_at_the_common_decoding_alone_is_no_claim_and_is_said(found: Experiment) -> None:
    assert found.at_common.entry("dpa_omf")["ci95"][0] > 0
    found = with_difference(found, realism_difference=0.001, ci95=[-0.002, 0.003])
    assert headline(found).startswith("No claim")
    assert "The gain at the common decoding does not outlast the best decoding of the reference." in reservations(found)


def test_what_sampling_alone_does_is_said(found: Experiment) -> None:
    sharper = [e["realism_difference"] for e in found.at_common.paired if e["method"] == "reference"]
    assert any(f"moves the reference by up to +{max(sharper):.3f}" in note for note in reservations(found))


def test_a_decoding_at_the_edge_of_the_grid_is_said(found: Experiment) -> None:
    assert any("edge of the 3 decodings tried: reference (top-p 0.85)" in note for note in reservations(found))
    chosen = dict.fromkeys(found.methods, (0.9, 0.95))
    tuning = [*found.tuning, *({**row, "top_p": 0.9, "temperature": 0.95} for row in found.tuning[:1])]
    assert not any("edge" in note for note in reservations(dataclasses.replace(found, chosen=chosen, tuning=tuning)))


def test_a_single_decoding_is_said(found: Experiment) -> None:
    notes = reservations(dataclasses.replace(found, tuning=[]))
    assert "One decoding was tried; sharper sampling of the reference alone may gain as much." in notes


def test_few_training_runs_are_said(found: Experiment) -> None:
    assert reservations(found)[0].startswith("3 training runs")
    assert reservations(with_difference(found, over="scenes", n_seeds=1))[0].startswith("One training run")
    assert not any("training run" in note for note in reservations(with_difference(found, n_seeds=5)))


def test_the_number_of_comparisons_is_said(found: Experiment) -> None:
    assert any(note.startswith("40 differences stand on this page") for note in reservations(found, 40))


def test_nothing_compared_is_no_claim(found: Experiment) -> None:
    found = dataclasses.replace(found, own_best=Comparison([], []))
    assert headline(found).startswith("No claim")
    assert reservations(found)[-1].startswith("Scores on 12 scenes")


if __name__ == "__main__":
    pytest.main([__file__])
