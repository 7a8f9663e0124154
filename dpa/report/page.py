"""One page that shows a comparison: what it found, the table, figures, playable scenes, and how it was made.

The page is one file that asks nothing of a network: pictures and scenes lie inside it, and its own security policy
forbids to load anything else.
"""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from dpa.report.findings import headline, reservations
from dpa.report.player import PlayerScene, pack_players
from dpa.report.table import cells, header, summarise

REQUIRED = ("metric", "scenes", "rows", "paired", "wall_seconds", "versions", "command", "seeds", "stages")
"""Keys of a comparison that a page shows; see :mod:`dpa.report`."""


class Picture(NamedTuple):
    """A figure of the page.

    Attributes:
        path: a PNG; its bytes are copied into the page.
        caption: what it shows; the first sentence becomes the heading.
    """

    path: str | Path
    caption: str


def write_page(
    folder: str | Path,
    comparison: Mapping[str, Any],
    figures: Sequence[Picture] = (),
    players: Sequence[PlayerScene] = (),
    *,
    config: Mapping[str, Any],
    method: str | None = None,
    title: str = "Preference alignment: comparison",
) -> Path:
    """Write ``index.html``; it appears whole or not at all.

    Args:
        folder: where to write; made if it does not exist.
        comparison: see :mod:`dpa.report`.
        figures: shown in this order.
        players: scenes to play; without any the player is left out.
        config: of the run, as JSON can hold it.
        method: whose result is the headline; see :func:`dpa.report.findings.headline`.
        title: of the page.

    Returns:
        Path of the page.

    Raises:
        ValueError: a key of the comparison is missing, a number is NaN, a figure is no PNG, or rollouts do not fit.

    Examples:
        >>> import tempfile
        >>> comparison = {
        ...     "metric": "2024", "scenes": {"train": 8, "tune": 2, "eval": 4, "source": "synthetic"}, "seeds": [0],
        ...     "rows": [{"method": "reference", "realism": 0.7}], "paired": [], "stages": {"pretrain": 61.0},
        ...     "wall_seconds": 75.0, "versions": {"torch": "2.13"}, "command": "python -m recipes.compare",
        ... }
        >>> page = write_page(tempfile.mkdtemp(), comparison, config={"seed": 0})
        >>> page.name, "1 min 15 s" in page.read_text(encoding="utf-8")
        ('index.html', True)
    """
    missing = [key for key in REQUIRED if key not in comparison]
    if missing:
        raise ValueError(f"the comparison has no {', '.join(missing)}; a page needs {', '.join(REQUIRED)}.")
    records = summarise(comparison["rows"], comparison["paired"])
    parts = {
        "headline": escape(headline(comparison, method)),
        "reservations": "\n".join(f"<li>{escape(note)}</li>" for note in reservations(comparison, method)),
        "table_header": "".join(map(_table_title, header(records))),
        "table_body": "\n".join(map(_table_row, records, cells(records))),
        "figures": "\n".join(map(_figure, figures)),
        "player": _player(players),
        "facts": "\n".join(f"<dt>{escape(name)}</dt><dd>{value}</dd>" for name, value in _facts(comparison)),
        "config": escape(json.dumps(config, indent=2, ensure_ascii=False, allow_nan=False)),
    }
    return _write(Path(folder) / "index.html", title, _filled("comparison.html", parts))


def write_rollouts(
    path: str | Path, players: Sequence[PlayerScene], facts: Mapping[str, str], *, title: str = "Rollouts"
) -> Path:
    """Write a page that plays scenes and nothing else; it appears whole or not at all.

    Args:
        path: of the page, ``.html``.
        players: scenes to play.
        facts: name -> value of what made them, shown below.
        title: of the page.

    Returns:
        Path of the page.

    Raises:
        ValueError: no scene, or rollouts do not fit.
    """
    if not players:
        raise ValueError("a page of rollouts needs at least one scene.")
    shown = "\n".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items())
    return _write(Path(path), title, _filled("rollouts.html", {"player": _player(players), "facts": shown}))


def _write(path: Path, title: str, body: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    part.write_text(_filled("page.html", {"title": escape(title), "body": body}), encoding="utf-8")
    os.replace(part, path)
    return path


def duration(seconds: float) -> str:
    """A time span for people, in its two largest units.

    Examples:
        >>> duration(4321), duration(59.6), duration(0.25)
        ('1 h 12 min', '1 min 0 s', '0.2 s')
    """
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def _table_title(name: str) -> str:
    # A title may wrap between words, so that the table fits a screen; a hyphen is no such place.
    return f'<th scope="col">{escape(name).replace("-", "&#8209;")}</th>'


def _table_row(record: Mapping[str, Any], texts: Sequence[str]) -> str:
    apart = record["ci95"] is not None and not record["ci95"][0] <= 0 <= record["ci95"][1]
    opening = '<tr class="apart">' if apart else "<tr>"
    return opening + "".join(f"<td>{escape(text)}</td>" for text in texts) + "</tr>"


def _figure(picture: Picture) -> str:
    content = Path(picture.path).read_bytes()
    if not content.startswith(b"\x89PNG"):
        raise ValueError(f"{picture.path} is not a PNG; a page shows PNG figures.")
    data = base64.b64encode(content).decode("ascii")
    heading, _, rest = picture.caption.partition(". ")
    return (
        f"<h2>{escape(heading.rstrip('.'))}</h2>\n"
        f'<figure><img alt="{escape(picture.caption)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{escape(rest)}</figcaption></figure>"
    )


def _player(players: Sequence[PlayerScene]) -> str:
    if not players:
        return ""
    packed = json.dumps(pack_players(players), separators=(",", ":"), allow_nan=False)
    # Inside a script element only these could end it or open a comment; JSON may write any character as an escape.
    for character in "<>&":
        packed = packed.replace(character, f"\\u{ord(character):04x}")
    return _filled("player.html", {"player_data": packed, "player_script": _text("player.js")})


def _facts(comparison: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and values (already escaped) of what made the numbers."""
    scenes = comparison["scenes"]
    counts = ", ".join(f"{scenes[split]} {split}" for split in ("train", "tune", "eval"))
    return [
        ("command", f"<code>{escape(comparison['command'])}</code>"),
        ("scenes", escape(f"{counts} ({scenes['source']})")),
        ("seeds", escape(", ".join(map(str, comparison["seeds"])))),
        ("realism metric", escape(str(comparison["metric"]))),
        ("wall time", escape(duration(comparison["wall_seconds"]))),
        ("stages", escape(", ".join(f"{name} {duration(spent)}" for name, spent in comparison["stages"].items()))),
        ("versions", escape(", ".join(f"{name} {version}" for name, version in comparison["versions"].items()))),
    ]


def _filled(template: str, parts: Mapping[str, str]) -> str:
    """Fill a template's ``<!--{name}-->`` marks in one pass, so that what is put in is never searched for marks."""
    return re.sub(r"<!--\{(\w+)\}-->", lambda mark: parts[mark[1]], _text(template))


def _text(name: str) -> str:
    return resources.files("dpa.report").joinpath(name).read_text(encoding="utf-8")
