"""How safe the logs of a store of scenes are by these measures: what rollouts should be compared with.

python -m dpa.safety data/test

By class, how many of the agents that are there at the current step leave the road within 8 s: pedestrians on
pavements do, and the metric's off-road rate counts them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import torch
from rich.console import Console
from torch import Tensor

from dpa.safety.measure import MEASURES, safety
from dpa.safety.motion import NOW
from dpa.safety.off_road import off_road
from envs.progress import progress
from envs.scene import EDGE_KINDS, AgentKind, Scene, polylines
from envs.store import SceneStore


def make_parser() -> argparse.ArgumentParser:
    """Options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m dpa.safety", description=__doc__)
    parser.add_argument("store", help="folder of a scene store (python -m envs.convert makes one)")
    parser.add_argument("--limit", type=int, metavar="N", help="measure the first N scenes only")
    return parser


def leaves_road(scene: Scene) -> Tensor:
    """``[A]`` bool: an agent of an uncollated scene is off the road at some step of its log after the current one."""
    agents = scene.agents
    poses, there = agents.trajectory[:, NOW + 1 :], agents.valid[:, NOW + 1 :]
    return off_road(polylines(scene, EDGE_KINDS), poses, agents.extent, there).any(-1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m dpa.safety``: all present agents of each log, means over scenes."""
    options = make_parser().parse_args(arguments)
    try:
        if options.limit is not None and options.limit < 1:
            raise ValueError(f"--limit must be 1 or more, got {options.limit}.")
        measure(SceneStore(options.store), options.limit)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")


def measure(scenes: SceneStore, limit: int | None) -> None:
    """Print the measures of the first scenes of a store, or of all."""
    values: dict[str, list[float]] = {name: [] for name in MEASURES}
    counts, off = torch.zeros(len(AgentKind), dtype=torch.int64), torch.zeros(len(AgentKind), dtype=torch.int64)
    for index in progress(range(min(len(scenes), limit or len(scenes))), "measure", unit="scene"):
        scene = scenes[index]
        agents, present = scene.agents, scene.agents.present
        log = agents.trajectory[None, present, NOW + 1 :]
        for name, value in safety(scene, log, present[present]).items():
            if value is not None:
                values[name].append(value)
        counts += agents.kind[present].bincount(minlength=len(AgentKind))
        off += agents.kind[present & leaves_road(scene)].bincount(minlength=len(AgentKind))
    console = Console(markup=False, width=100)
    for name, known in values.items():
        mean = f"{sum(known) / len(known):.4f}" if known else "–"
        console.print(f"{name:20} {mean:>8}  of {len(known)} scenes", highlight=False)
    for kind in AgentKind:
        if count := int(counts[kind]):
            name = f"off-road, {kind.name.lower()}"
            console.print(f"{name:20} {int(off[kind]) / count:8.4f}  of {count} agents", highlight=False)


if __name__ == "__main__":
    main()
