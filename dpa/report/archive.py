"""What the numbers of a study rest on, as one file to put beside a paper or a document."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

from dpa.report.cards import KEPT as CARDS
from dpa.report.cards import read_preference_cards
from envs.files import PARTIAL_PREFIX, whole

KEPT = (".json", ".csv")
"""Endings of files that hold results, options and curves."""
LEFT_OUT = ("checkpoints", "preferences_*", CARDS, "players.json", "wandb", "tensorboard")
"""Names of what stays out: scenes and rollouts are large, and the licence of a recording may not let them be handed
on, of which the cards tell instead; files of loggers tell of the machine."""
EPOCH = (1980, 1, 1, 0, 0, 0)
"""Date of every entry, so that equal studies give equal files."""


def write_archive(path: Path, folder: Path, *, numbered: bool = False) -> Path:
    """Pack the results of a study with the options, curves and scene-by-scene values behind them.

    Unpacked it is a folder of results like the one that it came from: tables, intervals and the page are made from it
    again, without its scenes to play.

    Args:
        path: ``.zip`` to write, in a folder that is there; it appears whole or not at all.
        folder: of the study.
        numbered: scenes are called by their place in their split, as where a licence covers what names recordings.

    Returns:
        ``path``.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.TemporaryDirectory()
        >>> for name in ("stages.json", "policy.pt"):
        ...     size = Path(folder.name, name).write_text("{}")
        >>> zipfile.ZipFile(write_archive(Path(folder.name, "study.zip"), Path(folder.name))).namelist()
        ['stages.json']
        >>> folder.cleanup()
    """
    with whole(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for file in files_of(folder):
            content = file.read_bytes()
            _add(archive, file.relative_to(folder).as_posix(), number_scenes(content) if numbered else content)
        if cards := {name: card.to_json() for name, card in read_preference_cards(folder).items()}:
            _add(archive, CARDS, json.dumps(cards, indent=1).encode())
    return path


def number_scenes(content: bytes) -> bytes:
    """A file of results with its list of scenes by number; any other content as it is.

    Examples:
        >>> number_scenes(b'{"scenes": ["a7c0", "91d2"], "per_scene": {}}')
        b'{"scenes": ["scene 0", "scene 1"], "per_scene": {}}'
        >>> number_scenes(b"1,0.5")
        b'1,0.5'
    """
    found = json.loads(content) if content.startswith(b"{") else None
    if not isinstance(found, dict) or not isinstance(found.get("scenes"), list):
        return content
    return json.dumps(found | {"scenes": [f"scene {place}" for place in range(len(found["scenes"]))]}).encode()


def _add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    entry = zipfile.ZipInfo(name, EPOCH)
    entry.compress_type = zipfile.ZIP_DEFLATED
    archive.writestr(entry, content)


def files_of(folder: Path) -> Iterator[Path]:
    """The files of a study that :func:`write_archive` packs, in order of their names."""
    for file in sorted(folder.rglob("*")):
        names = file.relative_to(folder).parts
        left_out = any(fnmatch(name, pattern) for name in names for pattern in (*LEFT_OUT, f"{PARTIAL_PREFIX}*"))
        if file.is_file() and file.suffix in KEPT and not left_out:
            yield file
