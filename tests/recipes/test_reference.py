"""A comparison that starts from policies that are there already."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from dpa import zoo
from dpa.training.checkpoint import load_policy, save_policy
from recipes.common.cli import CONFIG
from recipes.experiment.check import check_experiment
from recipes.experiment.jobs import adopt, compared_policy, pretrain_job, reference_of

NANO = "zoo:motionlm-nano-sumo"


def configuration(*options: str) -> DictConfig:
    return composed("model=nano", "model.context.max_pieces=256", *options)


def composed(*options: str) -> DictConfig:
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        return compose("compare", list(options))


def test_the_reference_of_each_seed_is_the_policy_that_is_named(tmp_path: Path) -> None:
    cfg = configuration(f"reference={NANO}", "seeds=[3,4]", f"output={tmp_path}")
    check_experiment(cfg)
    for seed in (3, 4):
        assert pretrain_job(cfg, seed) == {}, "nothing is trained"
        there = tmp_path / f"seed_{seed}/reference/policy.pt"
        assert there.read_bytes() == zoo.find("motionlm-nano-sumo").read_bytes()
        pretrain_job(cfg, seed)  # again, after a kill


def test_seeds_may_have_references_of_their_own(tmp_path: Path) -> None:
    weights, config, made = load_policy(zoo.find("motionlm-nano-sumo"))
    mine = save_policy(tmp_path / "mine.pt", weights, config, made)
    cfg = configuration(f"reference=['{NANO}',{mine}]", "seeds=[3,4]")
    assert reference_of(cfg, 3) == zoo.find("motionlm-nano-sumo") and reference_of(cfg, 4) == mine


@pytest.mark.parametrize("name", zoo.names())
def test_without_a_section_model_the_policies_are_made_as_their_reference(name: str) -> None:
    cfg = composed("~model", f"reference=zoo:{name}", "seeds=[0]")
    check_experiment(cfg)
    assert compared_policy(cfg) == load_policy(zoo.find(name))[1]


def test_references_of_two_shapes_are_refused_and_neither_model_nor_reference_as_well() -> None:
    with pytest.raises(ValueError, match=r"zoo:smart-nano-sumo was made with other options than the first one"):
        check_experiment(composed("~model", f"reference=['{NANO}','zoo:smart-nano-sumo']", "seeds=[0,1]"))
    with pytest.raises(ValueError, match="no section model to train references of; say model=NAME, or reference=FILE"):
        check_experiment(composed("~model"))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["reference=zoo:nobody"], "the zoo has no policy 'nobody'"),
        ([f"reference=['{NANO}']", "seeds=[0,1]"], "reference has 1 policies for the 2 seeds"),
        ([f"reference={NANO}", "model=small"], "reference=zoo:motionlm-nano-sumo was made with other options"),
        ([f"reference={NANO}", "model.tokenizer.frame=scene"], "'tokenizer.frame': 'current' there, 'scene' here"),
        (["reference=3"], "reference must be a file or zoo:NAME, a list of them, or null, got 3"),
        (["reference=nowhere.pt"], "nowhere.pt does not exist"),
    ],
)
def test_a_reference_that_does_not_fit_is_refused_before_any_work(options: list[str], told: str) -> None:
    with pytest.raises((ValueError, OSError), match=told):
        check_experiment(configuration(*options))


def test_a_folder_of_another_reference_is_refused(tmp_path: Path) -> None:
    first, other, place = tmp_path / "a.pt", tmp_path / "b.pt", tmp_path / "seed_0/reference/policy.pt"
    first.write_bytes(b"a"), other.write_bytes(b"b")
    adopt(first, place)
    adopt(first, place)
    with pytest.raises(ValueError, match=r"policy.pt is another policy than .*b.pt; name another output"):
        adopt(other, place)


@pytest.mark.slow
def test_a_comparison_runs_from_a_reference_of_the_zoo(run: Callable, options: Callable, tmp_path: Path) -> None:
    small = ["~model", f"reference={NANO}", "seeds=[0]", "workers=1", "pictures.scenes=0"]
    grid = ["decoding.grid=[[0.95,1.0]]", "decoding.num_rollouts=2", "alignment.snapshots=[]", "drift_rollouts=1"]
    fewer = [f"~{part}" for part in ("methods.sft_best_oa", "methods.sft_best_ade", "methods.adversarial_afd")]
    fewer += ["~experiment.setup.adversarial_afd", "experiment.checkpoints=last"]
    command = [each for each in options("compare", *small, *grid, *fewer, f"output={tmp_path}") if each != "model=nano"]
    outcome = run("compare", *command)
    assert outcome.status == 0, outcome.err
    assert "reference" in outcome.out and (tmp_path / "index.html").is_file()
    assert not (tmp_path / "seed_0/reference/checkpoints").exists(), "nothing was pre-trained"
    assert "chosen on the tuning scenes" not in outcome.out and not list(tmp_path.glob("seed_0/*/tune_*.json"))


if __name__ == "__main__":
    pytest.main([__file__])
