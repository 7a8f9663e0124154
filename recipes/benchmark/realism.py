"""Seconds of the realism metric per scene; each case has a process, and so a peak of memory, of its own."""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import statistics
import time
from typing import Any, NamedTuple

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from dpa.realism import RealismConfig, realism_of
from dpa.realism.files import Scenarios
from envs.progress import progress
from envs.scene import CURRENT_STEP, LOG_STEPS, MapKind, Scene
from envs.sources.synthetic import build_scene

EVALUATED = 9
"""The SDC and eight tracks to predict: the most that WOMD has."""
KIB_PER_GIB = 1 << 20


class Case(NamedTuple):
    """What one measurement is of.

    Attributes:
        name: shown in the table.
        agents: of a scene made on the spot.
        segments: of its road edges.
        path: a file of scenarios to take instead.
        scene_id: of the scenario in it.
    """

    name: str
    agents: int = 0
    segments: int = 0
    path: str | None = None
    scene_id: str | None = None


def crowded_scene(agents: int, segments: int, seed: int = 0) -> Scene:
    """Streets side by side, full of cars that follow each other.

    Args:
        agents: cars; the first is the SDC, the next eight are to be predicted.
        segments: of road edges, in all.
        seed: of speeds and places.

    Examples:
        >>> scene = crowded_scene(agents=40, segments=1000)
        >>> int(scene.agents.present.sum()), int(scene.agents.evaluated.sum()), int((scene.road.count - 1).sum())
        (40, 9, 1000)
    """
    generator = torch.Generator().manual_seed(seed)
    streets = max(1, agents // 8)
    street = torch.arange(agents) % streets
    speed = 5 + 8 * torch.rand(agents, generator=generator)
    start = -60 + 15.0 * (torch.arange(agents) // streets) + 3 * torch.rand(agents, generator=generator)
    poses = torch.zeros(agents, LOG_STEPS, 3)
    poses[..., 0] = start[:, None] + speed[:, None] * 0.1 * torch.arange(LOG_STEPS)
    poses[..., 1] = 10.0 * street[:, None] - 2.5
    edges = []
    for index in range(2 * streets):
        count = segments // (2 * streets) + (index < segments % (2 * streets))
        x, y = torch.linspace(-100, 200, count + 1), 10.0 * (index // 2) + (5.0 if index % 2 else -5.0)
        line = torch.stack((x, torch.full_like(x, y)), -1)
        edges.append((int(MapKind.EDGE_BOUNDARY), line.flip(0) if index % 2 else line))
    scene = build_scene(poses, edges)
    scene.agents.predict = torch.arange(agents) < EVALUATED
    return scene


def noisy_log(scene: Scene, num_rollouts: int, seed: int = 0) -> Tensor:
    """``[R, A, 80, 4]``: the log with a drift of some metres, as rollouts."""
    agents = scene.agents
    log = agents.trajectory[None, agents.present, CURRENT_STEP + 1 :]
    noise = torch.randn(num_rollouts, *log.shape[1:], generator=torch.Generator().manual_seed(seed))
    return log + noise.cumsum(2) * torch.tensor([0.05, 0.05, 0.0, 0.005])


def measure_realism(case: Case, options: dict[str, Any]) -> dict[str, Any]:
    """Seconds per scene and peak memory of the metric on scenes of one kind; runs in a process of its own."""
    torch.set_num_threads(options["threads"])
    count, config = options["together"], RealismConfig.load(options["config"])
    if case.path is None:
        scenes = [crowded_scene(case.agents, case.segments, seed) for seed in range(count)]
    else:
        scenes = [Scenarios(case.path).find(case.scene_id)] * count
    rollouts = [noisy_log(scene, options["num_rollouts"], seed) for seed, scene in enumerate(scenes)]
    scenes, rollouts = ([each.to(options["device"]) for each in part] for part in (scenes, rollouts))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = []
    for _ in range(options["repeats"] + 1):  # the first one warms up
        start = time.perf_counter()
        realism_of(scenes, rollouts, config, memory=options["memory"])
        seconds.append((time.perf_counter() - start) / count)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "case": case.name,
        "agents": int(scenes[0].agents.present.sum()),
        "evaluated": int((scenes[0].agents.evaluated & scenes[0].agents.present).sum()),
        "seconds": statistics.median(seconds[1:]),
        "slowest": max(seconds[1:]),
        "memory_gib": (peak - before) / KIB_PER_GIB,
        "process_gib": peak / KIB_PER_GIB,
    }


def realism_cases(scenarios: str | None) -> list[Case]:
    """The scenes to measure on.

    Raises:
        ValueError: the file cannot be read.
    """
    if scenarios is None:
        return [Case(f"{agents} agents, 5,000 edges", agents, 5000) for agents in (50, 84, 128)]
    return [Case(name, path=scenarios, scene_id=name) for name in Scenarios(scenarios).ids()]


def run(cases: list[Case], options: dict[str, Any]) -> list[dict[str, Any]]:
    """Measure each case in a fresh process, one after the other."""
    context = multiprocessing.get_context("spawn")
    rows = []
    for case in progress(cases, "benchmark", unit="case"):
        with context.Pool(1) as pool:
            rows.append(pool.apply(measure_realism, (case, options)))
    return rows


def _print(rows: list[dict[str, Any]], options: dict[str, Any]) -> None:
    table = Table(title=f"realism {options['config']}, {options['num_rollouts']} rollouts", title_justify="left")
    for title in ("scene", "agents", "evaluated", "s per scene", "slowest", "GiB more", "GiB in all"):
        table.add_column(title, justify="left" if title == "scene" else "right")
    for row in rows:
        numbers = [f"{row[key]:.3f}" for key in ("seconds", "slowest", "memory_gib", "process_gib")]
        table.add_row(row["case"], str(row["agents"]), str(row["evaluated"]), *numbers)
    Console(markup=False, width=110).print(table)


def add_options(part: argparse.ArgumentParser) -> None:
    """Options of ``python -m recipes.benchmark realism``."""
    part.add_argument("--scenarios", metavar="FILE", help="TFRecord, store or folder (default: crowded scenes)")
    part.add_argument("--config", default="2025", help="year of the metric (default: %(default)s)")
    part.add_argument("--num-rollouts", type=int, default=32, metavar="R", help="of a scene (default: %(default)s)")
    part.add_argument("--together", type=int, default=1, metavar="G", help="scenes of one call (default: %(default)s)")
    part.add_argument("--memory", type=float, default=1.0, metavar="GIB", help="budget of it (default: %(default)s)")
    part.add_argument("--repeats", type=int, default=5, metavar="N", help="the median counts (default: %(default)s)")
    part.add_argument("--threads", type=int, default=2, help="CPU threads (default: %(default)s)")
    part.add_argument("--device", default="cpu", help="cpu or cuda (default: %(default)s)")


def measure(options: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the part and print its table."""
    rows = run(realism_cases(options["scenarios"]), options)
    _print(rows, options)
    return rows
