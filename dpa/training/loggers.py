"""Curves, tables and pictures of a run: always as files, and in Weights & Biases or TensorBoard on request.

Curves lie as torchrl's ``CSVLogger`` lays them out, ``<folder>/scalars/<metric>.csv`` with rows ``step,value`` and no
header, so its readers work. Unlike it, a resumed run drops the rows that it is about to write again. A table is
``<folder>/tables/<name>/<step>.csv`` with a header, a picture ``<folder>/pictures/<name>/<step>.png`` (or ``.jpg``).
"""

from __future__ import annotations

import csv
import importlib.util
import io
import json
import os
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TextIO

from dpa.training.exhibits import Picture, Table, as_markdown, as_table, read_picture
from envs.files import write_bytes

Backend = Literal["csv", "wandb", "tensorboard"]
MODULES = {"wandb": "wandb", "tensorboard": "tensorboard"}
"""The package that each further backend needs."""
PROJECT = "dpa-omf"
"""Where runs are in Weights & Biases."""

Curve = list[tuple[int, float]]
"""Rows ``(step, value)``."""


class MetricLogger:
    """Where a run's numbers, tables and pictures go: to every backend, checked once.

    Args:
        backends: files first.
    """

    def __init__(self, *backends: _Files | _Wandb | _Tensorboard) -> None:
        self._backends = backends

    def log(self, metrics: Mapping[str, Any], step: int) -> None:
        """Write numbers or tensors of one element, named ``"<group>/<metric>"``, for one step."""
        metrics = _as_floats(metrics)
        for backend in self._backends:
            backend.log(metrics, step)

    def table(self, name: str, header: Sequence[str], rows: Sequence[Sequence[Any]], step: int) -> None:
        """Write a table.

        Args:
            name: ``"<group>/<table>"``.
            header: names of the columns.
            rows: cells are texts, numbers, tensors of one element, or None for what is not known.
            step: that the table is about.

        Raises:
            ValueError: no table.
        """
        table = as_table(name, header, rows)
        for backend in self._backends:
            backend.table(table, step)

    def picture(self, name: str, path: str | os.PathLike[str], step: int) -> None:
        """Write a picture.

        Args:
            name: ``"<group>/<picture>"``.
            path: of a PNG or JPEG file.
            step: that the picture is about.

        Raises:
            ValueError: no picture.
        """
        picture = read_picture(name, path)
        for backend in self._backends:
            backend.picture(picture, step)

    def close(self) -> None:
        """Flush and close; a closed logger is not used again."""
        for backend in self._backends:
            backend.close()


def make_logger(
    backend: Backend,
    folder: str | os.PathLike[str],
    config: Mapping[str, Any],
    *,
    resume_step: int | None = None,
    name: str | None = None,
    mode: Literal["online", "offline"] = "offline",
) -> MetricLogger:
    """Open the curves, tables and pictures of a run.

    Files are always written; ``backend`` says where else the same goes.

    Args:
        backend: ``"csv"``, ``"wandb"`` or ``"tensorboard"``.
        folder: the run's folder. ``config.json`` in it records ``config``.
        config: the run's configuration, plain dicts, lists, numbers and strings.
        resume_step: the step of the checkpoint that the run goes on from: numbers of later steps are dropped. ``None``
            for a new run, which drops all of an earlier run in the folder.
        name: of the run in Weights & Biases; the folder's name by default.
        mode: of Weights & Biases; ``"offline"`` keeps the run in ``folder`` and sends nothing.

    Raises:
        ValueError: an unknown backend.
        ImportError: the backend's package is missing; the message says what to install.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     logger = make_logger("csv", folder, {"lr": 1e-3})
        ...     logger.log({"train/loss": 0.5}, step=1)
        ...     logger.table("eval/methods", ["method", "realism"], [["reference", 0.7]], step=1)
        ...     logger.close()
        ...     read_curve(Path(folder), "train/loss")
        ...     Path(folder, "tables", "eval", "methods", "1.csv").read_text().splitlines()
        [(1, 0.5)]
        ['method,realism', 'reference,0.7']
    """
    check_backend(backend)
    folder = Path(folder)
    files = _Files(folder, config, resume_step)
    if backend == "wandb":
        return MetricLogger(files, _Wandb(folder, config, resume_step, name or folder.name, mode))
    if backend == "tensorboard":
        return MetricLogger(files, _Tensorboard(folder, resume_step))
    return MetricLogger(files)


def check_backend(backend: str) -> None:
    """Refuse a backend that cannot be used.

    Raises:
        ValueError: an unknown backend.
        ImportError: the backend's package is missing; the message says what to install.
    """
    if backend not in ("csv", *MODULES):
        raise ValueError(f"logger.backend must be csv, wandb or tensorboard, got {backend!r}.")
    if backend in MODULES and importlib.util.find_spec(MODULES[backend]) is None:
        raise ImportError(
            f"logger.backend={backend} needs the package {MODULES[backend]!r}: install it "
            f"(pip install {MODULES[backend]}) or choose logger.backend=csv."
        )


def read_curve(folder: str | os.PathLike[str], metric: str) -> Curve:
    """One of :func:`read_curves`.

    Raises:
        FileNotFoundError: the run has no such metric; the message lists those it has.
        ValueError: see :func:`read_curves`.
    """
    path = _curve_path(Path(folder), metric)
    if not path.is_file():
        known = ", ".join(_curves(Path(folder))) or "none"
        raise FileNotFoundError(f"{folder} has no curve {metric!r}; it has {known}.")
    return _rows(path)


def read_curves(folder: str | os.PathLike[str]) -> dict[str, Curve]:
    """All curves in a run's folder by metric, in order of name, as written; torchrl's ``CSVLogger`` writes the same.

    A last row that was cut short by a crash is left out.

    Raises:
        ValueError: a row that is not ``step,value``; the message names file and line.
    """
    return {metric: _rows(path) for metric, path in _curves(Path(folder)).items()}


class _Files:
    """One file for each metric, table and picture; see :func:`make_logger` for the arguments."""

    def __init__(self, folder: Path, config: Mapping[str, Any], resume_step: int | None) -> None:
        text = json.dumps(config, indent=2, sort_keys=True)
        folder.mkdir(parents=True, exist_ok=True)
        write_bytes(folder / "config.json", f"{text}\n".encode())
        for path in _curves(folder).values():
            _drop_rows_after(path, resume_step)
        for path in _exhibits(folder) if resume_step is None else ():
            path.unlink()
        self._folder = folder
        self._files: dict[str, TextIO] = {}

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        """Append one row per metric, in one write each: a crash leaves at most one incomplete last row."""
        for name, value in metrics.items():
            if name not in self._files:
                path = _curve_path(self._folder, name)
                path.parent.mkdir(parents=True, exist_ok=True)
                self._files[name] = path.open("a")
            self._files[name].write(f"{step},{value}\n")
            self._files[name].flush()

    def table(self, table: Table, step: int) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([table.header, *table.rows])
        self._keep("tables", table.name, f"{step}.csv", text.getvalue().encode())

    def picture(self, picture: Picture, step: int) -> None:
        self._keep("pictures", picture.name, f"{step}.{picture.suffix}", picture.content)

    def _keep(self, kind: str, name: str, file: str, content: bytes) -> None:
        folder = self._folder / kind / name
        folder.mkdir(parents=True, exist_ok=True)
        write_bytes(folder / file, content)

    def close(self) -> None:
        for file in self._files.values():
            file.close()
        self._files.clear()


class _Wandb:
    """Weights & Biases. The run's id is kept in the folder, so a resumed run goes on in the same run."""

    def __init__(self, folder: Path, config: Mapping[str, Any], resume_step: int | None, name: str, mode: str) -> None:
        import wandb

        id_file = folder / "wandb_id.txt"
        if resume_step is None or not id_file.is_file():
            write_bytes(id_file, f"{secrets.token_hex(4)}\n".encode())
        run_id = id_file.read_text().strip()
        self._run = wandb.init(
            project=PROJECT, name=name, id=run_id, resume="allow", dir=folder, config=dict(config), mode=mode
        )
        # Its own step counter cannot go back to the step of a checkpoint, so our step is a metric of its own.
        self._run.define_metric("step")
        self._run.define_metric("*", step_metric="step")

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        self._run.log({"step": step, **metrics})

    def table(self, table: Table, step: int) -> None:
        from wandb import Table as WandbTable

        shown = WandbTable(columns=table.header, data=table.rows, allow_mixed_types=True)
        self._run.log({"step": step, table.name: shown})

    def picture(self, picture: Picture, step: int) -> None:
        from wandb import Image

        self._run.log({"step": step, picture.name: Image(picture.pixels)})

    def close(self) -> None:
        self._run.finish()


class _Tensorboard:
    """TensorBoard events; what lies after the resumed step is purged by TensorBoard's own means."""

    def __init__(self, folder: Path, resume_step: int | None) -> None:
        from torch.utils.tensorboard import SummaryWriter

        purge = 0 if resume_step is None else resume_step + 1
        self._writer = SummaryWriter(str(folder / "tensorboard"), purge_step=purge)

    def log(self, metrics: Mapping[str, float], step: int) -> None:
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)

    def table(self, table: Table, step: int) -> None:
        self._writer.add_text(table.name, as_markdown(table), step)

    def picture(self, picture: Picture, step: int) -> None:
        self._writer.add_image(picture.name, picture.pixels, step, dataformats="HWC")

    def close(self) -> None:
        self._writer.close()


def _as_floats(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Numbers and tensors of one element to floats; a GPU tensor synchronises here."""
    try:
        return {name: float(value) for name, value in metrics.items()}
    except (TypeError, ValueError, RuntimeError) as error:
        kinds = {name: tuple(getattr(value, "shape", ())) or type(value).__name__ for name, value in metrics.items()}
        raise ValueError(f"a metric must be a number or a tensor of one element, got {kinds}: {error}.") from error


def _curve_path(folder: Path, metric: str) -> Path:
    return folder / "scalars" / f"{metric}.csv"


def _curves(folder: Path) -> dict[str, Path]:
    scalars = folder / "scalars"
    return {path.relative_to(scalars).as_posix()[:-4]: path for path in sorted(scalars.rglob("*.csv"))}


def _exhibits(folder: Path) -> list[Path]:
    found = [*(folder / "tables").rglob("*"), *(folder / "pictures").rglob("*")]
    return sorted(path for path in found if path.is_file() and path.stem.isdigit())


def _rows(path: Path) -> Curve:
    rows = []
    for line, row in enumerate(_complete_rows(path), start=1):
        try:
            step, value = row
            rows.append((int(step), float(value)))
        except ValueError as error:
            raise ValueError(f"{path}:{line}: expected 'step,value', got {','.join(row)!r}.") from error
    return rows


def _complete_rows(path: Path) -> list[list[str]]:
    """Rows of a curve's file, without a last one that a kill cut short."""
    lines = path.read_text().splitlines(keepends=True)
    return [line.strip().split(",") for line in lines if line.endswith("\n")]


def _drop_rows_after(path: Path, step: int | None) -> None:
    try:
        rows = [] if step is None else [row for row in _complete_rows(path) if int(row[0]) <= step]
    except ValueError as error:
        raise ValueError(f"{path} is no curve ({error}); remove it and run again.") from None
    if rows:
        write_bytes(path, "".join(f"{row[0]},{row[1]}\n" for row in rows).encode())
    else:
        path.unlink()
