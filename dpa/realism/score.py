"""``python -m dpa.realism.score SCENARIO ROLLOUTS``: score rollouts of anybody's, from files.

SCENARIO is a TFRecord or a serialized Scenario of WOMD, a store of ``envs.convert``, an .npz of arrays, or a folder of
such files; ROLLOUTS an .npz, a folder of them, or a submission of the challenge. What is printed and written has the
names of the official outputs.
"""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import bootstrap

from dpa.realism.config import RealismConfig
from dpa.realism.files import Scenarios, read_rollouts
from dpa.realism.metric import RealismResult, mean_result, realism
from envs.files import check_file, write_json
from envs.progress import progress

STANDARD_ROLLOUTS = 32
BAD_INPUT_STATUS = 2
RESAMPLES = 9_999
DRAWN = 10_000_000
"""Scenarios that are drawn at a time, over all resamples: 160 MB."""


def score(
    scenario: str | Path,
    rollouts: str | Path,
    config: str | Path = "2024",
    *,
    scene_id: str | None = None,
    quirks: bool = True,
) -> dict[str, RealismResult]:
    """Score rollouts from files.

    Args:
        scenario: file, folder or store of scenarios; see :mod:`dpa.realism.files`.
        rollouts: file, folder or submission.
        config: year or path of a YAML.
        scene_id: only this scenario.
        quirks: see :func:`dpa.realism.realism`.

    Returns:
        The result of each scenario, by id.

    Raises:
        ValueError: something cannot be read, does not fit, or a scenario comes twice.
    """
    settings, results = RealismConfig.load(config), {}
    for scene, poses, name in progress(read_rollouts(rollouts, Scenarios(scenario), scene_id), "score", unit="scene"):
        if scene.scene_id in results:
            raise ValueError(f"{name}: rollouts of scenario {scene.scene_id} come twice; remove one.")
        if len(poses) != STANDARD_ROLLOUTS:
            warnings.warn(f"{name}: {len(poses)} rollouts; the standard is {STANDARD_ROLLOUTS}.", stacklevel=2)
        results[scene.scene_id] = realism(scene, poses, settings, quirks=quirks)
    if not results:
        raise ValueError(f"{rollouts} has no rollouts" + (f" of scenario {scene_id!r}." if scene_id else "."))
    return results


def report(results: dict[str, RealismResult]) -> dict[str, Any]:
    """Figures under their official names: of all scenarios, with intervals, and of each."""
    each = {name: result.official() for name, result in results.items()}
    content = mean_result(list(results.values())).official()
    columns = {key: [figures["metrics"][key] for figures in each.values()] for key in content["metrics"]}
    return content | {"interval_95": {key: interval(values) for key, values in columns.items()}, "scenarios": each}


def interval(values: Sequence[float]) -> list[float] | None:
    """95 % interval of a mean over scenarios, by bootstrap; none for a single scenario or an unknown value.

    Examples:
        >>> interval([1.0, 1.0, 1.0]), interval([1.0])
        ([1.0, 1.0], None)
    """
    if len(values) < 2 or not all(map(math.isfinite, values)):
        return None
    if len(set(values)) == 1:
        return [values[0], values[0]]
    draws = bootstrap(
        (np.asarray(values),),
        np.mean,
        n_resamples=RESAMPLES,
        batch=max(1, DRAWN // len(values)),
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return [float(bound) for bound in draws.confidence_interval]


def _print(content: dict[str, Any]) -> None:
    table = Table(title=f"{len(content['scenarios'])} scenarios", title_justify="left")
    table.add_column("figure")
    table.add_column("mean", justify="right")
    table.add_column("95 %", justify="right")
    for name, value in (content["buckets"] | content["metrics"]).items():
        bounds = content["interval_95"].get(name)
        table.add_row(name, f"{value:.6f}", "" if bounds is None else f"[{bounds[0]:.4f}, {bounds[1]:.4f}]")
    Console(markup=False, width=110).print(table)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m dpa.realism.score",
        description="Score rollouts by the realism metric of the Waymo Open Sim Agents Challenge.",
        epilog="A mean over scenarios comes with a 95 % bootstrap interval. Exit status 2: an input cannot be used.",
    )
    parser.add_argument("scenario", metavar="SCENARIO", help="TFRecord, serialized Scenario, .npz, folder, or store")
    parser.add_argument(
        "rollouts", metavar="ROLLOUTS", help=".npz (x, y, z, heading, object_id), folder, or submission"
    )
    parser.add_argument("--config", default="2024", help="2023, 2024, 2025 or a .yaml (default: %(default)s)")
    parser.add_argument("--scenario-id", help="score this one only; needed for an .npz if SCENARIO holds several")
    parser.add_argument("--no-quirks", action="store_true", help="leave out the accidents of the official code")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all figures here too")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    options = _parser().parse_args(arguments)
    try:
        check_file(options.json, "--json ")
        results = score(
            options.scenario,
            options.rollouts,
            options.config,
            scene_id=options.scenario_id,
            quirks=not options.no_quirks,
        )
    except (ValueError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return BAD_INPUT_STATUS
    content = {"config": options.config, "quirks": not options.no_quirks} | report(results)
    _print(content)
    if options.json is not None:
        # a figure that is not defined is NaN here as in the official outputs; JSON has null for it
        write_json(options.json, _without_nan(content))
    return 0


def _without_nan(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _without_nan(value) for key, value in content.items()}
    return None if isinstance(content, float) and math.isnan(content) else content


if __name__ == "__main__":
    sys.exit(main())
