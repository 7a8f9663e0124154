"""Hours, storage and memory of the whole method on a data set, from rates that were measured on the machine at hand.

    python -m recipes.benchmark rollout --json rollout.json
    python -m recipes.plan rollout.json
    python -m recipes.plan rollout.json --workers 8 --scenes 487000 --agents 50 --rollouts 64

Every part is linear in what its line names, so hours are products of the options and a measured rate; workers are as
many of what was measured (processes, GPUs, machines).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from envs.files import check_file, write_json

STEPS = 80
"""Of an episode, of 0.1 s."""
SCORED_ROLLOUTS = 32
"""Of each scene in an evaluation (the WOSAC standard)."""

ALIGNED = 4 / 3
"""An aligned rollout over a trained log: loss and gradients are about three passes, the reference's likelihood one."""


class Part(NamedTuple):
    """One stage of the method.

    Attributes:
        name: of the stage.
        hours: with all workers.
        gigabytes: that it leaves on disk.
        memory: of a worker beyond the program itself [GiB], as measured; a budget bounds it, whatever the data set.
        grows_with: what hours are proportional to.
    """

    name: str
    hours: float
    gigabytes: float
    memory: float
    grows_with: str


def make_parser() -> argparse.ArgumentParser:
    """The command line; defaults are the paper's job on the Waymo Open Motion Dataset."""
    parser = argparse.ArgumentParser(
        prog="python -m recipes.plan",
        description=__doc__.split("\n")[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("rollout", type=Path, help="JSON of `python -m recipes.benchmark rollout`")
    parser.add_argument("--workers", type=int, default=1, help="as many of what was measured")
    parser.add_argument("--scenes", type=int, default=487_000, help="to train on and to roll out")
    parser.add_argument("--eval-scenes", type=int, default=44_097, help="to evaluate on")
    parser.add_argument("--agents", type=float, default=50, help="of a scene, in the mean")
    parser.add_argument("--rollouts", type=int, default=64, help="of each scene")
    parser.add_argument("--pretraining-steps", type=int, default=1_200_000, help="updates")
    parser.add_argument("--pretraining-batch", type=int, default=256, help="scenes of an update")
    parser.add_argument("--alignment-steps", type=int, default=200_000, help="updates")
    parser.add_argument("--alignment-pairs", type=int, default=32, help="pairs of an update, all its scenes together")
    parser.add_argument("--scene-kb", type=float, default=98.4, help="of a stored scene")
    parser.add_argument("--track-bytes", type=float, default=3.2, help="of an agent's stored and ranked rollout")
    parser.add_argument("--convert-rate", type=float, default=1_718, help="scenes a minute and worker")
    parser.add_argument("--metric-seconds", type=float, default=0.2, help="of the realism metric, a scene")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write the plan here too")
    return parser


def check_positive(options: argparse.Namespace) -> None:
    """Refuse numbers of which no plan can be made.

    Raises:
        ValueError: the first one that is not positive, by the name of its option.
    """
    for name, value in vars(options).items():
        if isinstance(value, int | float) and not value > 0:
            raise ValueError(f"--{name.replace('_', '-')} must be positive, got {value}.")


def make_plan(rates: dict[str, float], memory: dict[str, float], options: argparse.Namespace) -> list[Part]:
    """The parts of the method.

    Args:
        rates: agent-steps per second of ``ranked`` and ``collector`` rollouts and of what is ``trained`` on.
        memory: of the same [GiB].
        options: of :func:`make_parser`.

    Examples:
        >>> options = make_parser().parse_args(["out.json", "--scenes", "3600", "--agents", "10", "--rollouts", "1"])
        >>> rates = {"ranked": 800.0, "collector": 1e9, "trained": 1e9}
        >>> make_plan(rates, dict.fromkeys(rates, 1.0), options)[2].hours
        1.0
    """

    def hours(rollouts: float, rate: str) -> float:
        return rollouts * options.agents * STEPS / rates[rate] / options.workers / 3600

    evaluated = hours(options.eval_scenes * SCORED_ROLLOUTS, "collector") * options.workers  # by one process
    evaluated += options.eval_scenes * options.metric_seconds / 3600
    trained = options.pretraining_steps * options.pretraining_batch
    converted = (options.scenes + options.eval_scenes) / options.convert_rate / 60 / options.workers
    return [
        Part("convert", converted, (options.scenes + options.eval_scenes) * options.scene_kb / 1e6, 0.5, "scenes"),
        Part("pre-train", hours(trained, "trained"), 0.01, memory["trained"], "updates x scenes of an update x agents"),
        Part(
            "collect and rank",
            hours(options.scenes * options.rollouts, "ranked"),
            options.scenes * options.rollouts * options.agents * options.track_bytes / 1e9,
            memory["ranked"],
            "scenes x rollouts x agents",
        ),
        Part(
            "align",
            hours(2 * ALIGNED * options.alignment_steps * options.alignment_pairs, "trained"),
            0.01,
            memory["trained"],
            "updates x pairs x agents, the reference's likelihoods too",
        ),
        Part("evaluate, one process", evaluated, 0.1, memory["collector"], "scenes x agents"),
    ]


def read_rates(path: Path) -> tuple[dict[str, float], dict[str, float], dict[str, Any]]:
    """Agent-steps per second and memory [GiB] by how they were made, and the options of the measurement.

    Raises:
        ValueError: no JSON of the benchmark.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        rows = [row for row in content["rows"] if "how" in row]
        rows = rows[::-1]  # the first ones count
        rates = {row["how"]: float(row["agent_steps_per_second"]) for row in rows}
        memory = {row["how"]: float(row["gib"]) for row in rows}
        missing, measured = {"ranked", "collector", "trained"} - rates.keys(), content["options"]
    except FileNotFoundError as error:
        raise ValueError(
            f"{path} does not exist; `python -m recipes.benchmark rollout --json rollout.json` writes one."
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is no JSON of `python -m recipes.benchmark rollout` ({error!r}).") from error
    if missing:
        raise ValueError(f"{path} lacks {sorted(missing)}; measure again with `python -m recipes.benchmark rollout`.")
    return rates, memory, measured


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    options = make_parser().parse_args(arguments)
    try:
        check_positive(options)
        check_file(options.json, "--json ")
        rates, memory, measured = read_rates(options.rollout)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    parts = make_plan(rates, memory, options)
    where = f"{measured['model']} model, {measured['device']}, {measured['threads']} threads"
    table = Table(
        "",
        "hours",
        "GB on disk",
        "GiB a worker",
        "grows with",
        title=f"{options.workers} x ({where})",
        title_justify="left",
    )
    for part in parts:
        table.add_row(part.name, f"{part.hours:,.1f}", f"{part.gigabytes:,.1f}", f"{part.memory:.2f}", part.grows_with)
    table.add_row("all", f"{sum(p.hours for p in parts):,.1f}", f"{sum(p.gigabytes for p in parts):,.1f}", "", "")
    Console(markup=False, width=110).print(table)
    if options.json is not None:
        write_json(options.json, {"rates": rates, "parts": [part._asdict() for part in parts]})
    return 0


if __name__ == "__main__":
    sys.exit(main())
