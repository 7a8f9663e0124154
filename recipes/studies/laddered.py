"""A rung of a ladder, read back to be compared with what was evaluated on the same scenes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dpa.report.experiment import read_json


def read_rung(path: Path, evaluated: Mapping[str, Any], name: str) -> dict[str, list[float | None]]:
    """Figures of every scene by the metric that an evaluation was scored by.

    Args:
        path: file of a rung in the folder of ``recipes.ladder``, ``output/log_through_tokens.json``.
        evaluated: options of the evaluation that it is compared with.
        name: of that evaluation, for messages.

    Raises:
        ValueError: no such file, no rung, or one of other scenes, another number of rollouts, or without that metric.

    Examples:
        >>> import json, tempfile
        >>> options = {"scenes": "a", "num_rollouts": 32, "years": {"2024": ["2024", "f0"]}}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "log.json"
        ...     scored = [{"2024": {"realism": 0.9}}, {"2024": {"realism": 0.7}}]
        ...     _ = path.write_text(json.dumps({"options": options, "per_scene": scored}))
        ...     evaluated = {"scenes": "a", "evaluation": {"num_rollouts": 32, "metric": ["2024", "f0"]}}
        ...     read_rung(path, evaluated, "reference")
        {'realism': [0.9, 0.7]}
    """
    content = read_json(path) if path.is_file() else None
    options = content.get("options") if isinstance(content, dict) else None
    if not isinstance(options, dict) or "years" not in options:
        raise ValueError(
            f"{path} is no rung that recipes.ladder wrote; name a file of its folder, such as log_through_tokens.json."
        )
    for what, mine, other in (
        ("scenes", options["scenes"], evaluated["scenes"]),
        ("num_rollouts", options["num_rollouts"], evaluated["evaluation"]["num_rollouts"]),
    ):
        if mine != other:
            raise ValueError(f"{path} has {what} {mine} and {name} has {other}; run both with the same.")
    metric = evaluated["evaluation"]["metric"]
    year = next((year for year, described in options["years"].items() if described == metric), None)
    if year is None:
        raise ValueError(
            f"{path} was scored by {_in_words(options['years'].values())} and {name} by {_in_words([metric])}; run "
            f"recipes.ladder with years=[{metric[0]}]."
        )
    scored = [scene[year] for scene in content["per_scene"]]
    return {figure: [scene[figure] for scene in scored] for figure in scored[0]}


def _in_words(described: Any) -> str:
    return ", ".join(f"{year} ({digest})" for year, digest in described)
