"""Training under torchrun: the same losses as one process, and a kill that another number of ranks goes on from."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dpa.training.checkpoint import load_policy
from dpa.training.loggers import read_curve
from envs.files import PARTIAL_PREFIX

REPOSITORY = Path(__file__).resolve().parents[2]
SECONDS = 240
"""Longer than any of these takes; ranks that wait for each other end in an error."""
TOLERANCE = 1e-4
"""Of a loss, between numbers of ranks: sums in another order differ in their last bits."""
WEIGHTS = 2e-2
"""Likewise of a tensor, relative to its norm: of a gradient that is little but rounding AdamW makes whole steps."""
ALIGNMENT = ("train/loss_preference", "train/logit_std", "train/nll_preferred", "train/entropy", "train/kl")
CURVES = {
    "pretrain": ("train/loss_next_token", "train/accuracy", "train/entropy", "tune/nll", "tune/nll_moving"),
    "dpa_omf": ALIGNMENT,
    "cloning": (*ALIGNMENT, "train/loss_cloning"),
    "sft_best_oa": ("train/loss_next_token", "train/entropy"),
}
"""Figures that must agree, of each run."""
METHODS = {
    "dpa_omf": ["method=dpa_omf", "method.data.num=2"],
    "cloning": ["method=dpa_omf", "method.data.num=2", "method.loss.cloning=0.5"],
    "sft_best_oa": ["method=sft_best_oa", "method.data.num=2"],
}
SPLIT = "max_rows=4"
"""Several parts in a step, and not as many on each rank."""
PRETRAIN = ("pretraining.batch_size=4", f"pretraining.{SPLIT}", "pretraining.mirror=0.5")
SHORT = ("pretraining.steps=10", "pretraining.tune_interval=5", "pretraining.checkpoint_interval=5")
LONG = ("pretraining.steps=50", "pretraining.warmup=5", "pretraining.tune_interval=25", "pretraining.lr=1e-3")
ALIGN_LONG = ("alignment.steps=50", "alignment.scenes_per_step=4", "alignment.pairs_per_scene=2", "alignment.lr=1e-4")


@contextmanager
def torchrun(ranks: int, recipe: str, *arguments: str) -> Iterator[subprocess.Popen]:
    """A recipe as several processes on this machine; none is left behind."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(ranks)]
    process = subprocess.Popen(
        [*command, "-m", f"recipes.{recipe}", *arguments], cwd=REPOSITORY, env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            kill(workers_of(process))
            process.kill()
        process.communicate()


def run_ranks(ranks: int, recipe: str, *arguments: str) -> tuple[int, str]:
    """Exit status, and what all ranks printed."""
    with torchrun(ranks, recipe, *arguments) as process:
        output, _ = process.communicate(timeout=SECONDS)
    return process.returncode, output


def workers_of(process: subprocess.Popen) -> list[int]:
    """The ranks that torchrun has started."""
    return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


def kill(pids: list[int]) -> None:
    for pid in pids:
        os.kill(pid, signal.SIGKILL)


def farthest(mine: Path, other: Path, curves: tuple[str, ...]) -> dict[str, float]:
    """The largest difference of each curve; both have the same steps, each once."""
    found = {}
    for name in curves:
        ours, theirs = read_curve(mine, name), read_curve(other, name)
        assert [step for step, _ in ours] == [step for step, _ in theirs], name
        assert len(dict(ours)) == len(ours), name
        found[name] = max(abs(a - b) for (_, a), (_, b) in zip(ours, theirs, strict=True))
    return found


def assert_same(mine: Path, other: Path, curves: tuple[str, ...]) -> None:
    differences = farthest(mine, other, curves)
    assert max(differences.values()) < TOLERANCE, differences
    ours, theirs = (load_policy(folder / "policy.pt")[0] for folder in (mine, other))
    for name, value in ours.items():
        assert (value - theirs[name]).norm() <= WEIGHTS * theirs[name].norm(), name
    assert not [path for path in mine.rglob("*") if path.name.startswith(PARTIAL_PREFIX)]
    options = [json.loads((folder / "result.json").read_text())["options"] for folder in (mine, other)]
    assert options[0] == options[1], "the number of ranks is no option of the run"


@pytest.mark.slow
def test_two_ranks_pretrain_like_one_process(run: Callable, options: Callable, tmp_path: Path) -> None:
    arguments = options("pretrain", *PRETRAIN, *SHORT)
    status, output = run_ranks(2, "pretrain", *arguments, f"output={tmp_path / 'two'}")
    assert status == 0, output
    assert output.count("policy: ") == 1 and output.count("10/10") == 1, "one of them talks"
    assert run("pretrain", *arguments, f"output={tmp_path / 'one'}").status == 0
    assert_same(tmp_path / "two", tmp_path / "one", CURVES["pretrain"])
    assert sorted(path.name for path in (tmp_path / "two/checkpoints").iterdir()) == [
        f"step_{step:010d}.pt" for step in (5, 10)
    ]


def test_a_recipe_of_one_process_is_refused(run: Callable, options: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("RANK", "0"), ("WORLD_SIZE", "2"), ("LOCAL_RANK", "0")):
        monkeypatch.setenv(name, value)
    outcome = run("compare", *options("compare"))
    assert outcome.status == 2
    assert "recipes.compare runs in one process and torchrun has started 2; start it with python -m" in outcome.err


@pytest.mark.slow
def test_a_batch_that_the_ranks_cannot_share_is_one_error(options: Callable, tmp_path: Path) -> None:
    arguments = options("pretrain", "pretraining.batch_size=3", f"output={tmp_path / 'out'}")
    status, output = run_ranks(2, "pretrain", *arguments)
    errors = [line for line in output.splitlines() if line.startswith("error:")]
    assert status != 0 and len(errors) == 1, output
    assert "pretraining.batch_size=3 is the batch of all 2 ranks together" in errors[0]
    assert "say pretraining.batch_size=4" in errors[0]
    assert not (tmp_path / "out").exists()


# --- fifty steps ----------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """A folder with one process's ``pretrain``, the ``collect`` of its rollouts, and an alignment by each method."""
    folder = tmp_path_factory.mktemp("one")
    for name in ("pretrain", "collect", *METHODS):
        outcome = run(*command(name, options, folder, folder))
        assert outcome.status == 0, outcome.err
    return folder


def command(name: str, options: Callable, runs: Path, output: Path, *more: str) -> list[str]:
    """Recipe and options of one run on the results of ``runs``, into ``output``."""
    policy, into = f"policy={runs / 'pretrain/policy.pt'}", f"output={output / name}"
    if name == "pretrain":
        return ["pretrain", *options("pretrain", *PRETRAIN, *LONG, *more, into)]
    if name == "collect":
        return ["collect", *options("collect", policy, into)]
    given = (policy, f"preferences={runs / 'collect'}", f"alignment.{SPLIT}")
    return ["align", *options("align", *ALIGN_LONG, *METHODS[name], *given, *more, into)]


@pytest.mark.slow
@pytest.mark.parametrize("name", CURVES)
def test_two_ranks_train_like_one_process_for_fifty_steps(
    options: Callable, runs: Path, tmp_path: Path, name: str
) -> None:
    status, output = run_ranks(2, *command(name, options, runs, tmp_path))
    assert status == 0, output
    assert_same(tmp_path / name, runs / name, CURVES[name])


@pytest.mark.slow
def test_two_ranks_roll_out_and_learn_like_one_process(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    arguments = options(
        "align", "method=rloo", "method.data.num_rollouts=4", "alignment.scenes_per_step=4", "alignment.lr=1e-4",
        f"policy={runs / 'pretrain/policy.pt'}",
    )  # fmt: skip
    status, output = run_ranks(2, "align", *arguments, f"output={tmp_path / 'two'}")
    assert status == 0, output
    assert run("align", *arguments, f"output={tmp_path / 'one'}").status == 0
    assert_same(tmp_path / "two", tmp_path / "one", ("train/rollout_distance", "train/loss_objective", "train/kl"))


# --- a kill ---------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("name", ["pretrain", "dpa_omf"])
def test_one_process_goes_on_where_two_ranks_were_killed(
    run: Callable, options: Callable, runs: Path, tmp_path: Path, name: str
) -> None:
    arguments = command(name, options, runs, tmp_path)
    with torchrun(2, *arguments) as process:
        wait_for((tmp_path / name / "checkpoints/step_0000000010.pt").exists, process)
        kill(workers_of(process))
        assert process.wait(timeout=60) != 0, "torchrun ends with its workers"
    assert not (tmp_path / name / "policy.pt").exists()
    outcome = run(*arguments)
    assert outcome.status == 0, outcome.err
    assert_same(tmp_path / name, runs / name, CURVES[name])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pretrain", "dpa_omf"])
def test_two_ranks_go_on_where_one_process_was_killed(
    options: Callable, kill_when: Callable, runs: Path, tmp_path: Path, name: str
) -> None:
    arguments = command(name, options, runs, tmp_path)
    kill_when((tmp_path / name / "checkpoints/step_0000000010.pt").exists, *arguments)
    assert not (tmp_path / name / "policy.pt").exists()
    status, output = run_ranks(2, *arguments)
    assert status == 0, output
    assert_same(tmp_path / name, runs / name, CURVES[name])


@pytest.mark.slow
def test_the_end_of_one_rank_is_the_end_of_all(options: Callable, runs: Path, tmp_path: Path) -> None:
    with torchrun(2, *command("pretrain", options, runs, tmp_path)) as process:
        wait_for((tmp_path / "pretrain/checkpoints/step_0000000002.pt").exists, process)
        first, *others = workers_of(process)
        kill(others)
        assert process.wait(timeout=60) != 0
        assert not Path(f"/proc/{first}").exists()
    assert not (tmp_path / "pretrain/policy.pt").exists()
    left = [path.name for path in (tmp_path / "pretrain").rglob("*") if path.name.startswith(PARTIAL_PREFIX)]
    assert not left


def wait_for(is_there: Callable[[], bool], process: subprocess.Popen) -> None:
    deadline = time.monotonic() + SECONDS
    while not is_there():
        assert process.poll() is None, f"ended too early:\n{process.stdout.read()}"
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.002)


if __name__ == "__main__":
    pytest.main([__file__])
