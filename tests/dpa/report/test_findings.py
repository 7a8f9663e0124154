"""The headline claims no more than the interval, and the reservations are not forgotten."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from dpa.report.experiment import Comparison, Experiment, in_words, read_experiment
from dpa.report.findings import budgets, headline, ordering, reservations
from dpa.report.sections.claim import claim
from dpa.report.study import read_study


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
        "Each at its own best decoding, DPA-OMF is 0.018 more realistic than the reference on 12 evaluation scenes "
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
    assert any(f"moves the reference by +{max(sharper):.3f} at best" in note for note in reservations(found))


def test_a_grid_of_one_temperature_is_said(found: Experiment) -> None:
    told = "Of decodings only top-p was varied, at temperature 1."
    assert told not in reservations(found)
    tuning = [row for row in found.tuning if row["temperature"] == 1]
    assert told in reservations(dataclasses.replace(found, tuning=tuning))


def test_a_rival_at_the_edge_of_the_grid_is_said_too(found: Experiment) -> None:
    inside, edge = (0.9, 1.0), (0.8, 1.0)
    tuning = [{**found.tuning[0], "top_p": top_p, "temperature": 1.0} for top_p in (0.8, 0.9, 1.0)]
    chosen = dict.fromkeys(found.methods, inside) | {"adversarial_afd": edge}
    notes = reservations(dataclasses.replace(found, chosen=chosen, tuning=tuning))
    assert any("of the 3 decodings tried: adversarial AFD (top-p 0.8); one beyond" in note for note in notes)


def test_a_decoding_at_the_edge_of_the_grid_is_said(found: Experiment) -> None:
    def told(*grid: tuple[float, float]) -> bool:
        """Of a grid whose first decoding was chosen."""
        tuning = [{**found.tuning[0], "top_p": top_p, "temperature": temperature} for top_p, temperature in grid]
        chosen = dict.fromkeys(found.methods, grid[0])
        notes = reservations(dataclasses.replace(found, chosen=chosen, tuning=tuning))
        wanted = f"Chosen at the edge of the {len(grid)} decodings tried: reference ({in_words(grid[0])})"
        assert any(note.startswith(wanted) for note in notes) == any("edge" in note for note in notes)
        return any("edge" in note for note in notes)

    assert told((0.8, 1.0), (0.9, 1.0), (1.0, 1.0))
    assert told((0.9, 0.6), (0.9, 0.8), (0.9, 1.0), (1.0, 1.0))
    assert not told((0.9, 1.0), (0.8, 1.0), (1.0, 1.0)), "it has both neighbours"
    assert not told((1.0, 1.0), (0.8, 1.0), (0.9, 1.0)), "beyond top-p 1 there is nothing"
    assert told((0.9, 1.0), (0.9, 0.8)), "of two, either is the last"
    assert not told((1.0, 1.0), (0.95, 1.0))
    assert told((0.95, 0.8), (1.0, 1.0), (0.95, 1.0), (0.9, 1.0)), "nothing colder was tried"
    assert not told((0.95, 1.0), (1.0, 0.8), (1.0, 1.0), (0.9, 1.0)), "the colder one has another top-p"


def test_a_single_decoding_is_said(found: Experiment) -> None:
    single = "One decoding was tried; sharper sampling of the reference alone may gain as much."
    assert single in reservations(dataclasses.replace(found, tuning=found.tuning[:1]))
    others_chose = dataclasses.replace(found, tuning=[])
    assert single not in reservations(others_chose), "the reference was evaluated at several"


def test_one_training_run_is_no_claim_about_a_method(found: Experiment) -> None:
    told = headline(with_difference(found, over="scenes", n_seeds=1))
    assert told.startswith("No claim about a method from one training run") and "this DPA-OMF differs" in told


def test_few_training_runs_are_said(found: Experiment) -> None:
    assert reservations(found)[0].startswith("3 training runs")
    assert reservations(with_difference(found, over="scenes", n_seeds=1))[0].startswith("One training run")
    assert not any("training run" in note for note in reservations(with_difference(found, n_seeds=5)))


def test_the_number_of_comparisons_is_said(found: Experiment) -> None:
    assert any(note.startswith("40 differences of realism stand on this page") for note in reservations(found, 40))
    assert any(note.startswith("10 differences") for note in reservations(found)), "3 at own best, 2 versus, 5 common"


def test_scenes_without_realism_are_said(found: Experiment) -> None:
    assert not any("no realism" in note for note in reservations(found))
    notes = reservations(dataclasses.replace(found, left_out=2))
    assert "Realism and its differences are over 10 of 12 evaluation scenes: on the others some run has none." in notes


def test_methods_are_sorted_by_what_can_be_told_of_them_against_the_headlines(found: Experiment) -> None:
    ends = {"dpa_adef": [-0.01, 0.01], "adversarial_afd": [0.01, 0.02]}
    versus = [{**entry, "ci95": ends[entry["method"]]} for entry in found.own_best.versus]
    own = dataclasses.replace(found.own_best, versus=versus)
    assert ordering(dataclasses.replace(found, own_best=own)) == "better: adversarial AFD. Not told apart: DPA-ADEF"
    once = dataclasses.replace(own, versus=[{**entry, "over": "scenes"} for entry in versus])
    told = ordering(dataclasses.replace(found, own_best=once))
    assert told == "no order is told: one training run of each says nothing about a method"


@pytest.mark.parametrize(("over", "kind"), [("seeds and scenes", "better"), ("scenes", "open")])
def test_a_card_has_the_colour_of_a_gain_where_one_is_claimed(
    runs: Path, found: Experiment, over: str, kind: str
) -> None:
    found = with_difference(found, realism_difference=0.018, ci95=[0.006, 0.03], over=over)
    study = dataclasses.replace(read_study(runs), experiments={"methods": found})
    assert f'class="figure {kind}">+0.018' in str(claim(study))


def test_equal_budgets_are_not_spoken_of_and_others_are_grouped(found: Experiment) -> None:
    assert budgets(found) is None
    budget = {**found.budget, "dpa_adef": {"steps": 60, "rollouts": 480, "start": "reference"}}
    budget["adversarial_afd"] = budget["dpa_adef"]
    assert budgets(dataclasses.replace(found, budget=budget)) == (
        "Budgets differ. Against that of DPA-OMF, 0.5 times the rollouts: DPA-ADEF; adversarial AFD."
    )


def test_nothing_compared_is_no_claim(found: Experiment) -> None:
    found = dataclasses.replace(found, own_best=Comparison([], []))
    assert headline(found).startswith("No claim")
    assert reservations(found)[-1].startswith("Scores on 12 evaluation scenes")


if __name__ == "__main__":
    pytest.main([__file__])
