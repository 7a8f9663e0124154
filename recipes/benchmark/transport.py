"""Transport problems per second by method, against a loop over POT; and the time of a whole ranking.

A problem is one agent of one rollout: two clouds of feature vectors. Timed is all that lies between features and
distances: cost matrices, solutions and, with our methods, what each feature pays. The loop that everything is measured
against builds the same cost matrix with ``ot.dist`` and calls ``ot.emd2``, one problem after the other. Seconds are
those of the clock; CPU seconds tell what other work on the machine hides. Torch has one thread, and in the whole
ranking as many as the transport.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import ot
import torch
from rich.console import Console
from rich.table import Table
from scipy.stats import spearmanr
from torch import Tensor

from dpa.ranking import PreferenceDistance, log_trajectory, occupancy_features, transport_cost
from dpa.ranking.features import feature_names, feature_weights
from envs.progress import progress
from envs.scene import STEP_SECONDS
from recipes.benchmark.realism import crowded_scene, noisy_log

AGENTS = 16
"""Of the scene that the problems come from; its rollouts are as many as the problems ask for."""
SEGMENTS = 5000
"""Of its road edges."""
RANKED_AGENTS, RANKED_ROLLOUTS = 64, 64
"""Of the whole ranking."""
COARSE = 5
"""Stride of the features at 2 Hz."""


class Clouds(NamedTuple):
    """Problems of one scene.

    Attributes:
        x: ``[R, A, T, D]`` features of the rollouts.
        y: ``[1, A, T, D]`` of the log.
        valid: ``[A, T]`` bool, on both sides.
        weights: ``[D]``.
    """

    x: Tensor
    y: Tensor
    valid: Tensor
    weights: Tensor

    def to(self, device: str) -> Clouds:
        """The same on another device."""
        return Clouds(*(value.to(device) for value in self))

    def every(self, stride: int) -> Clouds:
        """The last step of each group of ``stride``."""
        x, y, valid = self.x[:, :, stride - 1 :: stride], self.y[:, :, stride - 1 :: stride], self.valid
        return Clouds(x, y, valid[:, stride - 1 :: stride], self.weights)


def make_clouds(problems: int, steps: int) -> Clouds:
    """Features of a crowded scene and of rollouts that drift away from its log, each at a pace of its own.

    Args:
        problems: rounded up to whole rollouts of 16 agents.
        steps: of 0.1 s, 1 to 80.

    Examples:
        >>> make_clouds(problems=20, steps=40).x.shape
        torch.Size([2, 16, 40, 5])
    """
    scene, rollouts = crowded_scene(AGENTS, SEGMENTS), -(-problems // AGENTS)
    log = log_trajectory(scene, 80)
    pace = torch.linspace(0.5, 1.5, rollouts)[:, None, None, None]
    drifting = torch.cat((log + pace * (noisy_log(scene, rollouts) - log), log[None]))
    phi, valid = occupancy_features(scene, drifting[:, :, :steps])
    return Clouds(phi[:-1], phi[-1:], valid, feature_weights(feature_names("full")))


def pot_loop(clouds: Clouds) -> Tensor:
    """``[R, A]`` distances by ``ot.emd2``, problem by problem; all steps are valid."""
    scale = clouds.weights.double().sqrt()
    x, y = ((value.double() * scale).numpy() for value in (clouds.x, clouds.y[0]))
    mass = ot.unif(x.shape[2])

    def distance(one: np.ndarray, log: np.ndarray) -> float:
        return ot.emd2(mass, mass, ot.dist(one, log, metric="euclidean"))

    return torch.tensor([[distance(*pair) for pair in zip(rollout, y, strict=True)] for rollout in x])


def add_options(part: argparse.ArgumentParser) -> None:
    """Options of ``python -m recipes.benchmark transport``."""
    part.add_argument("--problems", type=int, default=1024, metavar="N", help="in all (default: %(default)s)")
    part.add_argument("--steps", type=int, default=80, metavar="T", help="of a problem (default: %(default)s)")
    part.add_argument("--threads", type=int, default=2, help="of the second exact case (default: %(default)s)")
    part.add_argument("--repeats", type=int, default=3, metavar="R", help="the median counts (default: %(default)s)")
    part.add_argument("--device", default="cpu", help="cpu or cuda: where sinkhorn runs (default: %(default)s)")
    part.add_argument("--compile", action="store_true", help="run sinkhorn through torch.compile")


def measure(options: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the part and print its table.

    Raises:
        ValueError: an option out of its range.
    """
    for name in ("problems", "threads", "repeats"):
        if options[name] < 1:
            raise ValueError(f"{name} must be 1 or more, got {options[name]}.")
    if not COARSE <= options["steps"] <= 80:
        raise ValueError(f"steps must be {COARSE} to 80, got {options['steps']}.")
    clouds = make_clouds(options["problems"], options["steps"])
    cases = progress(_cases(clouds, options), "transport", unit="case")
    with _torch_threads(1):
        rows = [_timed(name, work, options) for name, work in cases]
    loop, exact = rows[0], rows[1].pop("distance")
    problems = exact.numel()
    for row in rows:
        distance = row.pop("distance", exact)
        row["problems_per_second"] = problems / row["seconds"]
        row["times_the_loop"] = loop["seconds"] / row["seconds"]
        row["spearman"] = float(spearmanr(distance.sum(-1), exact.sum(-1)).statistic)
    with _torch_threads(options["threads"]):
        rows.append(_whole_ranking(options))
    _print(rows, problems, options)
    return rows


def _cases(clouds: Clouds, options: dict[str, Any]) -> list[tuple[str, Callable[[], Tensor]]]:
    """What is timed; each gives ``[R, A]`` distances."""
    there, coarse = clouds.to(options["device"]), clouds.every(COARSE)

    def ours(given: Clouds, step: float = STEP_SECONDS, **how: Any) -> Callable[[], Tensor]:
        x, y, valid, weights = given
        return lambda: transport_cost(x, y, valid, valid, weights, step=step, **how).distance.cpu()

    threads = options["threads"]
    return [
        ("loop over ot.emd2", lambda: pot_loop(clouds)),
        ("exact, 1 thread", ours(clouds)),
        *([(f"exact, {threads} threads", ours(clouds, threads=threads))] if threads > 1 else []),
        ("exact at 2 Hz", ours(coarse, step=COARSE * STEP_SECONDS)),
        ("windowed, 2 s", ours(clouds, method="windowed", window=2.0)),
        (f"sinkhorn, {options['device']}", ours(there, method="sinkhorn", compile=options["compile"])),
        ("time_aligned", ours(clouds, method="time_aligned")),
    ]


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    """Torch's own threads; those of ``transport_cost`` come on top."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _timed(name: str, work: Callable[[], Tensor], options: dict[str, Any]) -> dict[str, Any]:
    seconds, cpu_seconds = [], []
    for _ in range(options["repeats"] + 1):  # the first one warms up
        start, cpu_start = time.perf_counter(), time.process_time()
        distance = work()
        seconds.append(time.perf_counter() - start)
        cpu_seconds.append(time.process_time() - cpu_start)
    middle, cpu = (statistics.median(values[1:]) for values in (seconds, cpu_seconds))
    return {"how": name, "seconds": middle, "slowest": max(seconds[1:]), "cpu_seconds": cpu, "distance": distance}


def _whole_ranking(options: dict[str, Any]) -> dict[str, Any]:
    """Features and transport of a large scene, as a collector does it."""
    scene = crowded_scene(RANKED_AGENTS, SEGMENTS)
    rollouts, rank = noisy_log(scene, RANKED_ROLLOUTS), PreferenceDistance(threads=options["threads"])
    row = _timed("whole ranking", lambda: rank(scene, rollouts).distance, options)
    phi, valid = occupancy_features(scene, torch.cat((rollouts, log_trajectory(scene, 80)[None])))
    x, y, weights = phi[:-1], phi[-1:], feature_weights(feature_names("full"))
    moved = _timed(
        "", lambda: transport_cost(x, y, valid, valid, weights, threads=options["threads"]).distance, options
    )
    del row["distance"]
    return row | {
        "agents": RANKED_AGENTS,
        "rollouts": RANKED_ROLLOUTS,
        "transport_seconds": moved["seconds"],
        "transport_cpu_seconds": moved["cpu_seconds"],
    }


def _print(rows: list[dict[str, Any]], problems: int, options: dict[str, Any]) -> None:
    *cases, ranking = rows
    title = f"{problems:,} problems of {options['steps']} x {options['steps']} steps, cost matrices included"
    table = Table("", title=title, title_justify="left")
    for column in ("s", "CPU s", "problems/s", "times the loop", "Spearman with exact"):
        table.add_column(column, justify="right")
    for row in cases:
        figures = f"{row['problems_per_second']:,.0f}", f"{row['times_the_loop']:.2f}", f"{row['spearman']:.4f}"
        table.add_row(row["how"], f"{row['seconds']:.3f}", f"{row['cpu_seconds']:.3f}", *figures)
    console = Console(markup=False, width=110)
    console.print(table)
    console.print(
        f"whole ranking of {ranking['rollouts']} rollouts x {ranking['agents']} agents x 80 steps, "
        f"threads {options['threads']}: {ranking['seconds']:.2f} s ({ranking['cpu_seconds']:.2f} CPU s), "
        f"of which transport {ranking['transport_seconds']:.2f} s ({ranking['transport_cpu_seconds']:.2f} CPU s)"
    )
