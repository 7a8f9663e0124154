"""CAT-K as a method of recipes.align: from logs, without preferences."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dpa.training.checkpoint import load_policy
from dpa.training.loggers import read_curve

CAT_K = "method=cat_k"


def aligning(options: Callable, policy: Path, output: Path, *more: str) -> list[str]:
    return options("align", f"policy={policy}", f"output={output}", CAT_K, *more)


def test_it_learns_from_logs_and_tells_how_well_they_are_followed(
    run: Callable, options: Callable, origin: Path, tmp_path: Path
) -> None:
    long = ("alignment.steps=20", "alignment.lr=6e-3")
    outcome = run("align", *aligning(options, origin, tmp_path, *long))
    assert outcome.status == 0, outcome.err
    losses = [value for _, value in read_curve(tmp_path, "train/loss_next_token")]
    followed = [value for _, value in read_curve(tmp_path, "train/followed")]
    assert sum(losses[-5:]) < 0.9 * sum(losses[:5])
    assert all(0 <= share <= 1 for share in followed) and sum(followed[-5:]) >= sum(followed[:5])
    assert load_policy(tmp_path / "policy.pt")[2]["method"] == "cat_k"


@pytest.mark.slow
def test_a_run_that_is_cut_goes_on_to_the_same_weights(
    options: Callable, align_with_a_kill: Callable, origin: Path, tmp_path: Path
) -> None:
    align_with_a_kill(lambda output: aligning(options, origin, output, "alignment.steps=30"), tmp_path, checkpoint=4)


def test_more_rows_in_a_pass_change_rounding_alone(
    run: Callable, options: Callable, origin: Path, tmp_path: Path
) -> None:
    for name, rows in (("one", 1), ("all", 999)):
        outcome = run("align", *aligning(options, origin, tmp_path / name, f"alignment.max_rows={rows}"))
        assert outcome.status == 0, outcome.err
    mine, whole = (load_policy(tmp_path / name / "policy.pt")[0] for name in ("one", "all"))
    assert all(torch.allclose(mine[name], value, atol=1e-5) for name, value in whole.items())


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["preferences=runs/x"], "cat_k rolls the policy out by itself and reads no rollouts, got preferences=runs/x"),
        (["method=dpa_omf"], "preferences is not given"),
        (["method.data.candidates=0"], "method.data.candidates"),
        (["method.data.candidates=170"], "candidates must be 1 to 169"),
        (["method.data.recovery=0"], "method.data.recovery must lie in (0, 1], got 0"),
        (["method.data.recovery=true"], "method.data.recovery must lie in (0, 1], got True"),
        (["method.loss.kind=contrastive"], "learns from pairs"),
    ],
)
def test_options_that_do_not_fit_end_in_one_error(
    run: Callable, options: Callable, origin: Path, tmp_path: Path, more: list[str], told: str
) -> None:
    command = [*aligning(options, origin, tmp_path / "run"), *more]
    command = [option for option in command if option != CAT_K or "method=dpa_omf" not in more]
    outcome = run("align", *command)
    assert outcome.status == 2 and told in outcome.err and outcome.err.count("error:") == 1, outcome.err
    assert not (tmp_path / "run/checkpoints").exists()


if __name__ == "__main__":
    pytest.main([__file__])
