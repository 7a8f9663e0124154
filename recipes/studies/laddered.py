"""A rung of a ladder, read back to be compared with what was evaluated on the same scenes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dpa.report.experiment import read_json


def read_rung(path: Path, evaluations: Mapping[str, Path]) -> dict[str, list[float | None]]:
    """Figures of every scene by the metric that evaluations were scored by.

    Args:
        path: file of a rung in the folder of ``recipes.ladder``, ``output/log_through_tokens.json``.
        evaluations: files that it is compared with, one or more, of one experiment, by their names in messages.

    Raises:
        ValueError: no such file, no rung, or one of other scenes, another number of rollouts, or without that metric.

    Examples:
        >>> import json, tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> options = {"scenes": "a", "num_rollouts": 32, "years": {"2024": ["2024", "f0"]}}
        >>> scored = [{"2024": {"realism": 0.9}}, {"2024": {"realism": 0.7}}]
        >>> _ = (folder / "log.json").write_text(json.dumps({"options": options, "per_scene": scored}))
        >>> evaluated = {"scenes": "a", "evaluation": {"num_rollouts": 32, "metric": ["2024", "f0"]}}
        >>> _ = (folder / "eval.json").write_text(json.dumps({"options": evaluated}))
        >>> read_rung(folder / "log.json", {"reference": folder / "eval.json"})
        {'realism': [0.9, 0.7]}
    """
    content = read_json(path) if path.is_file() else None
    options = content.get("options") if isinstance(content, dict) else None
    if not isinstance(options, dict) or "years" not in options:
        raise ValueError(
            f"{path} is no rung that recipes.ladder wrote; name a file of its folder, such as log_through_tokens.json."
        )
    (year,) = {_year_of(path, options, name, file) for name, file in evaluations.items()}
    scored = [scene[year] for scene in content["per_scene"]]
    return {figure: [scene[figure] for scene in scored] for figure in scored[0]}


def _year_of(path: Path, options: dict[str, Any], name: str, file: Path) -> str:
    """Key of the metric that an evaluation was scored by, once it is known to be of the same scenes and rollouts."""
    evaluated = read_json(file).get("options")
    if evaluated is None:
        raise ValueError(f"{file} does not say what it was evaluated with; evaluate again.")
    for what, mine, other in (
        ("scenes", options["scenes"], evaluated["scenes"]),
        ("num_rollouts", options["num_rollouts"], evaluated["evaluation"]["num_rollouts"]),
    ):
        if mine != other:
            raise ValueError(f"{path} has {what} {mine} and {name} has {other}; run both with the same.")
    metric = evaluated["evaluation"]["metric"]
    for year, described in options["years"].items():
        if described == metric:
            return year
    known = ", ".join(f"{year} ({digest})" for year, digest in options["years"].values())
    raise ValueError(
        f"{path} was scored by {known} and {name} by {metric[0]} ({metric[1]}); run recipes.ladder with "
        f"years=[{metric[0]}]."
    )
