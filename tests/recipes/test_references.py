"""Pre-trainings side by side: the table, the figure, and what is no pre-training."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from matplotlib.image import imread

from dpa import zoo
from dpa.training.checkpoint import load_policy
from dpa.training.loggers import read_curve
from recipes.common.models import build_policy, write_policy


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """Two finished trainings, of another length each."""
    folder = tmp_path_factory.mktemp("references")
    for name, steps in (("short", 3), ("long", 6)):
        outcome = run("pretrain", *options("pretrain", f"output={folder / name}", f"pretraining.steps={steps}"))
        assert outcome.status == 0, outcome.err
    return folder


def test_every_training_has_a_row_and_a_curve_and_is_scored_once(
    run: Callable, options: Callable, trained: Path, tmp_path: Path
) -> None:
    asked = (f"policies=['{trained}/*/policy.pt']", "split=eval", f"output={tmp_path}")
    outcome = run("references", *options("references", *asked))
    assert outcome.status == 0, outcome.err
    rows = {line.split("│")[1].strip(): line.split("│")[2:-1] for line in outcome.out.splitlines() if "│" in line}
    assert rows.keys() == {"long", "short"}
    for name, steps in (("short", 3), ("long", 6)):
        parameters, scenes, seen, _, _, nll, *_ = (cell.split()[0] for cell in rows[name])
        assert (float(seen), float(parameters), float(scenes)) == (steps / 1000, 0.153, 0.006)
        lowest = min(value for _, value in read_curve(trained / name, "tune/nll"))
        assert float(nll) == pytest.approx(lowest, abs=5e-4)
    assert imread(tmp_path / "references.png").ndim == 3
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.json")}
    assert len([path for path in before if path.stem in rows]) == 2
    assert run("references", *options("references", *asked)).out.count("long") == outcome.out.count("long")
    assert all(before[tmp_path / f"{name}.json"] == (tmp_path / f"{name}.json").stat().st_mtime_ns for name in rows)


def test_a_policy_of_the_zoo_stands_in_the_table_by_its_card(run: Callable, options: Callable, tmp_path: Path) -> None:
    name = "motionlm-nano-sumo"
    outcome = run("references", *options("references", f"policies=[zoo:{name}]", "split=eval", f"output={tmp_path}"))
    assert outcome.status == 0, outcome.err
    (row,) = (line.split("│")[1:-1] for line in outcome.out.splitlines() if "│" in line)
    told = zoo.card(name)
    expected = (told["num_scenes"] / 1000, 6, 0.006, told["hours"], told["tune_nll"])
    assert row[0].strip() == name and [float(cell) for cell in row[2:7]] == pytest.approx(expected, rel=1e-2)


def test_a_policy_that_was_not_pre_trained_in_its_folder_is_refused_before_any_work(
    run: Callable, options: Callable, trained: Path, tmp_path: Path
) -> None:
    weights, config, _ = load_policy(trained / "short/policy.pt")
    model = build_policy(config)
    model.load_state_dict(weights)
    (tmp_path / "moved").mkdir()
    write_policy(tmp_path / "moved/policy.pt", model, config, {})
    asked = f"policies=[{tmp_path / 'moved/policy.pt'}]", f"output={tmp_path / 'out'}"
    outcome = run("references", *options("references", *asked))
    assert outcome.status == 2 and "moved has no curve 'tune/nll'" in outcome.err
    assert not list((tmp_path / "out").glob("*.json"))


if __name__ == "__main__":
    pytest.main([__file__])
