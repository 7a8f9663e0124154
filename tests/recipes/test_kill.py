"""kill -9 in the middle of a stage: the same command again ends as if nothing had happened."""

from __future__ import annotations

import json
import multiprocessing
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dpa.preferences import PreferenceStore, verify
from dpa.training.checkpoint import load_policy
from dpa.training.loggers import read_curve
from recipes.collect import main as collect_main

pytestmark = pytest.mark.slow

LONG = {
    "pretrain": ["pretraining.steps=60", "pretraining.checkpoint_interval=5"],
    "collect": ["collection.num_rollouts=24", "collection.memory=1e-4", "collection.ranking.stride=1"],
    "align": ["alignment.steps=60", "alignment.checkpoint_interval=5", "method.data.num=2"],
    "evaluate": ["evaluation.num_rollouts=24", "evaluation.memory=1e-4", "split=train"],
}
"""Options that give a kill something to interrupt; stages in the order in which they need each other."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """A folder with every stage, not interrupted: ``pretrain``, ``collect``, ``align``, ``evaluate.json``."""
    folder = tmp_path_factory.mktemp("kill")
    for stage in LONG:
        outcome = run(stage, *command(stage, options, folder, folder))
        assert outcome.status == 0, outcome.err
    return folder


def command(stage: str, options: Callable, runs: Path, output: Path) -> list[str]:
    """Of one stage on the results of ``runs``, into ``output``."""
    given = [] if stage == "pretrain" else [f"policy={runs / 'pretrain/policy.pt'}"]
    given += [f"preferences={runs / 'collect'}"] if stage == "align" else []
    into = f"json={output / 'evaluate.json'}" if stage == "evaluate" else f"output={output / stage}"
    return options(stage, *LONG[stage], *given, into)


def assert_same_policy(mine: Path, whole: Path) -> None:
    for name, value in load_policy(whole / "policy.pt")[0].items():
        assert torch.equal(load_policy(mine / "policy.pt")[0][name], value), name


@pytest.mark.parametrize(
    ("stage", "curve"), [("pretrain", "train/loss_next_token"), ("align", "train/loss_preference")]
)
@pytest.mark.parametrize("checkpoint", [5, 30])
def test_killed_training(
    run: Callable, options: Callable, kill_when: Callable, runs: Path, tmp_path: Path, stage: str, curve: str,
    checkpoint: int,
) -> None:  # fmt: skip
    arguments = command(stage, options, runs, tmp_path)
    kill_when((tmp_path / stage / f"checkpoints/step_{checkpoint:010d}.pt").exists, stage, *arguments)
    assert not (tmp_path / stage / "policy.pt").exists()
    assert run(stage, *arguments).status == 0
    assert_same_policy(tmp_path / stage, runs / stage)
    assert read_curve(tmp_path / stage, curve) == read_curve(runs / stage, curve)


@pytest.mark.parametrize("method", ["dpa_adef", "sft_best_oa", "adversarial_afd", "kto", "listwise"])
def test_killed_alignment_of_other_kinds(
    options: Callable, align_with_a_kill: Callable, runs: Path, tmp_path: Path, method: str
) -> None:
    """What a step draws from a store differs by kind: pairs, the nearest, logs, sets, a ranking."""
    given = [f"policy={runs / 'pretrain/policy.pt'}", f"preferences={runs / 'collect'}", f"method={method}"]
    given += ["alignment.steps=60", "alignment.checkpoint_interval=5", "alignment.pairs_per_scene=2"]
    align_with_a_kill(lambda output: options("align", *given, f"output={output}"), tmp_path, checkpoint=5)


def contents(folder: Path) -> dict[int, dict[str, torch.Tensor]]:
    store = PreferenceStore(folder)
    return {int(scene): dict(store[row].items()) for row, scene in enumerate(store.scenes)}


def assert_same_preferences(mine: Path, whole: Path) -> None:
    ours, theirs = contents(mine), contents(whole)
    assert ours.keys() == theirs.keys()
    for scene, group in ours.items():
        for key, value in group.items():
            assert torch.equal(value, theirs[scene][key]), (scene, key)
    assert verify(mine) == []
    assert not list(mine.glob(".partial-*"))


def collect_here(arguments: list[str]) -> None:
    """The command line in a process that has imported it already."""
    sys.argv = ["collect", *arguments]
    collect_main()


@pytest.mark.timeout(1800)  # a hundred processes, on machines that share their cores
def test_a_collection_killed_at_fifty_random_moments(run: Callable, options: Callable, tmp_path: Path) -> None:
    """Started again after each kill; a store that is full before there were enough kills is begun anew."""

    def collecting(folder: Path, seconds: float | None = None) -> bool:
        """Collect into a folder, killed after some time; whether that came before the end."""
        given = (f"policy={tmp_path / 'pretrain/policy.pt'}", f"output={folder}", "collection.chunk_scenes=1")
        process = processes.Process(target=collect_here, args=(options("collect", *given),), daemon=True)
        process.start()
        process.join(seconds)
        process.kill()
        process.join()
        return process.exitcode == -signal.SIGKILL

    assert run("pretrain", *options("pretrain", f"output={tmp_path / 'pretrain'}")).status == 0
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["recipes.collect"])
    collecting(tmp_path / "warm")
    start = time.monotonic()
    assert not collecting(tmp_path / "whole")
    usual = time.monotonic() - start
    draw, kills, folder, found = random.Random(0), 0, tmp_path / "0", set()
    while kills < 50:
        kills += collecting(folder, draw.uniform(0, 1.2 * usual))
        if not (folder / "metadata.json").exists():
            continue
        assert verify(folder) == []
        store = PreferenceStore(folder)
        found.add(len(store))
        if len(store) == 6:
            assert not collecting(folder), "the same command once more, to its end"
            assert_same_preferences(folder, tmp_path / "whole")
            folder = tmp_path / str(kills)
    assert len(found) > 2, "kills came at different moments"
    assert not collecting(folder)
    assert_same_preferences(folder, tmp_path / "whole")


def test_killed_evaluation(run: Callable, options: Callable, kill_when: Callable, runs: Path, tmp_path: Path) -> None:
    arguments, partial = command("evaluate", options, runs, tmp_path), tmp_path / ".evaluate.json.scored"
    kill_when(lambda: partial.exists() and partial.read_text().count("\n") > 2, "evaluate", *arguments)
    scored = partial.read_text().count("\n") - 1
    outcome = run("evaluate", *arguments)
    assert outcome.status == 0
    assert f"{scored}/6" in outcome.err, "the bar starts from what was scored"
    mine, whole = (json.loads((folder / "evaluate.json").read_text()) for folder in (tmp_path, runs))
    assert mine == whole
    assert not partial.exists()


if __name__ == "__main__":
    pytest.main([__file__, "-m", "slow"])
