"""Tokens of logged motions, and decisions of another length, go through everything that a recipe does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from dpa.tokens.vocabulary import digest_of, read_vocabulary
from recipes.common.models import open_policy

K_DISKS = "tokenizer@model.tokenizer=k_disks"


@pytest.fixture(scope="module")
def words(run: Callable, options: Callable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("vocabulary") / "words.npz"
    outcome = run("vocabulary", *options("vocabulary", "vocabulary.size=24", f"output={path}"))
    assert outcome.status == 0, outcome.err
    assert "vehicle" in outcome.out and "covered" in outcome.out
    return path


def test_the_card_says_what_made_it_and_what_it_covers(words: Path) -> None:
    motions, card = read_vocabulary(words)
    assert motions.shape[1] <= 24 and card["steps"] == 5 and card["scenes"]
    vehicles = card["classes"]["vehicle"]
    assert vehicles["entries"] == motions.shape[1] and 0 < vehicles["mean"] < vehicles["p99"]
    assert 0.5 < vehicles["covered"] <= 1


def test_a_grid_is_a_vocabulary_too_and_another_maker_is_refused(
    run: Callable, options: Callable, tmp_path: Path
) -> None:
    path = tmp_path / "grid.npz"
    of = options("vocabulary", "vocabulary.size=24", f"output={path}")
    assert run("vocabulary", *of, "vocabulary.maker=grid").status == 0
    motions, card = read_vocabulary(path)
    assert card["maker"] == "grid" and 2 < motions.shape[1] <= 24
    wrong = {
        "vocabulary.maker=k_means": "must be one of k_disks, grid, got 'k_means'",
        "vocabulary.size=0": "vocabulary.size must be 1 or more, got 0",
        "vocabulary.radius=-0.1": "vocabulary.radius must be above 0, got -0.1",
        "vocabulary.steps=100": "vocabulary.steps must be from 1 to 10, got 100",
    }
    for option, told in wrong.items():
        outcome = run("vocabulary", *of, option)
        assert outcome.status == 2 and told in outcome.err, outcome.err
    np.save(tmp_path / "motions.npy", motions.numpy())
    with pytest.raises(ValueError, match="motions.npy is no vocabulary"):
        read_vocabulary(tmp_path / "motions.npy")


def trained(run: Callable, options: Callable, folder: Path, *more: str) -> Path:
    outcome = run("pretrain", *options("pretrain", *more, f"output={folder}"))
    assert outcome.status == 0, outcome.err
    return folder / "policy.pt"


def test_a_policy_of_logged_motions_is_trained_collected_aligned_and_evaluated_without_their_file(
    words: Path, run: Callable, options: Callable, tmp_path: Path
) -> None:
    copy = tmp_path / "copy.npz"
    copy.write_bytes(words.read_bytes())
    policy = trained(run, options, tmp_path / "reference", K_DISKS, f"model.tokenizer.table={copy}")
    digest = digest_of(read_vocabulary(copy).motions)
    copy.unlink()
    model, _, config = open_policy(policy)
    assert config["tokenizer"] == {"name": "k_disks", "steps": 5, "size": model.tokenizer.vocab_size, "digest": digest}
    assert torch.equal(model.tokenizer.motions, read_vocabulary(words).motions)
    ranked, aligned = tmp_path / "ranked", tmp_path / "aligned"
    for recipe, more in (
        ("collect", [f"policy={policy}", f"output={ranked}"]),
        ("align", ["method=dpa_omf", f"policy={policy}", f"preferences={ranked}", f"output={aligned}"]),
        ("evaluate", [f"policy={aligned / 'policy.pt'}", f"json={tmp_path / 'scores.json'}"]),
    ):
        outcome = run(recipe, *options(recipe, *more))
        assert outcome.status == 0, outcome.err


@pytest.mark.parametrize(("steps", "horizon"), [(10, 8), (4, 20)])
def test_a_decision_lasts_as_long_as_a_token(
    run: Callable, options: Callable, tmp_path: Path, steps: int, horizon: int
) -> None:
    policy = trained(run, options, tmp_path / "reference", f"model.tokenizer.steps={steps}")
    model, episode, _ = open_policy(policy)
    assert (episode.decision_steps, episode.horizon, model.config.horizon) == (steps, horizon, horizon)
    outcome = run("collect", *options("collect", f"policy={policy}", f"output={tmp_path / 'ranked'}"))
    assert outcome.status == 0, outcome.err
    outcome = run("evaluate", *options("evaluate", f"policy={policy}", f"json={tmp_path / 'scores.json'}"))
    assert outcome.status == 0, outcome.err


def test_a_table_that_is_not_there_is_told(run: Callable, options: Callable, tmp_path: Path) -> None:
    more = (K_DISKS, f"model.tokenizer.table={tmp_path / 'none.npz'}", f"output={tmp_path / 'out'}")
    outcome = run("pretrain", *options("pretrain", *more))
    assert outcome.status == 2 and "none.npz" in outcome.err


if __name__ == "__main__":
    pytest.main([__file__])
