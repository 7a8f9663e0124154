"""Pre-training that goes on from another policy, on scenes of another source."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from dpa.training.checkpoint import load_policy
from dpa.training.distributed import Ranks
from dpa.training.loggers import read_curve
from envs import keys
from recipes import pretrain as pretraining
from recipes.common.models import digest_of, open_policy, policy_file


def elsewhere(options: Callable, stores: Path, start: object, output: Path, *more: str) -> list[str]:
    """Options of a training on other scenes."""
    command = options("pretrain", f"pretraining.start={start}", f"output={output}", "seed=1", *more)
    return [*command, f"scenes.train={stores / 'other'}"]


def test_training_goes_on_from_the_weights_of_the_start(
    run: Callable, options: Callable, stores: Path, origin: Path, tmp_path: Path
) -> None:
    command = elsewhere(options, stores, origin, tmp_path, "pretraining.lr=1e-9", "pretraining.steps=2")
    outcome = run("pretrain", *command)
    assert outcome.status == 0, outcome.err
    (before, _, made), (after, _, now) = load_policy(origin), load_policy(tmp_path / "policy.pt")
    assert all(torch.allclose(after[name], value, atol=1e-6) for name, value in before.items())
    assert now["start"]["weights"] == digest_of(before) and now["start"]["tune_nll"] == made["tune_nll"]
    assert now["start"]["source"] == now["source"] == "store" and now["start"]["start"] is None


def test_the_start_is_measured_and_kept_where_training_makes_it_no_better(
    run: Callable, options: Callable, stores: Path, origin: Path, tmp_path: Path
) -> None:
    ruinous = ("pretraining.lr=0.1", "pretraining.steps=3")
    outcome = run("pretrain", *elsewhere(options, stores, origin, tmp_path, *ruinous))
    assert outcome.status == 0, outcome.err
    (first, nll), *others = read_curve(tmp_path, "tune/nll")
    assert first == 0 and all(value > nll for _, value in others)
    weights, _, made = load_policy(tmp_path / "policy.pt")
    assert made["tune_nll"] == nll and digest_of(weights) == digest_of(load_policy(origin)[0])


def test_with_noise_start_and_policy_are_measured_by_the_labels_that_are_learnt(
    run: Callable, options: Callable, stores: Path, origin: Path, tmp_path: Path
) -> None:
    """Those lead back from noise; by the tokens of clean logs the start would be ahead of whoever learns them."""
    noisy = ("pretraining.lr=1e-9", "pretraining.steps=3", "pretraining.noise=0.3", "pretraining.recovery=0.25")
    outcome = run("pretrain", *elsewhere(options, stores, origin, tmp_path, *noisy))
    assert outcome.status == 0, outcome.err
    (first, before), *others = read_curve(tmp_path, "tune/nll")
    assert first == 0 and all(value == pytest.approx(before, abs=1e-4) for _, value in others)
    assert abs(before - load_policy(origin)[2]["tune_nll"]) > 1e-3


def test_noisy_tokens_are_read_and_the_way_back_is_learnt(
    run: Callable, options: Callable, stores: Path, origin: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, whole = [], pretraining.accumulate_gradients

    def watching(loss: Any, parts: Iterable[tuple[TensorDict, float]], ranks: Ranks) -> Any:
        parts = list(parts)
        seen.append((loss.tensor_keys.labels, parts[0][0]))
        return whole(loss, parts, ranks)

    monkeypatch.setattr(pretraining, "accumulate_gradients", watching)
    noisy = ("pretraining.noise=0.3", "pretraining.steps=2", "pretraining.warmup=1")
    outcome = run("pretrain", *elsewhere(options, stores, origin, tmp_path, *noisy))
    assert outcome.status == 0, outcome.err
    labels, batch = seen[0]
    assert labels == keys.LABELS and not torch.equal(batch[keys.TOKENS], batch[keys.LABELS])


def test_a_start_with_other_tokens_or_another_size_is_refused(
    run: Callable, options: Callable, stores: Path, origin: Path, tmp_path: Path
) -> None:
    for option in ("model.tokenizer.frame=scene", "model.context.max_pieces=99", "model.size=small"):
        outcome = run("pretrain", *elsewhere(options, stores, origin, tmp_path / "run", option))
        assert outcome.status == 2 and outcome.err.count("error:") == 1
        assert option.split(".")[-1].split("=")[0] in outcome.err or "width" in outcome.err
        assert str(origin) in outcome.err and not (tmp_path / "run/checkpoints").exists()


def test_a_start_that_is_no_policy_is_refused(run: Callable, options: Callable, stores: Path, tmp_path: Path) -> None:
    torn = tmp_path / "torn.pt"
    torn.write_bytes(b"PK\x03\x04 torn")
    for start, told in ((torn, "torn.pt"), ("zoo:motionlm-nano-sum", "Did you mean zoo:motionlm-nano-sumo?")):
        outcome = run("pretrain", *elsewhere(options, stores, start, tmp_path / "run"))
        assert outcome.status == 2 and told in outcome.err, outcome.err


def test_a_run_of_another_start_is_another_run(
    run: Callable, options: Callable, stores: Path, origin: Path, tmp_path: Path
) -> None:
    command = elsewhere(options, stores, origin, tmp_path, "pretraining.steps=2")
    assert run("pretrain", *command).status == 0
    same = run("pretrain", *command)
    assert same.status == 0 and "step/s" not in same.err, "nothing is trained again"
    other = run("pretrain", *(option for option in command if "pretraining.start" not in option))
    assert other.status == 2 and "other options" in other.err


def test_without_a_section_model_training_goes_on_with_the_policy_as_it_is_vocabulary_and_all(
    run: Callable, options: Callable, stores: Path, tmp_path: Path
) -> None:
    start, told = "zoo:smart-nano-sumo", ["pretraining.steps=2", "pretraining.lr=1e-9", "~model"]
    command = [each for each in elsewhere(options, stores, start, tmp_path, *told) if not each.startswith("model=")]
    outcome = run("pretrain", *command)
    assert outcome.status == 0, outcome.err
    (weights, config, _), (before, made, _) = load_policy(tmp_path / "policy.pt"), load_policy(policy_file(start))
    assert config == made
    assert all(torch.allclose(weights[name], value, atol=1e-6) for name, value in before.items())


def test_neither_a_section_model_nor_a_start_is_refused(run: Callable, options: Callable, tmp_path: Path) -> None:
    command = [each for each in options("pretrain", f"output={tmp_path / 'run'}") if not each.startswith("model=")]
    outcome = run("pretrain", *command, "~model")
    assert outcome.status == 2 and "say model=NAME, or pretraining.start=FILE" in outcome.err, outcome.err
    assert not (tmp_path / "run/checkpoints").exists()


def test_what_a_policy_started_from_changes_nothing_about_how_it_is_opened(
    run: Callable, options: Callable, stores: Path, origin: Path, tmp_path: Path
) -> None:
    assert run("pretrain", *elsewhere(options, stores, origin, tmp_path, "pretraining.steps=2")).status == 0
    assert open_policy(tmp_path / "policy.pt")[2] == open_policy(origin)[2]


if __name__ == "__main__":
    pytest.main([__file__])
