"""Pages that are one file each and ask nothing of a network: the report of a study, and scenes to play.

Pictures, scenes, numbers and the code that draws them lie inside the page, and its own security policy forbids to load
anything else.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from plotly.offline import get_plotlyjs

from dpa.report.charts import palette
from dpa.report.markup import Html, Section, element, facts, filled, in_script, joined, resource
from dpa.report.player import PlayerScene, pack_players
from dpa.report.sections.account import account_section
from dpa.report.sections.claim import claim
from dpa.report.sections.likelihood import training_section
from dpa.report.sections.missing import missing_section
from dpa.report.sections.origin import study_section
from dpa.report.sections.rankings import discriminator_section, sensitivity_section, validity_section
from dpa.report.sections.results import experiment_section
from dpa.report.study import Evaluations, Study
from envs.files import write_bytes

TITLE = "Preference alignment"
SHOWS = {"validity": validity_section, "sensitivity": sensitivity_section, "discriminator": discriminator_section}


def write_study(path: str | Path, study: Study, *, experiments: Iterable[str] = ()) -> Path:
    """Write the page of a study; it appears whole or not at all.

    Args:
        path: of the page, ``.html``.
        study: see :func:`dpa.report.study.read_study`.
        experiments: names of all experiments there are; those that the study lacks are named on the page.

    Returns:
        Path of the page.

    Raises:
        ValueError: a file behind the numbers cannot be read; the message names it.
    """
    sections = list(_sections(study, experiments))
    index = [element("a", section.title, href=f"#{section.name}") for section in sections]
    shown = [
        element("section", element("h2", heading) if headed else "", body, id=name)
        for name, heading, body, headed in sections
    ]
    body = joined(
        [
            element("header", element("h1", TITLE), claim(study)),
            element("nav", *index, aria_label="Contents"),
            element("main", *shown),
            Html(f"<script>{get_plotlyjs()}</script>"),
            Html(f"<script>{resource('report.js')}</script>"),
        ]
    )
    return _write(Path(path), TITLE, body, style=resource("report.css"))


def write_rollouts(
    path: str | Path, players: Sequence[PlayerScene], shown: Mapping[str, str], *, title: str = "Rollouts"
) -> Path:
    """Write a page that plays scenes and nothing else; it appears whole or not at all.

    Args:
        path: of the page, ``.html``.
        players: scenes to play.
        shown: name -> value of what made them, shown below.
        title: of the page.

    Returns:
        Path of the page.

    Raises:
        ValueError: no scene, or rollouts do not fit.
    """
    if not players:
        raise ValueError("a page of rollouts needs at least one scene.")
    parts = [element("h1", title), player(pack_players(players)), element("h2", "How this was made"), facts(shown)]
    return _write(Path(path), title, joined(parts))


def player(packed: Mapping[str, Any]) -> Html:
    """The scene player.

    Args:
        packed: scenes and rollouts, see :func:`dpa.report.player.pack_players`.
    """
    data = in_script(json.dumps(packed, separators=(",", ":"), allow_nan=False))
    return filled("player.html", {"player_data": data, "player_script": resource("player.js")})


def _sections(study: Study, experiments: Iterable[str]) -> Iterable[Section]:
    evaluations = Evaluations(study.folder)
    colours: dict[str, dict[str, str]] = {}
    for experiment in study.experiments.values():
        known = {method: colour for each in colours.values() for method, colour in each.items()}
        colours[experiment.name] = palette(experiment.methods, known)
        yield experiment_section(experiment, colours[experiment.name], evaluations)
    yield from _some(training_section(list(study.experiments.values()), study.folder, colours))
    for name, found in study.summaries.items():
        yield study_section(name, found, study.folder, SHOWS[name])
    if study.players is not None:
        yield Section("scenes", "Scenes", player(study.players), headed=False)
    yield from _some(account_section(study))
    yield from _some(missing_section(study, experiments))


def _some(section: Section | None) -> list[Section]:
    return [] if section is None else [section]


def _write(path: Path, title: str, body: str, *, style: str = "") -> Path:
    return write_whole(path, filled("page.html", {"title": escape(title), "style": style, "body": body}))


def write_whole(path: Path, text: str) -> Path:
    """Write a text; it appears whole or not at all.

    Args:
        path: of the file, in a folder that is made where there is none.
        text: its content.

    Returns:
        ``path``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, text.encode())
    return path
