"""Rows of a study, each in a file of its own, so that a killed study goes on with the next one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from envs.files import write_json
from envs.progress import progress
from envs.scene import Scene, SceneSource
from recipes.common.cli import finished
from recipes.common.rolled import Rolls

Look = Callable[[Scene, Tensor], Any]
"""What is told of a scene and its trajectories ``[R, A, 80, 4]``."""


def looked_at(scenes: SceneSource, rolls: Rolls, look: Look, name: str) -> list[Any]:
    """What is told of every scene, in their order.

    Args:
        scenes: that the rollouts are of.
        rolls: their rollouts, in any order.
        look: at one scene.
        name: of the bar.
    """
    found: dict[int, Any] = {}
    with progress(total=len(scenes), description=name, unit="scene") as bar:
        for index, trajectories in rolls:
            found[index] = look(scenes[index], trajectories)
            bar.update()
    return [found[index] for index in sorted(found)]


def read_or_score(
    folder: str | Path, name: str, options: Mapping[str, Any], figures: str, score: Callable[[], Any]
) -> Any:
    """The figures of one row: read back if it is there, scored and kept if it is not.

    Args:
        folder: of the study.
        name: of the row.
        options: all that decides it.
        figures: what they are called in its file.
        score: makes them.

    Raises:
        ValueError: the row is there with other options.
    """
    path = Path(folder) / f"{name.replace(':', '').replace(' ', '_').replace('/', '_')}.json"
    done = finished(path, options)
    if done is None:
        done = {"options": options, figures: score()}
        write_json(path, done)
    return done[figures]
