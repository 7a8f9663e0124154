"""What the page does not show yet, each with the command that makes it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from dpa.report.markup import Section, element, hint, joined
from dpa.report.study import STUDIES, Study

OF_ONE = ("experiment", "method", "only", "rankings", "pictures", "decoding.chosen")
"""Options that belong to one experiment alone."""
OF_ALL = "experiment.checkpoints="
"""But not which checkpoints are kept: ``alignment.snapshots``, which experiments of a folder share, goes with it."""


def missing_section(study: Study, experiments: Iterable[str]) -> Section | None:
    """Names of what the folder lacks; None where it lacks nothing, or was put together from parts.

    Args:
        study: of the page.
        experiments: names of all that ``recipes.compare`` knows.
    """
    if study.main is not None and study.main.put_together:
        return None
    folder = study.folder
    options = _options(study)
    lacking = {
        f"experiment {name}": shlex.join(["python", "-m", "recipes.compare", f"experiment={name}", *options])
        for name in experiments
        if name not in study.experiments
    }
    references = "seed_*/reference/policy.pt"
    policies = folder / references if any(folder.glob(references)) else "POLICY.pt"
    lacking |= {
        name: shlex.join(
            ["python", "-m", f"recipes.{name}", *_scenes(study), f"policies=[{policies}]", f"output={folder / name}"]
        )
        for name in STUDIES
        if name not in study.summaries
    }
    if study.main is not None and not study.scenes:
        lacking["data cards of the scenes"] = _again(study.main.command, folder)
    if study.players is None:
        lacking["scenes to play"] = shlex.join(["python", "-m", "recipes.compare", *options, "pictures.scenes=3"])
    if not lacking:
        return None
    rows = [element("li", name, ": ", element("code", command)) for name, command in lacking.items()]
    note = hint(f"{', '.join(STUDIES)} rank by options of their own (--help), not by those of the experiments.")
    return Section("missing", "Not here yet", joined([element("ul", *rows), note]))


def _again(command: str, folder: Path) -> str:
    """A command of recipes.compare that finds everything done in the folder as it is called now."""
    return shlex.join([*(each for each in shlex.split(command) if not each.startswith("output=")), f"output={folder}"])


def _options(study: Study) -> list[str]:
    """Options of the main experiment's command that another experiment in the same folder has to share."""
    given = shlex.split(study.main.command)[3:] if study.main is not None else []
    own = [each for each in given if each.lstrip("+~").startswith(OF_ONE) and not each.startswith(OF_ALL)]
    kept = [each for each in given if each not in own and not each.startswith("output=")]
    return [*kept, f"output={study.folder}"]


def _scenes(study: Study) -> list[str]:
    """Options that give the scenes of the main experiment, whatever YAML they came from."""
    return list(_settings("scenes", study.main.config.get("scenes", {}))) if study.main is not None else []


def _settings(name: str, value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, each in value.items():
            yield from _settings(f"{name}.{key}", each)
    else:
        yield f"{name}={json.dumps(value)}"
