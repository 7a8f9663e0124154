"""Pre-training with the auxiliary loss of a family."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dpa.training.checkpoint import load_policy
from dpa.training.loggers import read_curve
from recipes.common.models import digest_of


def test_it_is_trained_resumed_and_no_part_of_the_policy(run: Callable, options: Callable, tmp_path: Path) -> None:
    digests = []
    for output in (tmp_path / "whole", tmp_path / "resumed"):
        command = options("pretrain", "model=smart_nano", "pretraining.auxiliary=0.1", f"output={output}")
        command = [each for each in command if each != "model=nano"]
        assert run("pretrain", *command).status == 0
        if output.name == "resumed":
            for late in (*output.glob("checkpoints/*6.pt"), output / "policy.pt", output / "result.json"):
                late.unlink()
            assert run("pretrain", *command).status == 0
        weights, _, _ = load_policy(output / "policy.pt")
        digests.append(digest_of(weights))
        assert not any(name.startswith("auxiliary") for name in weights)
    assert digests[0] == digests[1]
    assert all(value > 0 for _, value in read_curve(tmp_path / "whole", "train/loss_auxiliary"))


@pytest.mark.parametrize(
    ("option", "told"),
    [
        ("pretraining.auxiliary=0.1", "MotionLM has no auxiliary loss, and pretraining.auxiliary=0.1 asks for one"),
        ("pretraining.auxiliary=-1", "pretraining.auxiliary must be at least 0, got -1"),
    ],
)
def test_a_weight_without_a_meaning_is_refused(
    run: Callable, options: Callable, tmp_path: Path, option: str, told: str
) -> None:
    outcome = run("pretrain", *options("pretrain", option, f"output={tmp_path / 'run'}"))
    assert outcome.status == 2 and told in outcome.err and outcome.err.count("error:") == 1, outcome.err
