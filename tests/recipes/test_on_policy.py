"""Methods that learn from rollouts of the policy as it is: RLOO, GRPO and pairs of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dpa.realism.config import FOLDER
from dpa.rewards.functions import judge
from dpa.training.checkpoint import load_policy
from dpa.training.loggers import read_curve
from recipes.alignment.on_policy import tasks_of

METHODS = ("rloo", "grpo", "dpa_omf_on_policy")
FEW = ("method.data.num_rollouts=4",)


def aligning(options: Callable, policy: Path, method: str, output: Path, *more: str) -> list[str]:
    return options("align", f"method={method}", f"policy={policy}", f"output={output}", *FEW, *more)


def assert_same(mine: Path, other: Path, atol: float = 0.0) -> None:
    ours, theirs = (load_policy(folder / "policy.pt")[0] for folder in (mine, other))
    assert all(torch.allclose(ours[name], value, rtol=0, atol=atol) for name, value in theirs.items())


@pytest.mark.parametrize("method", METHODS)
def test_it_needs_no_preferences_and_tells_what_it_rolls_out(
    run: Callable, options: Callable, origin: Path, tmp_path: Path, method: str
) -> None:
    outcome = run("align", *aligning(options, origin, method, tmp_path))
    assert outcome.status == 0, outcome.err
    rolled = ["rollout_distance", "rollout_ade", "rollout_spread", "seconds_rollout"]
    rolled += [] if method == "dpa_omf_on_policy" else ["rollout_pair_accuracy"]
    for curve in (*rolled, "seconds_learning", "staleness", "kl", "entropy"):
        values = [value for _, value in read_curve(tmp_path, f"train/{curve}")]
        assert len(values) == 4 and min(values) >= 0, curve
    seconds = {
        name: [value for _, value in read_curve(tmp_path, f"train/seconds_{name}")] for name in ("rollout", "ranking")
    }
    assert all(0 < part < whole for part, whole in zip(seconds["ranking"], seconds["rollout"], strict=True))
    assert read_curve(tmp_path, "train/kl")[0][1] == pytest.approx(0.0, abs=1e-6) or method == "grpo"
    before, after = load_policy(origin)[0], load_policy(tmp_path / "policy.pt")
    assert after[2]["method"] == method
    assert any(not torch.equal(after[0][name], value) for name, value in before.items())


@pytest.mark.slow
def test_a_policy_gradient_comes_nearer_to_the_log(
    run: Callable, options: Callable, origin: Path, tmp_path: Path
) -> None:
    long = ("alignment.steps=40", "alignment.lr=3e-3", "alignment.scenes_per_step=8", "method.data.num_rollouts=8")
    outcome = run("align", *aligning(options, origin, "rloo", tmp_path, *long))
    assert outcome.status == 0, outcome.err
    distances = [value for _, value in read_curve(tmp_path, "train/rollout_distance")]
    assert sum(distances[-5:]) < 0.9 * sum(distances[:5])


@pytest.mark.parametrize(
    "rewards",
    [
        {"realism": 1},
        {"step_distance": 1, "scale": "group"},
        {"agent_distance": 0.5, "collision": 1, "wrong_way": 1, "scale": "group"},
    ],
)
def test_it_follows_any_reward_and_tells_what_was_paid(
    run: Callable, options: Callable, origin: Path, tmp_path: Path, rewards: dict[str, float | str]
) -> None:
    scale = rewards.pop("scale", "none")
    followed = {"agent_distance": 0, **rewards}
    more = [f"method.data.rewards.{name}={weight}" for name, weight in followed.items()]
    outcome = run("align", *aligning(options, origin, "rloo", tmp_path, f"method.data.scale={scale}", *more))
    assert outcome.status == 0, outcome.err
    paid = {path.stem for path in (tmp_path / "scalars/train").glob("reward_*.csv")}
    assert paid == {f"reward_{name}" for name in rewards}
    assert max(value for _, value in read_curve(tmp_path, "train/gradient_norm")) > 0


@pytest.mark.parametrize("method", METHODS)
def test_rows_of_a_pass_change_rounding_alone(
    run: Callable, options: Callable, origin: Path, tmp_path: Path, method: str
) -> None:
    for name, rows in (("one", 1), ("all", 999)):
        more = (f"alignment.max_rows={rows}", "alignment.steps=2")
        outcome = run("align", *aligning(options, origin, method, tmp_path / name, *more))
        assert outcome.status == 0, outcome.err
    assert_same(tmp_path / "one", tmp_path / "all", atol=1e-5)


@pytest.mark.parametrize("pairs", [["pairs=random"], ["pairs=all", "num=null"], ["rank_by=ade"]])
def test_pairs_of_its_own_may_be_any(
    run: Callable, options: Callable, origin: Path, tmp_path: Path, pairs: list[str]
) -> None:
    more = [f"method.data.{option}" for option in pairs]
    outcome = run("align", *aligning(options, origin, "dpa_omf_on_policy", tmp_path, "alignment.steps=2", *more))
    assert outcome.status == 0, outcome.err
    assert len(read_curve(tmp_path, "train/loss_preference")) == 2


def test_what_decides_nothing_is_no_other_run_and_the_content_of_a_metric_is(
    run: Callable, options: Callable, origin: Path, tmp_path: Path
) -> None:
    steps = "alignment.steps=2"
    rloo = aligning(options, origin, "rloo", tmp_path / "rloo", steps)
    assert run("align", *rloo).status == 0
    same = ("method.data.ranking.threads=2", "alignment.pairs_per_scene=3")
    assert run("align", *rloo, *same).status == 0, "read back"
    ours, mine = FOLDER / "2024.yaml", tmp_path / "mine.yaml"
    mine.write_text(ours.read_text())
    ranked = (steps, "ranking@method.data.ranking=realism", f"method.data.ranking.metric={mine}")
    pairs = aligning(options, origin, "dpa_omf_on_policy", tmp_path / "pairs", *ranked)
    assert run("align", *pairs).status == run("align", *pairs).status == 0
    mine.write_text(ours.read_text().replace("corner_rounding: 0.7", "corner_rounding: 0.5"))
    judge.cache_clear()  # another command is another process
    told = run("align", *pairs)
    assert told.status == 2 and "data.ranking.digest" in told.err, told.err


@pytest.mark.parametrize(("ranking", "told"), [("realism", "missed"), ("displacement", "distance")])
def test_pairs_of_its_own_may_be_ranked_by_another_distance(
    run: Callable, options: Callable, origin: Path, tmp_path: Path, ranking: str, told: str
) -> None:
    more = ("alignment.steps=2", f"ranking@method.data.ranking={ranking}", "method.loss.credit=agent")
    outcome = run("align", *aligning(options, origin, "dpa_omf_on_policy", tmp_path, *more))
    assert outcome.status == 0, outcome.err
    assert max(value for _, value in read_curve(tmp_path, "train/gradient_norm")) > 0
    rolled = {path.stem for path in (tmp_path / "scalars/train").glob("rollout_*.csv")}
    assert rolled == {f"rollout_{told}", "rollout_ade", "rollout_spread"}


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_run_that_is_cut_goes_on_to_the_same_weights(
    options: Callable, align_with_a_kill: Callable, origin: Path, tmp_path: Path, method: str
) -> None:
    def arguments(output: Path) -> list[str]:
        return aligning(options, origin, method, output, "alignment.steps=30")

    align_with_a_kill(arguments, tmp_path, checkpoint=4)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["process", "ray"])
def test_processes_that_roll_out_change_rounding_alone(
    run: Callable, options: Callable, origin: Path, tmp_path: Path, backend: str
) -> None:
    crew = (f"alignment.workers.backend={backend}", "alignment.workers.count=2")
    ray = pytest.importorskip("ray") if backend == "ray" else None
    try:
        for name, more in (("alone", ()), ("crew", crew)):
            outcome = run("align", *aligning(options, origin, "rloo", tmp_path / name, *more))
            assert outcome.status == 0, outcome.err
    finally:
        if ray is not None:
            ray.shutdown()
    assert_same(tmp_path / "alone", tmp_path / "crew", atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["grpo", "dpa_omf_on_policy"])
def test_workers_that_roll_out_while_a_step_learns_keep_to_the_bound(
    run: Callable, options: Callable, origin: Path, tmp_path: Path, method: str
) -> None:
    crew = ("alignment.workers.backend=process", "alignment.workers.count=2", "alignment.staleness=2")
    outcome = run("align", *aligning(options, origin, method, tmp_path, "alignment.steps=8", *crew))
    assert outcome.status == 0, outcome.err
    ages = [value for _, value in read_curve(tmp_path, "train/staleness")]
    assert ages[0] == 0 and 0 < max(ages) <= 2 and sum(ages) > 4


def test_no_two_steps_roll_out_by_the_same_draws_and_all_workers_have_a_part() -> None:
    sizes = {0: 3, 1: 4, 2: 5}
    tasks = {step: tasks_of(step, sizes, num_rollouts=4, most=1000, workers=2) for step in (0, 1)}
    drawn = {step: {(task.scenes, k) for task in each for piece in task.pieces for k in piece}
             for step, each in tasks.items()}  # fmt: skip
    assert not drawn[0] & drawn[1]
    assert all(len(each) >= 2 for each in tasks.values())
    assert {k for _, k in drawn[1]} == {4, 5, 6, 7}


@pytest.mark.parametrize(
    ("method", "more", "told"),
    [
        ("rloo", ["preferences=runs/x"], "rloo rolls the policy out by itself and reads no rollouts"),
        ("rloo", ["method.data.num_rollouts=1"], "method.data.num_rollouts must be 2 or more, got 1"),
        ("rloo", ["method.data.passes=2"], "say method.loss.clip=0.2, or method.data.passes=1"),
        ("rloo", ["method.data.rewards.agent_distance=0"], "weigh 0"),
        ("rloo", ["+method.data.rewards.speed=1"], "there is no reward 'speed'"),
        ("rloo", ["method.data.rewards.collision=-1"], "the reward collision weighs -1"),
        ("rloo", ["method.data.rewards.ade=much"], "method.data.rewards.ade must be a number, got 'much'"),
        ("rloo", ["method.data.baseline=none"], "method.data.baseline must be leave_one_out or mean, got 'none'"),
        ("rloo", ["method.data.rewards=ade"], "method.data.rewards must be a section, got 'ade'"),
        (
            "rloo",
            ["+method.data.decoding.top_p=0.9"],
            "method.data.decoding says nothing to method.data.kind=own_groups",
        ),
        ("dpa_omf_on_policy", ["method.data.decoding.top_p=0"], "top_p must be above 0, got 0"),
        ("dpa_omf_on_policy", ["+method.data.margin=0.1"], "method.data.margin says nothing"),
        ("rloo", ["method.data.ranking.features=all"], "unknown feature set 'all'"),
        ("rloo", ["method.loss.kl=-1"], "method.loss.kl must be 0 or more, got -1"),
        ("rloo", ["~method.data.passes"], "method.data.kind=own_groups needs method.data.passes"),
        ("rloo", ["alignment.workers.count=2"], "2 workers need backend=process"),
        ("rloo", ["alignment.staleness=1"], "say method.loss.clip=0.2, or alignment.staleness=0"),
        ("grpo", ["alignment.staleness=1"], "staleness=1 needs workers that roll out while"),
        (
            "rloo",
            ["ranking@method.data.ranking=displacement", "method.data.rewards.step_distance=1"],
            "step_distance needs a distance that couples moments",
        ),
        ("grpo", ["method.loss.clip=0"], "method.loss.clip must be above 0, got 0"),
        ("dpa_omf_on_policy", ["method.data.num=3"], "method.data.num=3 needs 6 rollouts of a scene and there are 4"),
        ("dpa_omf_on_policy", ["method.loss.kind=policy_gradient"], "policy_gradient learns from groups"),
    ],
)
def test_options_that_do_not_fit_end_in_one_error(
    run: Callable, options: Callable, origin: Path, tmp_path: Path, method: str, more: list[str], told: str
) -> None:
    outcome = run("align", *aligning(options, origin, method, tmp_path / "run"), *more)
    assert outcome.status == 2 and told in outcome.err and outcome.err.count("error:") == 1, outcome.err
    assert not (tmp_path / "run/checkpoints").exists()


if __name__ == "__main__":
    pytest.main([__file__])
