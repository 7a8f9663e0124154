"""Where the numbers of a study of rankings come from, and its figures where its summary cannot be shown."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dpa.report.markup import Html, Section, command, element, facts, folded, hint, html, joined


def origin(name: str, found: Mapping[str, Any]) -> Html:
    """File, command and configuration of a study.

    Args:
        name: of the study.
        found: its summary, with ``made`` where the recipe wrote it.
    """
    made = found.get("made")
    numbers = facts(
        {"numbers": element("code", f"{name}/summary.json"), "of each scene": element("code", f"{name}/*.json")}
    )
    if made is None:
        return folded("where the numbers are", numbers, command(f"python -m recipes.{name}"))
    config = element("pre", json.dumps(made["config"], indent=2, ensure_ascii=False, allow_nan=False))
    return folded("command and configuration", command(made["command"]), numbers, folded("configuration", config))


def study_section(
    name: str, found: Mapping[str, Any], pictures: list[Path], show: Callable[[Mapping[str, Any]], Section]
) -> Section:
    """A study by its interactive figures, or by its pictures where the summary lacks what they need.

    Args:
        name: of the study.
        found: its summary.
        pictures: PNGs that its recipe drew.
        show: makes the section from the summary.

    Raises:
        ValueError: the summary lacks an entry, and there is no picture to show instead.
    """
    try:
        return show(found)
    except (KeyError, TypeError) as error:
        if not pictures:
            raise ValueError(f"{name}/summary.json lacks {error}; run python -m recipes.{name} again.") from None
        note = hint(
            f"{name}/summary.json lacks {error}: its pictures stand here; python -m recipes.{name} makes both anew."
        )
        return Section(name, name.capitalize(), joined([note, *map(picture, pictures)]))


def picture(path: Path) -> Html:
    """A PNG within the page.

    Raises:
        ValueError: the file is no PNG.
    """
    content = path.read_bytes()
    if not content.startswith(b"\x89PNG"):
        raise ValueError(f"{path} is not a PNG; a page shows PNG pictures.")
    data = base64.b64encode(content).decode("ascii")
    return element("figure", Html(f'<img alt="{html(path.stem)}" src="data:image/png;base64,{data}">'))
