"""Curves of a training run, as its logger wrote them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from dpa.training.loggers import complete_rows

Curve = Mapping[str, Sequence[float]]
"""``{"step": [...], "value": [...]}``."""


def read_curves(folder: str | Path) -> dict[str, dict[str, list[float]]]:
    """Read the scalars that a TorchRL ``CSVLogger`` wrote for one experiment.

    Args:
        folder: ``<log_dir>/<exp_name>``; its ``scalars`` folder holds one file of ``step,value`` rows for each scalar,
            in sub-folders where the name has slashes.

    Returns:
        ``{name: {"step": [...], "value": [...]}}``, in order of name.

    Raises:
        ValueError: no such folder, or a row that is not ``step,value``; the message names file and line. A last row
            that a kill cut short is left out.
    """
    scalars = Path(folder) / "scalars"
    if not scalars.is_dir():
        raise ValueError(f"{folder} has no folder 'scalars'; give the experiment folder of a CSVLogger.")
    curves: dict[str, dict[str, list[float]]] = {}
    for file in sorted(scalars.rglob("*.csv")):
        curve: dict[str, list[float]] = {"step": [], "value": []}
        for line, row in enumerate(complete_rows(file), start=1):
            try:
                step, value = row
                curve["step"].append(int(step))
                curve["value"].append(float(value))
            except ValueError as error:
                raise ValueError(f"{file}:{line}: expected 'step,value', got {','.join(row)!r}.") from error
        curves[file.relative_to(scalars).with_suffix("").as_posix()] = curve
    return curves
