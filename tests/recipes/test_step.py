"""What a step of an alignment learns from: which rollouts, by which weights, with which sign."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir

from dpa.rewards import advantages
from dpa.training.distributed import ALONE
from envs import keys
from envs.store import SceneStore
from recipes.align import make_step
from recipes.alignment.inputs import Inputs
from recipes.common.cli import CONFIG
from recipes.experiment import jobs
from tests.recipes.test_methods import configuration

FEW = ("alignment.steps=4", "alignment.warmup=1", "alignment.scenes_per_step=2", "alignment.lr=1e-2")


@pytest.fixture
def make(origin: Path, stores: Path) -> Callable[..., Any]:
    """Makes the step of a method that rolls out by itself."""

    def make(method: str, *options: str) -> Any:
        told = [f"method={method}", f"policy={origin}", *FEW]
        told += [] if method == "cat_k" else ["method.data.num_rollouts=4"]
        with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
            cfg = compose("align", [*told, *options])
        inputs = Inputs.open(origin, None, None, SceneStore(stores / "train"), None, "cpu")
        return make_step(cfg.method, inputs, cfg.alignment, 0, "cpu", ALONE)

    return make


def test_pairs_of_its_own_prefer_the_nearest_to_the_farthest(make: Callable) -> None:
    step = make("dpa_omf_on_policy", "method.data.num=2")
    for one in step._roll_out(0):
        group, order = step._paired(one, 0), one.ranked[keys.DISTANCE].argsort(stable=True)
        assert torch.equal(group.preferred, one.ranked[keys.TOKENS][order[:2]])
        assert torch.equal(group.unpreferred, one.ranked[keys.TOKENS][order[-2:].flip(0)])


def test_advantages_are_those_of_each_reward_by_its_weight_baseline_and_scale(make: Callable) -> None:
    weights = {"agent_distance": 0.5, "ade": 2.0}
    told = [f"method.data.rewards.{name}={weight}" for name, weight in weights.items()]
    step = make("rloo", *told, "method.data.baseline=mean", "method.data.scale=group")
    one = step._roll_out(0)[0]
    paid = one.ranked[keys.REWARDS]
    each = [w * advantages(paid[name][None], baseline="mean", scale="group")[0] for name, w in weights.items()]
    torch.testing.assert_close(step._graded(one), sum(each))


def test_rollouts_are_drawn_from_the_policy_as_it_is_without_a_nucleus(make: Callable) -> None:
    step = make("grpo", "method.data.passes=1", "method.loss.clip=1e-3")
    assert [step(number)["clip_fraction"].item() for number in range(3)] == [0.0] * 3, "all ratios of likelihoods are 1"


def test_grpo_takes_every_pass_as_a_step_of_the_optimizer(make: Callable) -> None:
    step = make("grpo")
    step(0)
    assert {int(state["step"]) for state in step.optimizer.state.values()} == {2}


def test_cat_k_imitates_the_way_back_and_not_its_own_tokens(make: Callable) -> None:
    accepted = make("cat_k").loss.tensor_keys
    assert (accepted.labels, accepted.learnt) == (keys.LABELS, keys.LEARNT)


@pytest.mark.parametrize("method", ["dpa_omf", "rloo", "cat_k"])
def test_all_methods_learn_from_the_aligned_scenes_alone(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    cfg, given = configuration("experiment=competent", "aligned_scenes=2"), {}
    monkeypatch.setattr(jobs, "open_splits", lambda _: SimpleNamespace(train=range(4), tune=range(2)))
    monkeypatch.setattr(jobs, "seconds_trained", lambda _: 0.0)
    monkeypatch.setattr(jobs, "align", lambda *_, **options: given.update(options))
    jobs.align_job(cfg, 3, method)
    assert given["among"] == jobs.learnt_from(cfg, 4) and len(given["among"]) == 2
