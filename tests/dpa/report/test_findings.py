"""The headline claims no more than the interval, and the reservations are not forgotten."""

from __future__ import annotations

from typing import Any

import pytest

from dpa.report.findings import headline, reservations


def test_an_interval_above_zero_is_a_gain(comparison: dict[str, Any]) -> None:
    assert headline(comparison) == (
        "DPA-OMF is 0.018 more realistic than the reference on 54 scenes (95 % interval [+0.006, +0.030])."
    )


def test_an_interval_with_zero_is_no_claim(comparison: dict[str, Any]) -> None:
    assert headline(comparison, "DPA-ADEF").startswith("No claim: DPA-ADEF differs from the reference by +0.003")


@pytest.mark.parametrize("ci95", [[0.0, 0.02], [-0.02, 0.0]])
def test_an_interval_that_ends_at_zero_is_no_claim(ci95: list[float], comparison: dict[str, Any]) -> None:
    comparison["paired"][0]["ci95"] = ci95
    assert headline(comparison).startswith("No claim")


def test_an_interval_below_zero_is_a_loss(comparison: dict[str, Any]) -> None:
    comparison["paired"][0] |= {"realism_difference": -0.061, "ci95": [-0.07, -0.05]}
    assert headline(comparison).startswith("DPA-OMF is 0.061 less realistic than the reference")


def test_a_gain_that_sharper_sampling_of_the_reference_reaches_is_said_to_be_one(comparison: dict[str, Any]) -> None:
    comparison["rows"][1]["realism"] = 0.72
    assert headline(comparison).endswith("but the reference alone, sampled at top-p 0.85, is as realistic.")


def test_nothing_compared_is_no_claim(comparison: dict[str, Any]) -> None:
    comparison["paired"] = []
    assert headline(comparison).startswith("No claim")
    assert reservations(comparison)[-1].startswith("Scores on 54 scenes")


def test_a_method_that_was_not_compared_is_refused(comparison: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="'SFT-bestOA' was not compared.*DPA-OMF"):
        headline(comparison, "SFT-bestOA")


def test_one_training_run_is_said(comparison: dict[str, Any]) -> None:
    comparison["paired"][0] |= {"over": "scenes", "n_seeds": 1}
    assert reservations(comparison)[0].startswith("One training run")


def test_a_reference_sampled_in_one_way_only_is_said(comparison: dict[str, Any]) -> None:
    assert "The reference alone reaches 0.705, at top-p 0.85 (of 2 tried)." in reservations(comparison)
    del comparison["rows"][1]
    assert any("sharper sampling of it alone may gain as much" in note for note in reservations(comparison))


if __name__ == "__main__":
    pytest.main([__file__])
