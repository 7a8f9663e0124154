"""How safe the logs of a store of scenes are by these measures: what rollouts should be compared with.

python -m dpa.safety data/test
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from rich.console import Console

from dpa.safety.measure import MEASURES, safety
from dpa.safety.motion import NOW, logged
from envs.progress import progress
from envs.store import SceneStore


def make_parser() -> argparse.ArgumentParser:
    """Options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m dpa.safety", description=__doc__)
    parser.add_argument("store", help="folder of a scene store (python -m envs.convert makes one)")
    parser.add_argument("--limit", type=int, help="measure the first scenes only")
    return parser


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m dpa.safety``: all present agents of each log, means over scenes."""
    options = make_parser().parse_args(arguments)
    try:
        scenes = SceneStore(options.store)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    values: dict[str, list[float]] = {name: [] for name in MEASURES}
    for index in progress(range(min(len(scenes), options.limit or len(scenes))), "measure", unit="scene"):
        scene = scenes[index]
        log = logged(scene)[None, :, NOW + 1 :]
        for name, value in safety(scene, log, scene.agents.present[scene.agents.present]).items():
            if value is not None:
                values[name].append(value)
    for name, known in values.items():
        mean = f"{sum(known) / len(known):.4f}" if known else "–"
        Console(markup=False, width=100).print(f"{name:12} {mean:>8}  of {len(known)} scenes", highlight=False)


if __name__ == "__main__":
    main()
