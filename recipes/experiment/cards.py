"""Data cards of a study's scenes: counted once, for whoever reads its numbers without having the scenes."""

from __future__ import annotations

from pathlib import Path

from envs.files import write_json
from recipes.common.cli import finished
from recipes.common.scenes import Splits, fingerprint


def write_scene_cards(path: Path, splits: Splits) -> None:
    """Count what the scenes of each split hold, where the file is not there yet.

    Args:
        path: of the JSON.
        splits: all scenes of the study; experiments that share its folder share them.

    Raises:
        ValueError: the file is of other scenes, or damaged.
    """
    scenes = {name: splits[name] for name in splits.sizes()}
    decided_by = {"scenes": {name: fingerprint(each) for name, each in scenes.items()}}
    if finished(path, decided_by) is None:
        cards = {name: {"counts": each.card().counts, "origins": each.origins()} for name, each in scenes.items()}
        write_json(path, {"options": decided_by, "splits": cards})
