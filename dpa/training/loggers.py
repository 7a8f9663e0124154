"""Curves of a run: always one CSV file per metric, and Weights & Biases or TensorBoard on request.

The files lie as torchrl's ``CSVLogger`` lays them out, ``<folder>/scalars/<metric>.csv`` with rows ``step,value`` and
no header, so its readers work. Unlike it, a resumed run drops the rows that it is about to write again.
"""

from __future__ import annotations

import importlib.util
import json
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Protocol, TextIO

Backend = Literal["csv", "wandb", "tensorboard"]
MODULES = {"wandb": "wandb", "tensorboard": "tensorboard"}
"""The package that each further backend needs."""


class MetricLogger(Protocol):
    """Where a run's numbers go."""

    def log(self, metrics: Mapping[str, Any], step: int) -> None:
        """Write numbers or tensors of one element, named ``"<group>/<metric>"``, for one step."""

    def close(self) -> None:
        """Flush and close; a closed logger is not used again."""


def make_logger(
    backend: Backend,
    folder: str | os.PathLike[str],
    config: Mapping[str, Any],
    *,
    resume_step: int | None = None,
    project: str = "dpa-omf",
    name: str | None = None,
    mode: Literal["online", "offline"] = "offline",
) -> MetricLogger:
    """Open the curves of a run.

    CSV is always written; ``backend`` says where else the same numbers go.

    Args:
        backend: ``"csv"``, ``"wandb"`` or ``"tensorboard"``.
        folder: the run's folder. ``config.json`` in it records ``config``.
        config: the run's configuration, plain dicts, lists, numbers and strings.
        resume_step: the step of the checkpoint that the run goes on from: rows of later steps are dropped. ``None``
            for a new run, which drops all rows of an earlier run in the folder.
        project: project of Weights & Biases.
        name: name of the run there; the folder's name by default.
        mode: of Weights & Biases; ``"offline"`` keeps the run in ``folder`` and sends nothing.

    Raises:
        ValueError: an unknown backend.
        ImportError: the backend's package is missing; the message says what to install.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     logger = make_logger("csv", folder, {"lr": 1e-3})
        ...     logger.log({"train/loss": 0.5}, step=1)
        ...     logger.close()
        ...     read_curve(Path(folder), "train/loss")
        [(1, 0.5)]
    """
    if backend not in ("csv", *MODULES):
        raise ValueError(f"logger.backend must be csv, wandb or tensorboard, got {backend!r}.")
    if backend in MODULES and importlib.util.find_spec(MODULES[backend]) is None:
        raise ImportError(
            f"logger.backend={backend} needs the package {MODULES[backend]!r}: install it "
            f"(pip install {MODULES[backend]}) or choose logger.backend=csv."
        )
    folder = Path(folder)
    loggers: list[MetricLogger] = [CsvLogger(folder, config, resume_step)]
    if backend == "wandb":
        loggers.append(_WandbLogger(folder, config, resume_step, project, name or folder.name, mode))
    elif backend == "tensorboard":
        loggers.append(_TensorboardLogger(folder, resume_step))
    return _Tee(loggers)


def read_curve(folder: str | os.PathLike[str], metric: str) -> list[tuple[int, float]]:
    """The rows ``(step, value)`` of one metric in a run's folder, as written.

    A last row that was cut short by a crash is left out.

    Raises:
        FileNotFoundError: the run has no such metric; the message lists those it has.
    """
    path = _curve_path(Path(folder), metric)
    if not path.is_file():
        known = sorted(str(p.relative_to(path.parents[metric.count("/")]))[:-4] for p in _curves(Path(folder)))
        raise FileNotFoundError(f"{folder} has no curve {metric!r}; it has {', '.join(known) or 'none'}.")
    return [(int(step), float(value)) for step, value in _complete_rows(path)]


class CsvLogger:
    """One file ``scalars/<metric>.csv`` per metric; see :func:`make_logger` for the arguments."""

    def __init__(self, folder: Path, config: Mapping[str, Any], resume_step: int | None) -> None:
        text = json.dumps(config, indent=2, sort_keys=True)
        folder.mkdir(parents=True, exist_ok=True)
        _replace_text(folder / "config.json", text + "\n")
        for path in _curves(folder):
            _drop_rows_after(path, resume_step)
        self._folder = folder
        self._files: dict[str, TextIO] = {}

    def log(self, metrics: Mapping[str, Any], step: int) -> None:
        """Append one row per metric, in one write each: a crash leaves at most one incomplete last row."""
        for name, value in _as_floats(metrics).items():
            if name not in self._files:
                path = _curve_path(self._folder, name)
                path.parent.mkdir(parents=True, exist_ok=True)
                self._files[name] = path.open("a")
            self._files[name].write(f"{step},{value}\n")
            self._files[name].flush()

    def close(self) -> None:
        """Close the files."""
        for file in self._files.values():
            file.close()
        self._files.clear()


class _WandbLogger:
    """Weights & Biases. The run's id is kept in the folder, so a resumed run goes on in the same run."""

    def __init__(
        self, folder: Path, config: Mapping[str, Any], resume_step: int | None, project: str, name: str, mode: str
    ) -> None:
        import wandb

        id_file = folder / "wandb_id.txt"
        if resume_step is None or not id_file.is_file():
            _replace_text(id_file, secrets.token_hex(4) + "\n")
        run_id = id_file.read_text().strip()
        self._run = wandb.init(
            project=project, name=name, id=run_id, resume="allow", dir=folder, config=dict(config), mode=mode
        )
        # Its own step counter cannot go back to the step of a checkpoint, so our step is a metric of its own.
        self._run.define_metric("step")
        self._run.define_metric("*", step_metric="step")

    def log(self, metrics: Mapping[str, Any], step: int) -> None:
        self._run.log({"step": step, **_as_floats(metrics)})

    def close(self) -> None:
        self._run.finish()


class _TensorboardLogger:
    """TensorBoard events; what lies after the resumed step is purged by TensorBoard's own means."""

    def __init__(self, folder: Path, resume_step: int | None) -> None:
        from torch.utils.tensorboard import SummaryWriter

        purge = 0 if resume_step is None else resume_step + 1
        self._writer = SummaryWriter(str(folder / "tensorboard"), purge_step=purge)

    def log(self, metrics: Mapping[str, Any], step: int) -> None:
        for name, value in _as_floats(metrics).items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        self._writer.close()


class _Tee:
    """Writes to several loggers."""

    def __init__(self, loggers: list[MetricLogger]) -> None:
        self._loggers = loggers

    def log(self, metrics: Mapping[str, Any], step: int) -> None:
        metrics = _as_floats(metrics)
        for logger in self._loggers:
            logger.log(metrics, step)

    def close(self) -> None:
        for logger in self._loggers:
            logger.close()


def _as_floats(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Numbers and tensors of one element to floats; a GPU tensor synchronises here."""
    try:
        return {name: float(value) for name, value in metrics.items()}
    except (TypeError, ValueError, RuntimeError) as error:
        kinds = {name: tuple(getattr(value, "shape", ())) or type(value).__name__ for name, value in metrics.items()}
        raise ValueError(f"a metric must be a number or a tensor of one element, got {kinds}: {error}.") from error


def _curve_path(folder: Path, metric: str) -> Path:
    return folder / "scalars" / f"{metric}.csv"


def _curves(folder: Path) -> list[Path]:
    return sorted((folder / "scalars").rglob("*.csv"))


def _complete_rows(path: Path) -> list[list[str]]:
    lines = path.read_text().splitlines(keepends=True)
    return [line.strip().split(",") for line in lines if line.endswith("\n")]


def _drop_rows_after(path: Path, step: int | None) -> None:
    rows = [] if step is None else [row for row in _complete_rows(path) if int(row[0]) <= step]
    if rows:
        _replace_text(path, "".join(f"{row[0]},{row[1]}\n" for row in rows))
    else:
        path.unlink()


def _replace_text(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text)
    os.replace(temporary, path)
