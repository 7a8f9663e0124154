"""Where the numbers of a study of rankings come from, and what is said where its summary is of another version."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dpa.report.experiment import SPLITS
from dpa.report.markup import Html, Section, command, element, facts, folded, hint
from dpa.report.table import MISSING


def origin(name: str, found: Mapping[str, Any]) -> Html:
    """Files, command, code, machine and configuration of a study.

    Args:
        name: of the study.
        found: its summary.
    """
    made = found["made"]
    named = {"numbers": element("code", f"{name}/summary.json"), "of each scene": element("code", f"{name}/*.json")}
    named |= code_of(made.get("date"), made.get("revision"), made.get("machine"), made.get("versions", {}))
    config = element("pre", json.dumps(made["config"], indent=2, ensure_ascii=False, allow_nan=False))
    parts = [command(made["command"]), facts(named), folded("configuration", config)]
    return folded("command, configuration, versions and machine", *parts)


def code_of(
    date: str | None, revision: str | None, machine: str | None, versions: Mapping[str, str]
) -> dict[str, Html | str]:
    """What ran, when and where, for :func:`~dpa.report.markup.facts`; a dash for what was not kept."""
    return {
        "date": date or MISSING,
        "code": element("code", revision) if revision else MISSING,
        "machine": machine or MISSING,
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()) or MISSING,
    }


def scope(found: Mapping[str, Any]) -> Html:
    """Scenes and policies that the numbers of a study are of.

    Args:
        found: its summary.
    """
    made = found["made"]
    scenes = f"{made['scenes']} {SPLITS[made['config']['split']]} scenes"
    policies = len(made["policies"])
    by = f"{policies} {'policy' if policies == 1 else 'policies'}"
    return hint(f"{scenes}, {by}, {made['num_rollouts']} rollouts of each scene.")


def study_section(
    name: str, found: Mapping[str, Any], folder: Path, show: Callable[[Mapping[str, Any]], Section]
) -> Section:
    """The section of a study of rankings.

    Args:
        name: of the study.
        found: its summary.
        folder: of results, for the message.
        show: makes the section from the summary.

    Raises:
        ValueError: the summary lacks an entry, or has another kind of it; the message names file and entry.
    """
    try:
        return show(found)
    except (KeyError, TypeError) as error:
        lacks = f"lacks {error}" if isinstance(error, KeyError) else f"has an entry of another kind ({error})"
        raise ValueError(
            f"{folder / name / 'summary.json'} {lacks}; run python -m recipes.{name} output={folder / name} again, "
            "with its other options as before."
        ) from error
