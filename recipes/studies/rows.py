"""Rows of a study, each in a file of its own, so that a killed study goes on with the next one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from envs.files import write_json
from recipes.common.cli import finished


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
