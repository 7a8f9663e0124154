"""Raw files against a store: size of a scene, scenes per minute of a conversion, and a batch of random scenes.

WOMD files are multiplied first (each copy with an id of its own), so that a few scenes are enough to measure with.
"""

from __future__ import annotations

import argparse
import random
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from envs.convert import convert
from envs.progress import progress
from envs.scene import Scene, collate
from envs.sources import SOURCES
from envs.sources.scenario import Scenario
from envs.sources.tfrecord import frame
from envs.sources.womd import payloads
from envs.store import SceneStore

KIB_PER_GIB = 1 << 20


def add_options(part: argparse.ArgumentParser) -> None:
    """Options of ``python -m recipes.benchmark scenes``."""
    part.add_argument("source", choices=sorted(SOURCES), metavar="SOURCE", help=", ".join(sorted(SOURCES)))
    part.add_argument("paths", nargs="+", metavar="PATHS", help="as for `python -m envs.convert SOURCE PATHS`")
    part.add_argument(
        "--copies", type=int, default=1000, metavar="N", help="scenes of each of two WOMD files (default: %(default)s)"
    )
    part.add_argument("--workers", type=int, default=2, help="processes that convert (default: %(default)s)")
    part.add_argument("--batch", type=int, default=64, metavar="S", help="scenes of a batch (default: %(default)s)")
    part.add_argument("--repeats", type=int, default=5, metavar="N", help="the median counts (default: %(default)s)")
    part.add_argument("--folder", metavar="DIR", help="for what is written (default: removed at the end)")


def measure(options: dict[str, Any]) -> list[dict[str, Any]]:
    """Run the part and print its table."""
    with tempfile.TemporaryDirectory(dir=options["folder"]) as folder:
        source, paths = SOURCES[options["source"]], options["paths"]
        inputs = source.find(paths)
        if source.name == "womd":
            inputs = multiply(inputs, options["copies"], Path(folder))
        start = time.perf_counter()
        store = convert(source.name, inputs, Path(folder, "store"), workers=options["workers"], show_progress=True)
        seconds = time.perf_counter() - start
        rows = [*_sizes(inputs, source.size, store), *_conversion(store, seconds, options["workers"])]
        rows += _batches(store, inputs, source.records, options["batch"], options["repeats"])
    table = Table("", "figure", title=f"scenes of {source.name}, {len(store)} in all", title_justify="left")
    for row in rows:
        table.add_row(row["what"], f"{row['figure']:,.{row['digits']}f} {row['unit']}")
    Console(markup=False, width=110).print(table)
    return rows


def multiply(inputs: list[str], copies: int, folder: Path) -> list[str]:
    """Two TFRecord files of ``copies`` scenes each, in turn those of the inputs; returns their paths."""
    scenarios = [Scenario.FromString(read()) for path in inputs for read in payloads(path)]
    files = [folder / f"copies-{number}.tfrecord" for number in range(2)]
    for number, file in enumerate(progress(files, "multiply", unit="file")):
        with file.open("wb") as out:
            for copy in range(number * copies, (number + 1) * copies):
                scenario = scenarios[copy % len(scenarios)]
                scenario.scenario_id = f"copy-{copy}"
                out.write(frame(scenario.SerializeToString()))
    return list(map(str, files))


def _row(what: str, figure: float, unit: str, digits: int = 0) -> dict[str, Any]:
    return {"what": what, "figure": figure, "unit": unit, "digits": digits}


def _sizes(inputs: list[str], size: Callable[[str], int], store: SceneStore) -> list[dict[str, Any]]:
    (folder,), (manifest,) = store.folders, store.manifests
    packed = sum((folder / shard["name"]).stat().st_size for shard in manifest.shards) / len(store)
    raw = sum(map(size, inputs)) / len(store)
    rows = [_row("store", packed / 1e3, "KB per scene", 1)]
    return [_row("raw files", raw / 1e3, "KB per scene", 1), *rows, _row("raw over store", raw / packed, "times", 1)]


def _conversion(store: SceneStore, seconds: float, workers: int) -> list[dict[str, Any]]:
    who = resource.RUSAGE_CHILDREN if workers > 1 else resource.RUSAGE_SELF
    return [
        _row(f"conversion with {workers} processes, start included", 60 * len(store) / seconds, "scenes per minute"),
        _row("memory of the largest process", resource.getrusage(who).ru_maxrss / KIB_PER_GIB, "GiB", 2),
    ]


def _batches(store: SceneStore, inputs: list[str], records: Callable, size: int, repeats: int) -> list[dict[str, Any]]:
    """A batch of random scenes of the store against as many scenes read from the raw files in a row."""
    draw, size = random.Random(0), min(size, len(store))

    def from_raw() -> list[Scene]:
        made = (record.scene() for path in inputs for record in records(path))
        return list(islice(made, size))

    def from_store() -> list[Scene]:
        return [store[index] for index in draw.sample(range(len(store)), size)]

    raw, packed = (_seconds(lambda load=load: collate(load()), repeats) for load in (from_raw, from_store))
    return [
        _row(f"batch of {size} from raw files", raw, "s", 2),
        _row(f"batch of {size} random scenes of the store", packed, "s", 3),
        _row("raw over store", raw / packed, "times", 1),
    ]


def _seconds(work: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats + 1):  # the first one warms up
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])
