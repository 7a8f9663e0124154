"""What the page does not show yet, each with the command that makes it."""

from __future__ import annotations

from collections.abc import Iterable

from dpa.report.markup import Section, element, hint, joined
from dpa.report.study import STUDIES, Study


def missing_section(study: Study, experiments: Iterable[str]) -> Section | None:
    """Names of what the folder lacks; None where it lacks nothing.

    Args:
        study: of the page.
        experiments: names of all that ``recipes.compare`` knows.
    """
    folder = study.folder
    lacking = {
        f"experiment {name}": f"python -m recipes.compare experiment={name} output={folder}"
        for name in experiments
        if name not in study.experiments
    }
    references = sorted(folder.glob("seed_*/reference/policy.pt")) or ["POLICY.pt"]
    policies = ",".join(map(str, references))
    lacking |= {
        name: f"python -m recipes.{name} policies=[{policies}] output={folder / name}"
        for name in STUDIES
        if name not in study.summaries
    }
    if study.players is None:
        lacking["scenes to play"] = f"python -m recipes.compare output={folder}"
    if not lacking:
        return None
    rows = [element("li", name, ": ", element("code", command)) for name, command in lacking.items()]
    about = hint("Add the options of the scenes that the commands of this page have.")
    return Section("missing", "Not here yet", joined([element("ul", *rows), about]))
