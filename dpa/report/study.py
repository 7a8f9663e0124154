"""The folder of a study, read for its page: experiments, stages, data cards, studies of rankings, scenes to play."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dpa.preferences.card import DataCard
from dpa.report.cards import read_preference_cards
from dpa.report.experiment import REPORTED, Experiment, read_experiment, read_json
from dpa.report.scenes import SceneCard, read_scene_cards

STUDIES = ("validity", "sensitivity", "discriminator")
"""Folders of a study that a recipe of their own fills."""
FIRST = "methods"
"""Experiment that stands first where there is one, so that the headline is of it; those of tuning scenes stand last."""


@dataclass(frozen=True)
class Study:
    """What a folder of results holds; a part that it lacks is None or empty.

    Attributes:
        folder: of the study.
        experiments: by name, :data:`FIRST` before the others, and those of tuning scenes after them.
        stages: seconds of each job of each stage.
        players: packed scenes and rollouts, see :func:`dpa.report.player.pack_players`.
        summaries: ``summary.json`` of each of :data:`STUDIES`.
        scenes: data card of the scenes of each split.
        cards: data card of each store of preferences, by its folder relative to the study's.
    """

    folder: Path
    experiments: Mapping[str, Experiment]
    stages: Mapping[str, Mapping[str, float]]
    players: Mapping[str, Any] | None
    summaries: Mapping[str, Mapping[str, Any]]
    scenes: Mapping[str, SceneCard]
    cards: Mapping[str, DataCard]

    @property
    def main(self) -> Experiment | None:
        """The experiment that the headline is of: the first one."""
        return next(iter(self.experiments.values()), None)

    @property
    def seconds(self) -> dict[str, float]:
        """Time of one worker of each stage, each job once."""
        return {name: math.fsum(jobs.values()) for name, jobs in self.stages.items()}


def read_study(folder: str | Path) -> Study:
    """Read a folder of results.

    Args:
        folder: RUNS of ``recipes.compare``.

    Raises:
        ValueError: no such folder, nothing in it that a page could show, or a file that cannot be read; the message
            names it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder; name the one that recipes.compare wrote (its output=...).")
    experiments = [read_experiment(path) for path in (folder / "experiments").glob("*.json")]
    experiments.sort(key=lambda each: (each.path.stem != FIRST, REPORTED.index(each.split), each.path.stem))
    summaries = {name: folder / name / "summary.json" for name in STUDIES}
    summaries = {name: read_json(path) for name, path in summaries.items() if path.is_file()}
    if not experiments and not summaries:
        raise ValueError(
            f"{folder} holds no results: neither experiments/*.json nor {', '.join(STUDIES)} with a summary.json; run "
            f"python -m recipes.compare experiment={FIRST} output={folder} first."
        )
    stages, players, scenes = (folder / f"{name}.json" for name in ("stages", "players", "scenes"))
    return Study(
        folder=folder,
        experiments={each.path.stem: each for each in experiments},
        stages=_account(stages) if stages.is_file() else {},
        players=read_json(players) if players.is_file() else None,
        summaries=summaries,
        scenes=read_scene_cards(scenes) if scenes.is_file() else {},
        cards=read_preference_cards(folder),
    )


def _account(path: Path) -> dict[str, dict[str, float]]:
    """Worker-seconds of every job, by stage."""
    stages = read_json(path)
    jobs = list(stages.values()) if isinstance(stages, dict) else [None]
    if not all(isinstance(each, dict) and all(type(s) in (int, float) for s in each.values()) for each in jobs):
        raise ValueError(f"{path} is no account of worker-seconds by stage and job; remove it, the page does without.")
    return stages


class Evaluations:
    """Figures of every scene, from the files behind the rows; each file is read once.

    Args:
        folder: of the study, all of whose files of a split are of the same scenes.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self._read: dict[str, dict[str, list[float | None]] | None] = {}
        self._scenes: dict[str, tuple[Path, list[str]]] = {}

    def __call__(self, file: str) -> Mapping[str, list[float | None]] | None:
        """Values of each scene by figure; None if the file is not in the folder.

        Raises:
            ValueError: the file is no result of an evaluation, or of other scenes than another one of its split, as
                where two studies were put into one folder.
        """
        if file not in self._read:
            path = self.folder / file
            content = read_json(path) if path.is_file() else {"per_scene": None}
            if not isinstance(content, dict) or "per_scene" not in content:
                raise ValueError(f"{path} has no 'per_scene'; it is no result of an evaluation.")
            if "scenes" in content:
                self._check_scenes(path, content["scenes"])
            self._read[file] = content["per_scene"]
        return self._read[file]

    def _check_scenes(self, path: Path, scenes: list[str]) -> None:
        split = next((name for name in REPORTED if name in path.stem.split("_")), "")
        first, known = self._scenes.setdefault(split, (path, scenes))
        if scenes != known:
            raise ValueError(
                f"{first} and {path} are of other scenes, so that nothing can be paired; keep each study, and each "
                "archive of one, in a folder of its own."
            )
