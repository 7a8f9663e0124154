"""What a study measures, scene by scene, kept as it comes: a killed study goes on with the next scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from envs.files import write_json
from envs.progress import progress
from envs.store import SceneStore
from recipes.common.cli import finished
from recipes.common.partial import PartialResult
from recipes.common.rolled import Rolled
from recipes.common.scenes import fingerprint

Roll = Callable[[frozenset[int]], Iterator[Rolled]]
"""Rolls out the scenes that are not done, in any order."""
Measure = Callable[[Rolled], dict[str, Any]]
"""Numbers of one scene from its rollouts, ready for JSON."""


def measure_rows(
    folder: str | Path,
    decided_by: dict[str, Any],
    scenes: SceneStore,
    rows: Iterable[tuple[str, dict[str, Any], Roll]],
    measure: Measure,
) -> dict[str, dict[str, Any]]:
    """:func:`measure_row` of each ``(name, what else decides it, roll)``: ``{row: {figure: one value per scene}}``."""
    return {
        name: _by_figure(measure_row(folder, name, decided_by | own, scenes, roll, measure)) for name, own, roll in rows
    }


def _by_figure(values: list[Any]) -> Any:
    if not isinstance(values[0], dict):
        return values
    return {name: _by_figure([each[name] for each in values]) for name in values[0]}


def measure_row(
    folder: str | Path, name: str, decided_by: dict[str, Any], scenes: SceneStore, roll: Roll, measure: Measure
) -> list[dict[str, Any]]:
    """What is measured of every scene in one row of a study; what an earlier run has measured is read back.

    Args:
        folder: of the study.
        name: of the row.
        decided_by: all that decides it beside the scenes.
        scenes: in the order of what is given.
        roll: rolls them out.
        measure: of one scene.

    Raises:
        ValueError: the row is there with other options, or from an earlier version.
    """
    path = Path(folder) / f"{name.replace(':', '').replace(' ', '_').replace('/', '_')}.json"
    options = decided_by | {"scenes": fingerprint(scenes)}
    if (done := finished(path, options)) is not None:
        if "per_scene" not in done:
            raise ValueError(f"{path} was written by an earlier version; name another folder, or remove it.")
        return done["per_scene"]
    partial = PartialResult(path, options)
    found = partial.read()
    with progress(total=len(scenes), description=name, initial=len(found), unit="scene") as bar:
        for each in roll(frozenset(found)):
            found[each.index] = measure(each)
            partial.add({each.index: found[each.index]})
            bar.update()
    per_scene = [found[index] for index in range(len(scenes))]
    write_json(path, {"options": options, "scenes": scenes.scene_ids, "per_scene": per_scene})
    partial.remove()
    return per_scene
