"""Scenes per second of pre-training, as a user runs it, and against another checkout of the project.

Each case is ``recipes.pretrain`` in processes of its own, checkouts in turn, on scenes that SUMO makes. The first visit
of a scene costs its preparation too, later ones less where it is kept, so both are told.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from dpa.models.precision import PRECISIONS
from dpa.training.loggers import read_curve
from dpa.training.run import SECONDS
from envs.progress import progress
from recipes.common.models import named_models

BATCH = 8
HERE = Path(__file__).parents[2]


@dataclass(frozen=True)
class Case:
    """One way to train.

    Attributes:
        checkout: folder of the code.
        model: name of its YAML.
        processes: that share a batch, started by torchrun.
        threads: of torch in each.
        precision: of linear layers; None leaves it to the checkout, which may not know the option.
    """

    checkout: Path
    model: str
    processes: int
    threads: int
    precision: str | None


def add_options(part: argparse.ArgumentParser) -> None:
    """Options of ``python -m recipes.benchmark training``."""
    part.add_argument(
        "--model", nargs="+", choices=named_models(), default=["nano", "paper"], help="the policy (default: both)"
    )
    part.add_argument(
        "--precision", nargs="+", choices=PRECISIONS, help="of linear layers, here (default: that of the recipe)"
    )
    part.add_argument("--against", metavar="DIR", help="another checkout of the project, measured in turn")
    part.add_argument("--agents", type=int, default=24, help="of a scene at most (default: %(default)s)")
    part.add_argument("--pieces", type=int, help="of the map (default: those of the policy's YAML)")
    part.add_argument(
        "--cores", type=int, default=2, help="threads of one process, or processes (default: %(default)s)"
    )
    part.add_argument("--scenes", type=int, default=96, help="a multiple of 12 (default: %(default)s)")
    part.add_argument("--epochs", type=int, default=5, help="over these scenes (default: %(default)s)")
    part.add_argument("--repeats", type=int, default=3, metavar="N", help="the median counts (default: %(default)s)")
    part.add_argument(
        "--folder", metavar="DIR", help="for scenes, kept for the next time (default: removed at the end)"
    )


def measure(options: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the part and print its table.

    Raises:
        ValueError: a number that cannot be, or a checkout without the recipe.
        OSError: a training ended with an error.
    """
    for name, least in (("agents", 1), ("pieces", 1), ("cores", 1), ("scenes", BATCH), ("epochs", 2), ("repeats", 1)):
        if options[name] is not None and options[name] < least:
            raise ValueError(f"--{name} must be {least} or more, got {options[name]}.")
    here = [(HERE, precision) for precision in options["precision"] or [None]]
    checkouts = [*here, *([(Path(options["against"]).absolute(), None)] if options["against"] else [])]
    for checkout, _ in checkouts:
        if not (checkout / "recipes/pretrain.py").is_file():
            raise ValueError(f"--against={checkout} holds no recipes/pretrain.py; name the folder of a checkout.")
    ways = {(1, options["cores"]), (options["cores"], 1)}
    cases = [
        Case(checkout, model, *way, precision)
        for model, way, (checkout, precision) in product(options["model"], sorted(ways), checkouts)
    ]
    with tempfile.TemporaryDirectory() as temporary:
        scenes = Path(options["folder"] or temporary, "scenes").absolute()
        speeds: list[list[dict[str, float]]] = [[] for _ in cases]
        for _, place in progress(list(product(range(options["repeats"]), range(len(cases)))), "training", unit="run"):
            with tempfile.TemporaryDirectory(dir=temporary) as output:
                speeds[place].append(run(cases[place], options, scenes, Path(output)))
    rows = [_row(case, each) for case, each in zip(cases, speeds, strict=True)]
    _print(rows)
    return rows


def run(case: Case, options: dict[str, Any], scenes: Path, output: Path) -> dict[str, float]:
    """Scenes per second of the first and of later visits in one training."""
    epoch = options["scenes"] // BATCH
    made = f"max_agents={options['agents']},windows=1,scenes_per_unit=1"
    arguments = [
        f"model={case.model}",
        f"pretraining.max_agents={options['agents']}",
        f"pretraining.batch_size={BATCH}",
        f"pretraining.steps={epoch * options['epochs']}",
        f"pretraining.tune_interval={epoch * options['epochs']}",
        f"pretraining.checkpoint_interval={epoch}",
        "pretraining.warmup=1",
        f'scenes.train="num_scenes={options["scenes"]},max_agents={options["agents"]},windows=1"',
        f'scenes.tune="num_scenes=1,split=tune,{made}"',
        f'scenes.eval="num_scenes=1,split=test,{made}"',
        f"scenes.cache={scenes}",
        f"threads={case.threads}",
        f"output={output}",
        *([] if options["pieces"] is None else [f"model.context.max_pieces={options['pieces']}"]),
        *([] if case.precision is None else [f"pretraining.precision={case.precision}"]),
    ]
    several = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={case.processes}"]
    command = [sys.executable, *(several if case.processes > 1 else []), "-m", "recipes.pretrain", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": str(case.threads), "PYTHONPATH": str(case.checkout)}
    done = subprocess.run(command, cwd=case.checkout, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"{case} ended with status {done.returncode}: {done.stderr.strip()[-400:]}")
    spent = [step * mean for step, mean in read_curve(output, SECONDS)]
    later = len(spent) // 2
    return {
        "first": BATCH * epoch / spent[0],
        "later": BATCH * epoch * (len(spent) - later) / (spent[-1] - spent[later - 1]),
    }


def _row(case: Case, runs: list[dict[str, float]]) -> dict[str, Any]:
    speeds = {visit: statistics.median(each[visit] for each in runs) for visit in ("first", "later")}
    return asdict(case) | {"checkout": str(case.checkout), "scenes_per_second": speeds}


def _print(rows: list[dict[str, Any]]) -> None:
    table = Table(
        "model", "processes x threads", "checkout", "precision", "first visit", "later", title="pre-training, scenes/s"
    )
    for row in rows:
        speeds = row["scenes_per_second"]
        way, where = f"{row['processes']} x {row['threads']}", Path(row["checkout"]).name
        table.add_row(
            row["model"], way, where, row["precision"] or "", f"{speeds['first']:.1f}", f"{speeds['later']:.1f}"
        )
    Console(markup=False, width=110).print(table)
