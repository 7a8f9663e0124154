"""A policy whose actions are poses, and no tokens of a vocabulary, goes through everything that a recipe does."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra import compose, initialize_config_dir

from dpa.models import Contexts, MotionActor
from dpa.preferences import PreferenceStore
from dpa.training.checkpoint import load_policy
from envs import keys
from recipes.common.cli import CONFIG
from recipes.common.models import open_policy
from recipes.experiment.check import check_experiment

MODEL = "behaviorgpt_nano"


@pytest.fixture(scope="module")
def trained(run: Callable, options: Callable, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A policy that has hardly learnt anything, and rankings of its rollouts."""
    folder, chosen = tmp_path_factory.mktemp(MODEL), f"model={MODEL}"
    for recipe, told in (
        ("pretrain", [chosen, f"output={folder}"]),
        ("collect", [f"policy={folder / 'policy.pt'}", f"output={folder / 'ranked'}"]),
    ):
        outcome = run(recipe, *options(recipe, *told))
        assert outcome.status == 0, outcome.err
    return SimpleNamespace(policy=folder / "policy.pt", ranked=folder / "ranked")


@pytest.mark.parametrize(
    "method",
    ["dpa_omf", "kto", "per_agent", "sft_best_oa", "adversarial_afd", "rloo", "grpo", "dpa_omf_on_policy"],
)
def test_it_is_aligned_and_evaluated(
    trained: SimpleNamespace, run: Callable, options: Callable, tmp_path: Path, method: str
) -> None:
    ranked = [] if method in ("rloo", "grpo", "dpa_omf_on_policy") else [f"preferences={trained.ranked}"]
    told = options("align", f"method={method}", f"policy={trained.policy}", *ranked, f"output={tmp_path / 'aligned'}")
    outcome = run("align", *told)
    assert outcome.status == 0, outcome.err
    before, after = (load_policy(path)[0] for path in (trained.policy, tmp_path / "aligned/policy.pt"))
    assert any(not torch.equal(before[name], value) for name, value in after.items())
    assert all(value.isfinite().all() for value in after.values())
    scored = options("evaluate", f"policy={tmp_path / 'aligned/policy.pt'}", f"json={tmp_path / 'scores.json'}")
    outcome = run("evaluate", *scored)
    assert outcome.status == 0, outcome.err
    assert 0 < json.loads((tmp_path / "scores.json").read_text())["mean"]["realism"] < 1


def test_it_is_taken_apart_watched_and_set_beside_others(
    trained: SimpleNamespace, run: Callable, options: Callable, tmp_path: Path
) -> None:
    chosen, policies = f"model={MODEL}", f"policies={trained.policy}"
    for recipe, told in (
        ("gap", [policies, f"output={tmp_path / 'gap'}"]),
        ("ladder", [chosen, policies, f"output={tmp_path / 'ladder'}"]),
        ("tokens", [chosen, f"json={tmp_path / 'tokens.json'}"]),
        ("play", [policies, f"output={tmp_path / 'film.html'}"]),
    ):
        outcome = run(recipe, *options(recipe, *told))
        assert outcome.status == 0, (recipe, outcome.err)


def test_its_rankings_hold_its_patches(trained: SimpleNamespace) -> None:
    group = PreferenceStore(trained.ranked)[0]
    assert group[keys.TOKENS].shape[3:] == (8, 30) and group[keys.TOKENS].dtype == torch.float32
    counts = group[keys.TOKEN_VALID][:, None]
    assert group[keys.TOKENS][counts.expand(group[keys.TOKENS].shape[:4])].any()


def test_a_method_that_needs_a_vocabulary_is_refused_in_one_sentence(
    trained: SimpleNamespace, run: Callable, options: Callable, tmp_path: Path
) -> None:
    outcome = run("align", *options("align", "method=cat_k", f"policy={trained.policy}", f"output={tmp_path}"))
    assert outcome.status == 2
    assert "CAT-K follows the log by a policy's own most probable tokens, and patches have none" in outcome.err


@pytest.mark.parametrize(
    ("told", "message"),
    [
        (["pretraining.label_smoothing=0.1"], "label_smoothing=0.1 needs a vocabulary"),
        (["tokenizer@model.tokenizer=verlet"], "set tokenizer=patches"),
    ],
)
def test_an_option_that_needs_a_vocabulary_is_refused(
    told: list, message: str, run: Callable, options: Callable, tmp_path: Path
) -> None:
    outcome = run("pretrain", *options("pretrain", f"model={MODEL}", *told, f"output={tmp_path}"))
    assert outcome.status == 2 and message in outcome.err, outcome.err


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ("experiment=baselines", "methods.cat_k: CAT-K follows the log by a policy's own most probable tokens"),
        ("pretraining.label_smoothing=0.1", "label_smoothing=0.1 needs a vocabulary"),
        ("methods.dpa_omf.loss.reference=false", "methods.dpa_omf: .*reference=false compares how likely rollouts are"),
        ("methods.sft_best_oa.loss.label_smoothing=0.1", "methods.sft_best_oa: .*label_smoothing=0.1 needs a vocab"),
    ],
)
def test_an_experiment_is_refused_before_any_work(told: str, message: str) -> None:
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        cfg = compose("compare", [f"model={MODEL}", told])
    with pytest.raises(ValueError, match=message):
        check_experiment(cfg)


def test_decoding_that_cannot_be_compiled_is_refused(trained: SimpleNamespace) -> None:
    model = open_policy(trained.policy)[0]
    with pytest.raises(ValueError, match="compile=true: decoding of BehaviorGPT is not compiled; say compile=false"):
        MotionActor(model, Contexts([], model.featurize), compile=True)


if __name__ == "__main__":
    pytest.main([__file__])
