"""Raw recordings of any source -> a :class:`~envs.store.SceneStore`, with many workers, resumable.

    python -m envs.convert womd data/training scenes/train --workers 16
    python -m envs.convert info scenes/train
    python -m envs.convert verify scenes/train

The plan comes first: every scene of every input, in order, cut into shards of equal size. So the shards can be made by
any number of processes, or after a crash by another run, and the bytes on disk are the same.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from envs.progress import progress
from envs.scene import Scene, SceneError
from envs.shards import PARTIAL_PREFIX, RECORD_FILE, ShardRecord, file_digest, read_record, write_shard
from envs.sources import SOURCES, Source, Unit
from envs.store import MANIFEST_FILE, Manifest, SceneStore, read_manifest, write_manifest
from envs.workers import run_tasks

SHARD_SIZE = 256
"""Scenes in a shard. Each worker holds one shard in memory while it makes it (about 0.2 GB for WOMD)."""
BAD_INPUT_STATUS = 2
INTERRUPTED_STATUS = 130
"""Exit status after an error in the inputs or the store."""


@dataclass(frozen=True)
class ShardTask:
    """One shard to make; small, so that it travels to a worker.

    Attributes:
        source: name of the source.
        units: its scenes.
        folder: where the shard goes.
        skip_bad: note units that give no scene instead of failing.
    """

    source: str
    units: list[Unit]
    folder: Path
    skip_bad: bool


def convert(
    source: str,
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    workers: int = 1,
    shard_size: int = SHARD_SIZE,
    limit: int | None = None,
    skip_bad: bool = False,
    show_progress: bool = False,
) -> SceneStore:
    """Convert inputs to a store, or go on with a conversion that was cut off.

    A finished conversion of the same inputs is opened and returned. Processes that ask for the same one at the same
    time wait for each other. With more than one worker, call it under ``if __name__ == "__main__"``.

    Args:
        source: a name of :data:`~envs.sources.SOURCES`.
        paths: inputs; for sources that read files: files, folders or patterns.
        out: folder of the store.
        workers: processes; 1 works in this one.
        shard_size: scenes in a shard.
        limit: take only so many scenes, the first ones.
        skip_bad: leave inputs out that give no scene, and list them in the manifest.
        show_progress: show a progress bar on stderr.

    Raises:
        SceneError: a bad input (naming it and the record; finished shards are kept), two scenes of one id, or ``out``
            holds something else.
        ValueError: no such source, or a number that is not positive.

    Examples:
        >>> convert("wmod", ["data"], "out")
        Traceback (most recent call last):
        ...
        ValueError: no source 'wmod'; known: ...
    """
    if source not in SOURCES:
        raise ValueError(f"no source {source!r}; known: {', '.join(SOURCES)}.")
    for name, value in (("workers", workers), ("shard_size", shard_size), ("limit", 1 if limit is None else limit)):
        if value < 1:
            raise ValueError(f"{name} must be 1 or more, got {value}.")
    units, unreadable = _plan(SOURCES[source], list(map(str, paths)), limit, skip_bad)
    manifest = Manifest(source, {"shard_size": shard_size, "limit": limit}, _digest(units), skipped=unreadable)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    with _locked(out):
        if not _resume(out, manifest):
            tasks = [
                ShardTask(source, units[start : start + shard_size], out / f"{start // shard_size:05d}", skip_bad)
                for start in range(0, len(units), shard_size)
            ]
            _make_shards(tasks, workers, out.name, show_progress)
            write_manifest(out, _completed(manifest, [task.folder for task in tasks]))
    store = SceneStore(out)
    if store.manifest.skipped and not skip_bad:
        raise SceneError(f"{out}: was made without a bad input: {store.manifest.skipped[0]['error']}")
    return store


def _plan(
    source: Source, paths: list[str], limit: int | None, skip_bad: bool
) -> tuple[list[Unit], list[dict[str, Any]]]:
    """Every scene to make, in the order of the store, and inputs (or their ends) that cannot be read."""
    units: list[Unit] = []
    unreadable = []
    for name in source.find(paths):
        first = len(units)
        try:
            for unit in source.locate(name):
                units.append(unit)
                if len(units) == limit:
                    return units, unreadable
        except SceneError as error:
            if not skip_bad:
                raise
            unreadable.append(_skip(Unit(name, len(units) - first), error))
        except OSError as error:
            raise SceneError(f"{name}: cannot be read ({error}).") from error
    if not units:
        raise SceneError(f"{', '.join(paths)}: no scenes in there; give inputs of the source {source.name}.")
    return units, unreadable


def _digest(units: list[Unit]) -> str:
    return hashlib.sha256(json.dumps([astuple(unit) for unit in units]).encode()).hexdigest()


def _skip(unit: Unit, error: SceneError) -> dict[str, Any]:
    return {"input": unit.input, "record": unit.record, "error": str(error)}


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a folder alone; the system frees it when the process ends, however it ends."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _resume(out: Path, manifest: Manifest) -> bool:
    """Prepare the folder; true if it holds the finished conversion already."""
    if not (out / MANIFEST_FILE).exists():
        foreign = sorted(path.name for path in out.iterdir() if not path.name.startswith(PARTIAL_PREFIX))
        if foreign:
            raise SceneError(f"{out}: holds {foreign[0]!r} and no store; give a new or empty folder.")
        write_manifest(out, manifest)
    before = read_manifest(out)
    for name in ("source", "options", "plan"):
        if getattr(before, name) != getattr(manifest, name):
            raise SceneError(
                f"{out}: holds a conversion with another {name} ({getattr(before, name)}, now "
                f"{getattr(manifest, name)}); give another folder, or remove this one."
            )
    for leftover in out.glob(f"{PARTIAL_PREFIX}*"):
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
    return before.complete


def _make_shards(tasks: list[ShardTask], workers: int, name: str, show: bool) -> None:
    """Make the shards that are not there yet."""
    seen: dict[str, tuple[str, int]] = {}
    missing = []
    for task in tasks:
        if task.folder.exists():
            _check_ids(read_record(task.folder), seen)
        else:
            missing.append(task)
    total, todo = (sum(len(task.units) for task in some) for some in (tasks, missing))
    with progress(
        total=total, initial=total - todo, description=f"convert {name}", unit="scene", disable=not show
    ) as bar:
        for task in run_tasks(make_shard, missing, workers, bar.update):
            _check_ids(read_record(task.folder), seen)


def _check_ids(record: ShardRecord, seen: dict[str, tuple[str, int]]) -> None:
    for scene_id, unit in zip(record.scene_ids, record.units, strict=True):
        if scene_id in seen:
            raise SceneError(f"scene {scene_id} occurs twice: {seen[scene_id]} and {unit}; leave one input out.")
        seen[scene_id] = unit


def make_shard(task: ShardTask, tick: Callable[[int], Any]) -> None:
    """Make the scenes of one shard and write it.

    Args:
        task: what to make.
        tick: called with 1 after each scene.
    """
    scenes, origins, skipped = [], [], []
    for unit, scene in _make_scenes(task):
        if isinstance(scene, SceneError):
            skipped.append(_skip(unit, scene))
        else:
            scenes.append(scene)
            origins.append((unit.input, unit.record))
        tick(1)
    write_shard(task.folder, scenes, origins, skipped)


def _make_scenes(task: ShardTask) -> Iterator[tuple[Unit, Scene | SceneError]]:
    source = SOURCES[task.source]
    for name, units in groupby(task.units, key=lambda unit: unit.input):
        with source.open(name) as make:
            for unit in units:
                try:
                    yield unit, make(unit).validate(unit.name)
                except SceneError as error:
                    if not task.skip_bad:
                        raise
                    yield unit, error
                except Exception as error:
                    error.add_note(f"while converting {unit.name}")
                    raise


def _completed(manifest: Manifest, folders: list[Path]) -> Manifest:
    records = [read_record(folder) for folder in folders]
    skipped = manifest.skipped + [skip for record in records for skip in record.skipped]
    if not any(record.scene_ids for record in records):
        raise SceneError(f"no input gave a scene; the first error: {skipped[0]['error']}")
    return replace(
        manifest,
        complete=True,
        shards=[
            {"name": folder.name, "scenes": len(record.scene_ids), "sha256": file_digest(folder / RECORD_FILE)}
            for folder, record in zip(folders, records, strict=True)
        ],
        skipped=skipped,
    )


def describe(store: SceneStore) -> str:
    """What a store holds, as text of a few lines."""
    size = sum(file.stat().st_size for file in store.folder.rglob("*") if file.is_file())
    manifest = store.manifest
    lines = [
        f"{store.folder}",
        f"  source    {manifest.source}, {manifest.options}",
        f"  scenes    {len(store)} in {len(manifest.shards)} shards",
        f"  agents    {store.num_agents.mean():.1f} in a scene at the current step, {store.num_agents.max()} at most",
        f"  size      {size / 1e6:.1f} MB, {size / 1e3 / len(store):.0f} KB per scene",
        f"  skipped   {len(manifest.skipped)}",
    ]
    return "\n".join(lines + [f"    {skip['error']}" for skip in manifest.skipped])


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m envs.convert",
        description="Convert raw recordings to a store of scenes. Run it again to go on after an interruption.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="SOURCE | info | verify")
    for source in SOURCES.values():
        command = commands.add_parser(source.name, help=source.help, description=f"Convert {source.help}.")
        command.add_argument("paths", nargs="+", metavar="PATHS", help="inputs: files, folders or patterns")
        command.add_argument("out", metavar="OUT", help="folder of the store")
        command.add_argument("--workers", type=int, default=1, help="processes (default: %(default)s)")
        command.add_argument(
            "--shard-size", type=int, default=SHARD_SIZE, metavar="M", help="scenes in a shard (default: %(default)s)"
        )
        command.add_argument("--limit", type=int, metavar="N", help="take only the first N scenes")
        command.add_argument(
            "--skip-bad",
            action="store_true",
            help="leave bad inputs out and list them, instead of stopping at the first",
        )
    for name, help_text in (
        ("info", "say what a store holds"),
        ("verify", "compare a store with its checksums and validate every scene"),
    ):
        command = commands.add_parser(name, help=help_text, description=f"{help_text.capitalize()}.")
        command.add_argument("out", metavar="OUT", help="folder of the store")
        command.add_argument("--ids", action="store_true", help="list the scenes too: index, id and number of agents")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    options = vars(_parser().parse_args(arguments))
    command, out, ids = options.pop("command"), options.pop("out"), options.pop("ids", False)
    try:
        if command in SOURCES:
            store = convert(command, options.pop("paths"), out, show_progress=True, **options)
        else:
            store = SceneStore(out)
        if command == "verify":
            with progress(total=len(store), description="verify", unit="scene") as bar:
                store.verify(bar.update)
        sys.stdout.write(describe(store) + "\n")
        if ids:
            rows = zip(store.scene_ids, store.num_agents.tolist(), strict=True)
            sys.stdout.writelines(f"{index:>8}  {name}  {agents}\n" for index, (name, agents) in enumerate(rows))
    except ValueError as error:
        sys.stderr.write(f"error: {error}\n")
        return BAD_INPUT_STATUS
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; run the same command again to go on\n")
        return INTERRUPTED_STATUS
    return 0


if __name__ == "__main__":
    sys.exit(main())
