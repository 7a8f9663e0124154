"""Tables of a study, told once: printed for who waits, and kept as numbers for who comes later."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from omegaconf import DictConfig
from rich import table as rich_table
from rich.console import Console

from dpa.report.statistics import Interval, summary
from dpa.report.table import MISSING
from dpa.training.loggers import make_logger
from recipes.common.cli import plain

Cell = float | Interval | str | None
"""A number, a mean with its interval, words, or None for what is not known."""


def over_scenes(values: Sequence[float | None]) -> Interval | None:
    """The mean over those scenes that have a value, with its interval; None where none has.

    Examples:
        >>> over_scenes([0.25, None, 0.75]).mean, over_scenes([None])
        (0.5, None)
    """
    known = [value for value in values if value is not None]
    return summary([known]) if known else None


def minus(values: Sequence[float | None], others: Sequence[float | None]) -> list[float | None]:
    """Scene by scene; in one that has no value neither has.

    Examples:
        >>> minus([0.75, None], [0.25, None])
        [0.5, None]
    """
    return [None if one is None else one - other for one, other in zip(values, others, strict=True)]


def compared(
    name: str,
    title: str,
    columns: Sequence[str],
    found: Mapping[str, Mapping[str, Sequence[float | None]]],
    pairs: Mapping[str, str],
    first: str,
) -> Iterator[StudyTable]:
    """Rows of a value per scene with intervals, and some minus the row that ``pairs`` names, which is of ``first``."""
    rows = {row: [over_scenes(figures[each]) for each in columns[1:]] for row, figures in found.items()}
    yield StudyTable(name, title, columns, rows, signed=False)
    if pairs:
        less = {
            row: [over_scenes(minus(found[row][each], found[other][each])) for each in columns[1:]]
            for row, other in pairs.items()
        }
        yield StudyTable(f"{name}_difference", f"minus {first}, scene by scene", columns, less)


@dataclass(frozen=True)
class StudyTable:
    """What a study found, row by row.

    Attributes:
        name: in the logs.
        title: above the table.
        columns: titles; the first is that of the rows' names.
        rows: by name, a cell for each further column.
        signed: cells are differences or correlations and are printed with their sign.

    Examples:
        >>> near = Interval(0.04, 0.03, 0.05, over="scenes", num_seeds=1, num_scenes=24)
        >>> table = StudyTable("rankings", "24 scenes", ["ranking", "nearest"], {"omf": [near]})
        >>> table.printed(), table.kept()[1]
        ([['omf', '+0.040 [+0.030, +0.050]']], [['omf', 0.04, 0.03, 0.05]])
        >>> dict(table.numbers())
        {'rankings/nearest/omf': 0.04, 'rankings/nearest_low/omf': 0.03, 'rankings/nearest_high/omf': 0.05}
    """

    name: str
    title: str
    columns: Sequence[str]
    rows: Mapping[str, Sequence[Cell]]
    signed: bool = True

    def printed(self) -> list[list[str]]:
        """Cells as text, three digits."""
        sign = "+" if self.signed else ""
        return [[name, *(_text(cell, sign) for cell in cells)] for name, cells in self.rows.items()]

    def kept(self) -> tuple[list[str], list[list[str | float | None]]]:
        """Header and rows as numbers and words; where a column has intervals their ends are columns of their own."""
        titles, rows = [self.columns[0]], [[name] for name in self.rows]
        for title, column in zip(self.columns[1:], zip(*self.rows.values(), strict=True), strict=True):
            wide = any(isinstance(cell, Interval) for cell in column)
            titles += [title, f"{title} low", f"{title} high"] if wide else [title]
            for row, cell in zip(rows, column, strict=True):
                row += _ends(cell) if wide else [cell]
        return titles, rows

    def numbers(self) -> Iterator[tuple[str, float]]:
        """Every number that is known, as ``("<table>/<column>/<row>", value)``, in names that all loggers take."""
        titles, rows = self.kept()
        for column, title in enumerate(titles[1:], 1):
            for row in rows:
                if isinstance(row[column], int | float):
                    yield f"{self.name}/{_as_name(title)}/{_as_name(row[0])}", row[column]


def tell(cfg: DictConfig, tables: Sequence[StudyTable], pictures: Mapping[str, Path]) -> None:
    """Print the tables of a finished study, and log them with their numbers and its pictures.

    Args:
        cfg: with ``logger`` and ``output``, the folder of the study; the logs lie there.
        tables: of the study.
        pictures: files by the names that they have in the logs.
    """
    folder = Path(cfg.output)
    logs = make_logger(cfg.logger.backend, folder, plain(cfg), name=folder.name, mode=cfg.logger.mode)
    with closing(logs) as logger:
        for table in tables:
            _print(table)
            logger.table(f"{table.name}/table", *table.kept(), 0)
            logger.log(dict(table.numbers()), 0)
        for name, picture in pictures.items():
            logger.picture(name, picture, 0)


def _print(table: StudyTable) -> None:
    shown = rich_table.Table(*table.columns, title=table.title)
    for row in table.printed():
        shown.add_row(*row)
    Console(markup=False, width=190 if len(table.columns) > 5 else 140).print(shown)


def _as_name(title: str) -> str:
    return re.sub(r"[^-\w.]+", "_", title).strip("_")


def _text(cell: Cell, sign: str) -> str:
    if cell is None:
        return MISSING
    if isinstance(cell, str):
        return cell
    numbers = (cell.mean, cell.low, cell.high) if isinstance(cell, Interval) else (cell,)
    mean, *ends = (f"{number:{sign}.3f}" for number in numbers)
    return f"{mean} [{', '.join(ends)}]" if ends else mean


def _ends(cell: Cell) -> list[float | str | None]:
    if isinstance(cell, Interval):
        return [cell.mean, cell.low, cell.high]
    return [cell, None, None]
