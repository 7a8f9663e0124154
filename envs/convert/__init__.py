"""Raw recordings of any source -> a :class:`~envs.store.SceneStore`, with many workers, resumable.

    python -m envs.convert womd data/training scenes/train --workers 16
    python -m envs.convert womd 'gs://bucket/training/*' scenes/train --workers 16
    python -m envs.convert info scenes/train
    python -m envs.convert verify scenes/train

The plan comes first (:mod:`envs.convert.plan`): which records go into which shards. So the shards can be made by any
number of processes, or after a crash by another run (:mod:`envs.convert.work`), and the bytes on disk are the same.
"""

from __future__ import annotations

import fcntl
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from envs.convert.describe import write_card
from envs.convert.plan import Task, digest, find_inputs, make_plan
from envs.convert.work import make_shards
from envs.files import PARTIAL_PREFIX
from envs.options import differences
from envs.progress import progress
from envs.scene import SceneError
from envs.shards import ShardRecord, file_digest, read_record
from envs.sources import SOURCES
from envs.store import MANIFEST_FILE, Manifest, SceneStore, read_manifest, write_manifest
from envs.workers import require_guarded_main, run_tasks

SHARD_SIZE = 256
"""Scenes in a shard. Each worker holds one shard of packed scenes in memory (about 25 MB for WOMD)."""

MOST_IN_SHARD = 10_000
"""A shard is written whole and its record read whole; a megabyte of record is enough."""

__all__ = ["SHARD_SIZE", "convert"]


def convert(
    source: str,
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    workers: int = 1,
    shard_size: int = SHARD_SIZE,
    limit: int | None = None,
    split: str = "",
    skip_bad: bool = False,
    show_progress: bool = False,
) -> SceneStore:
    """Convert inputs to a store, or go on with a conversion that was cut off.

    A finished conversion of the same inputs is opened and returned. Processes that ask for the same one at the same
    time wait for each other. With more than one worker, call it under ``if __name__ == "__main__"``.

    Args:
        source: a name of :data:`~envs.sources.SOURCES`.
        paths: inputs; for sources that read files: files, folders, patterns or addresses (``gs://...``).
        out: folder of the store.
        workers: processes; 1 works in this one.
        shard_size: scenes in a shard.
        limit: take only so many scenes, the first ones.
        split: a name for these scenes that :meth:`~envs.store.SceneStore.select` can ask for.
        skip_bad: leave records out that give no scene, and list them in the manifest.
        show_progress: show a progress bar on stderr.

    Raises:
        SceneError: a bad input (naming it and the record; finished shards are kept), two scenes of one id, or ``out``
            holds something else.
        ValueError: no such source, or a number that is not positive.
        RuntimeError: in a worker, which runs the calling script again because it has no ``__main__`` guard.

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
    if shard_size > MOST_IN_SHARD:
        raise ValueError(f"shard_size must be at most {MOST_IN_SHARD}, got {shard_size}.")
    if workers > 1:
        require_guarded_main()
    out = Path(out)
    inputs = find_inputs(SOURCES[source], named := list(map(str, paths)))
    options = {"shard_size": shard_size, "limit": limit, "split": split}
    manifest = Manifest(source, options, digest(inputs), named)
    out.mkdir(parents=True, exist_ok=True)
    with _locked(out):
        store = _opened(out) if _resume(out, manifest) else None
        if store is None:
            tasks = make_plan(SOURCES[source], inputs, out, shard_size=shard_size, limit=limit, skip_bad=skip_bad)
            _make_missing(tasks, workers, out.name, show_progress)
            manifest = _completed(manifest, [path for task in tasks for path in task.paths()])
            write_card(out, manifest)
            write_manifest(out, manifest)
            store = SceneStore(out)
    if (skipped := store.manifests[0].skipped) and not skip_bad:
        raise SceneError(f"{out}: was made without a bad input: {skipped[0]['error']}")
    return store


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
    there, here = ({"source": each.source, **each.options} for each in (before, manifest))
    if differ := differences(there, here):
        raise SceneError(f"{out}: holds another conversion ({differ}); give another folder, or remove this one.")
    if before.plan != manifest.plan:
        raise SceneError(
            f"{out}: holds a conversion of other inputs: {', '.join(before.named)}; asked for is "
            f"{', '.join(manifest.named)}. Inputs are known by their paths as they are found and by their sizes: name "
            "them in the same way, give another folder, or remove this one."
        )
    for leftover in out.glob(f"{PARTIAL_PREFIX}*"):
        leftover.unlink()
    return before.complete


def _opened(out: Path) -> SceneStore | None:
    """A finished conversion; None where a shard was lost or damaged since and is to be made again."""
    try:
        return SceneStore(out)
    except SceneError:
        return None


def _make_missing(tasks: Sequence[Task], workers: int, name: str, show: bool) -> None:
    """Make the shards that are not there yet, or are damaged."""
    seen: dict[str, tuple[str, int]] = {}
    missing, made = [], 0
    for task in tasks:
        records = list(_whole(task))
        made += sum(record.num_records for record in records)
        if records and records[-1].last:
            _check_ids(records, seen)
        else:
            missing.append(task)
    total = made + sum(task.num_expected for task in missing)
    with progress(total=total, initial=made, description=f"convert {name}", unit="scene", disable=not show) as bar:
        for task in run_tasks(make_shards, missing, workers, bar.update):
            records = [read_record(path) for path in task.paths()]
            _check_ids(records, seen)
            bar.total += sum(record.num_records for record in records) - task.num_expected


def _whole(task: Task) -> Iterator[ShardRecord]:
    """Records of a task's shards; a damaged one goes, and what comes after it counts as missing too."""
    for path in list(task.paths()):
        try:
            yield read_record(path)
        except SceneError:
            path.unlink()
            return


def _check_ids(records: Sequence[ShardRecord], seen: dict[str, tuple[str, int]]) -> None:
    for record in records:
        for scene_id, unit in zip(record.scene_ids, record.units, strict=True):
            if scene_id in seen:
                raise SceneError(f"scene {scene_id} occurs twice: {seen[scene_id]} and {unit}; leave one input out.")
            seen[scene_id] = unit


def _completed(manifest: Manifest, paths: Sequence[Path]) -> Manifest:
    records = [read_record(path) for path in paths]
    skipped = [skip for record in records for skip in record.skipped]
    if not any(record.scene_ids for record in records):
        raise SceneError(f"no input gave a scene; the first error: {skipped[0]['error']}")
    notes = sum((Counter(record.notes) for record in records), Counter())
    return replace(
        manifest,
        complete=True,
        shards=[
            {"name": path.name, "scenes": len(record.scene_ids), "sha256": file_digest(path)}
            for path, record in zip(paths, records, strict=True)
        ],
        skipped=skipped,
        notes=dict(sorted(notes.items())),
    )
