"""Scenes on disk, tiny options, and recipes run as a user runs them."""

from __future__ import annotations

import io
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import pytest
import torch

from dpa.training.checkpoint import load_policy
from envs.sources.synthetic import straight_road

REPOSITORY = Path(__file__).resolve().parents[2]
TINY = [
    "threads=1",
    "model=nano",
    "scenes=store",
    "scenes.tune=2",
    "pretraining.steps=6",
    "pretraining.batch_size=2",
    "pretraining.warmup=1",
    "pretraining.tune_interval=3",
    "pretraining.checkpoint_interval=2",
    "collection.num_rollouts=4",
    "collection.chunk_scenes=2",
    "collection.memory=0.001",
    "collection.ranking.stride=5",
    "alignment.steps=4",
    "alignment.warmup=1",
    "alignment.scenes_per_step=2",
    "alignment.checkpoint_interval=2",
    "evaluation.num_rollouts=4",
    "evaluation.memory=0.001",
]
"""Options that make every stage take seconds; each recipe takes those of its own sections."""
SECTIONS = {
    "pretrain": ("threads", "scenes", "model", "pretraining"),
    "collect": ("threads", "scenes", "collection"),
    "align": ("threads", "scenes", "alignment"),
    "evaluate": ("threads", "scenes", "collection.ranking", "evaluation"),
    "play": ("threads", "scenes"),
    "rerank": ("threads", "scenes"),
    "spread": ("threads", "scenes"),
    "ladder": ("threads", "scenes", "model"),
    "encounters": ("threads", "scenes"),
    "gap": ("threads", "scenes"),
    "references": ("threads", "scenes", "collection.ranking", "evaluation"),
    "tokens": ("threads", "scenes", "model"),
    "vocabulary": ("threads", "scenes"),
    "look": ("threads", "scenes"),
    "validity": ("threads", "scenes"),
    "sensitivity": ("threads", "scenes"),
    "discriminator": ("threads", "scenes"),
    "compare": ("threads", "scenes", "model", "pretraining", "collection", "alignment", "evaluation"),
}


class Outcome(NamedTuple):
    """What a recipe printed, and its exit status."""

    status: int
    out: str
    err: str


@pytest.fixture(scope="session")
def stores(tmp_path_factory: pytest.TempPathFactory, write_store: Callable) -> Path:
    """A folder with the stores ``train``, ``eval`` and ``other``: roads with a few cars that change speed."""
    folder = tmp_path_factory.mktemp("scenes")
    for name, first, count in (("train", 0, 8), ("eval", 100, 3), ("other", 200, 8)):
        write_store(folder / name, [straight_road(1 + i % 3, seed=first + i) for i in range(count)])
    return folder


@pytest.fixture(scope="session")
def options(stores: Path) -> Callable[..., list[str]]:
    """Tiny options of a recipe, and what is given on top."""

    def options_of(recipe: str, *more: str) -> list[str]:
        tiny = [option for option in TINY if option.split("=")[0].startswith(SECTIONS[recipe])]
        return [*tiny, f"scenes.train={stores / 'train'}", f"scenes.eval={stores / 'eval'}", *more]

    return options_of


def run_here(recipe: str, *arguments: str) -> Outcome:
    """Run a recipe in this process, as its command line would."""
    main = import_module(f"recipes.{recipe}").main
    root, threads = logging.getLogger(), torch.get_num_threads()
    handlers, level = root.handlers[:], root.level
    out, err = io.StringIO(), io.StringIO()
    status = 0
    try:
        with mock.patch.object(sys, "argv", [recipe, *arguments]), redirect_stdout(out), redirect_stderr(err):
            main()
    except SystemExit as stop:
        status = stop.code or 0
    finally:
        root.handlers[:], root.level = handlers, level
        torch.set_num_threads(threads)
    return Outcome(status, out.getvalue(), err.getvalue())


@pytest.fixture(scope="session")
def run() -> Callable[..., Outcome]:
    """:func:`run_here`."""
    return run_here


@pytest.fixture(scope="session")
def origin(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """A trained policy."""
    folder = tmp_path_factory.mktemp("origin")
    assert run("pretrain", *options("pretrain", f"output={folder}", "pretraining.lr=1e-2")).status == 0
    return folder / "policy.pt"


@pytest.fixture(scope="session")
def kill_when() -> Callable[..., None]:
    """Starts a recipe in a process of its own and kills it as soon as something is there."""

    def start_and_kill(is_there: Callable[[], bool], recipe: str, *arguments: str) -> None:
        command = [sys.executable, "-m", f"recipes.{recipe}", *arguments]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(command, cwd=REPOSITORY, env=environment, stderr=subprocess.PIPE, text=True)
        try:
            deadline = time.monotonic() + 240
            while not is_there():
                assert process.poll() is None, f"ended before it could be killed:\n{process.stderr.read()}"
                assert time.monotonic() < deadline, "nothing happened"
                time.sleep(0.002)
        finally:
            process.kill()
            process.communicate()
        assert process.returncode == -signal.SIGKILL, "it had finished already; give it more to do"

    return start_and_kill


@pytest.fixture(scope="session")
def align_with_a_kill(run: Callable, kill_when: Callable) -> Callable[..., None]:
    """Aligns to the end, and again with a kill in between: both must end with the same weights."""

    def align_twice(arguments: Callable[[Path], list[str]], folder: Path, checkpoint: int) -> None:
        whole, killed = folder / "whole", folder / "killed"
        assert run("align", *arguments(whole)).status == 0
        kill_when((killed / f"checkpoints/step_{checkpoint:010d}.pt").exists, "align", *arguments(killed))
        assert not (killed / "policy.pt").exists()
        assert run("align", *arguments(killed)).status == 0
        mine, other = (load_policy(each / "policy.pt")[0] for each in (killed, whole))
        for name, value in other.items():
            assert torch.equal(mine[name], value), name

    return align_twice


@pytest.fixture(autouse=True)
def _nothing_beside_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Recipes run in an empty folder and leave nothing there: they write into their output folder only."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    yield
    assert not list(here.iterdir())
