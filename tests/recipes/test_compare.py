"""The main job, whole and killed: the comparison of six methods on tiny scenes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

METHODS = ["dpa_omf", "dpa_adef", "sft_best_oa", "sft_best_ade", "adversarial_afd"]
SMALL = [
    "seeds=[0]",
    "decoding.grid=[0.95,0.5]",
    "decoding.num_rollouts=2",
    "pictures=1",
    *(f"methods.{method}.data.num=2" for method in METHODS),
]
OF_THE_MACHINE = ("stages", "wall_seconds", "versions", "command")
"""What differs between two runs of the same options."""

pytestmark = pytest.mark.slow


def command(options: Callable, output: Path, workers: int = 1) -> list[str]:
    return options("compare", *SMALL, f"workers={workers}", f"output={output}")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """The folder of a comparison that nothing interrupted."""
    folder = tmp_path_factory.mktemp("compare")
    outcome = run("compare", *command(options, folder))
    assert outcome.status == 0, outcome.err
    assert "index.html" in outcome.out
    return folder


def comparison(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "comparison.json").read_text())


def test_every_method_is_compared_with_the_reference(finished: Path) -> None:
    found = comparison(finished)
    assert found["scenes"] == {"train": 6, "tune": 2, "eval": 3, "source": "store"}
    at_common = [row["method"] for row in found["rows"] if row["top_p"] == 0.95]
    assert at_common[:6] == ["reference", *METHODS]
    assert [entry["method"] for entry in found["paired"]][:5] == METHODS
    assert {row["method"] for row in found["own_best"]["rows"]} == {"reference", *METHODS}
    for row in found["rows"]:
        assert 0 < row["realism"] <= 1 and 0 <= row["pair_accuracy"] <= 1 and row["n_scenes"] == 3
    assert set(found["per_scene"]) == {"reference", *METHODS}


def test_the_report_shows_figures_and_scenes(finished: Path) -> None:
    page = (finished / "index.html").read_text()
    assert "DPA-OMF" in page or "dpa_omf" in page
    for picture in ("comparison", "own_best", "curves", "pretraining", "scenes"):
        assert (finished / f"{picture}.png").stat().st_size > 1000


def test_a_finished_comparison_does_nothing_again(run: Callable, options: Callable, finished: Path) -> None:
    policies = sorted(finished.rglob("*.pt"))
    before = comparison(finished)
    assert run("compare", *command(options, finished)).status == 0
    after = comparison(finished)
    assert {k: v for k, v in after.items() if k not in OF_THE_MACHINE} == {
        k: v for k, v in before.items() if k not in OF_THE_MACHINE
    }
    assert sorted(finished.rglob("*.pt")) == policies


@pytest.mark.parametrize(
    ("workers", "sign"),
    [
        (1, "seed_0/preferences_train/metadata.json"),
        (2, "seed_0/dpa_omf/checkpoints/step_0000000002.pt"),
        (1, "seed_0/sft_best_oa/tune_top_p_0.95.json"),
    ],
)
def test_a_killed_comparison_ends_like_one_that_nothing_interrupted(
    run: Callable, options: Callable, kill_when: Callable, finished: Path, tmp_path: Path, workers: int, sign: str
) -> None:
    output = tmp_path / "compare"
    kill_when((output / sign).exists, "compare", *command(options, output, workers))
    assert not (output / "comparison.json").exists()
    outcome = run("compare", *command(options, output))
    assert outcome.status == 0, outcome.err
    mine, whole = comparison(output), comparison(finished)
    for name in OF_THE_MACHINE:
        mine.pop(name), whole.pop(name)
    assert mine == whole


if __name__ == "__main__":
    pytest.main([__file__, "-m", "slow"])
