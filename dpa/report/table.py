"""The results table: that of the paper, safety rates and the paired difference, for terminal, document and page."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.segment import Segments
from rich.table import Table

REFERENCE = "reference"
"""Method name of the model before alignment."""
MISSING = "\N{EN DASH}"
"""Stands for a number that was not measured."""
MINUS = "\N{MINUS SIGN}"
ROUNDING = 1e-12
"""A difference below this is none: it is what sums of floats leave."""


class Column(NamedTuple):
    """A measure of a row.

    Attributes:
        key: in a row of the comparison.
        title: of the column.
        digits: after the point.
        better: an arrow up or down: where better values lie.
    """

    key: str
    title: str
    digits: int
    better: str


COLUMNS = (
    Column("kinematic", "kinematic", 3, "↑"),
    Column("interactive", "interactive", 3, "↑"),
    Column("map_based", "map", 3, "↑"),
    Column("realism", "realism", 3, "↑"),
    Column("min_ade", "minADE", 3, "↓"),
    Column("collision_rate", "collision", 3, "↓"),
    Column("offroad_rate", "off-road", 3, "↓"),
    Column("preference_distance", "distance", 2, "↓"),
    Column("pair_accuracy", "pair acc.", 3, "↑"),
)
"""Measures in the order of table 1 of the paper, then safety, then the preference distance and table 3's accuracy."""

DIFFERENCE_TITLE = "Δ realism [95 %]"
IDENTITY = ("method", "seed", "top_p", "temperature", "file", "n_scenes")
"""Entries of a row that are no measures."""


def summarise(rows: Sequence[Mapping[str, Any]], paired: Sequence[Mapping[str, Any]] = ()) -> list[dict[str, Any]]:
    """One record for each method and decoding: means over seeds, with the paired difference beside them.

    Args:
        rows: the comparison's rows; a measure may be None or absent, ``top_p``, ``temperature`` and ``seed`` too.
        paired: the comparison's paired differences; an entry with a ``top_p`` or a ``temperature`` belongs to that
            decoding only.

    Returns:
        Records ``{"method", "top_p", "temperature", "n_seeds", "n_scenes", <every COLUMNS key and measure of a row>,
        "realism_difference", "ci95", "over"}`` in the order of first appearance. A mean over seeds of which one has no
        value is None.

    Raises:
        ValueError: a NaN, or a paired entry that fits no record or several.

    Examples:
        >>> rows = [{"method": "reference", "seed": seed, "realism": 0.70 + 0.02 * seed} for seed in range(2)]
        >>> record = summarise(rows)[0]
        >>> round(record["realism"], 3), record["n_seeds"], record["pair_accuracy"]
        (0.71, 2, None)
    """
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["method"], row.get("top_p"), row.get("temperature")), []).append(row)
    measures = dict.fromkeys([column.key for column in COLUMNS] + [key for row in rows for key in row])
    records = []
    for (method, top_p, temperature), members in groups.items():
        record = {"method": method, "top_p": top_p, "temperature": temperature, "n_seeds": len(members)}
        record["n_scenes"] = members[0].get("n_scenes")
        for key in measures:
            if key not in IDENTITY:
                record[key] = _mean([row.get(key) for row in members], method, key)
        records.append(record | {"realism_difference": None, "ci95": None, "over": None})
    for entry in paired:
        record = _owner(entry, records)
        record |= {"ci95": list(entry["ci95"])} | {name: entry[name] for name in ("realism_difference", "over")}
    return records


def measured(records: Sequence[Mapping[str, Any]], keys: Iterable[str]) -> list[str]:
    """Those measures that some record has a value of.

    Examples:
        >>> measured([{"realism": 0.7, "min_ade": None}], ["realism", "min_ade", "spread"])
        ['realism']
    """
    return [key for key in keys if any(record.get(key) is not None for record in records)]


def header(records: Sequence[dict[str, Any]]) -> list[str]:
    """Titles of the columns that :func:`cells` fills."""
    measures = [f"{column.title} {column.better}" for column in COLUMNS]
    return ["method", *(title for title, _ in _decoding(records)), "seeds", *measures, DIFFERENCE_TITLE]


def cells(records: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Records of :func:`summarise` as text, missing values as a dash.

    Examples:
        >>> cells(summarise([{"method": "reference", "realism": 0.7}]))[0][:6]
        ['reference', '1', '–', '–', '–', '0.700']
    """
    decoding = _decoding(records)
    return [
        [
            record["method"],
            *(_setting(record[key]) for _, key in decoding),
            str(record["n_seeds"]),
            *(number(record[column.key], column.digits) for column in COLUMNS),
            difference(record["realism_difference"], record["ci95"]),
        ]
        for record in records
    ]


def number(value: float | None, digits: int) -> str:
    """A value with fixed digits, or a dash.

    Examples:
        >>> number(0.7394, 3), number(None, 3)
        ('0.739', '–')
    """
    return MISSING if value is None else f"{value:.{digits}f}".replace("-", MINUS)


def signed(value: float, digits: int = 3) -> str:
    """A difference with its sign, also where it rounds to zero: on which side a bound lies decides what may be said.

    Examples:
        >>> signed(0.0123), signed(-0.0001), signed(-1e-16)
        ('+0.012', '−0.000', '0.000')
    """
    return f"{0:.{digits}f}" if abs(value) < ROUNDING else f"{value:+.{digits}f}".replace("-", MINUS)


def difference(mean: float | None, interval: Sequence[float] | None, digits: int = 3) -> str:
    """A paired difference and its interval, or a dash.

    Examples:
        >>> difference(0.012, [0.003, 0.021])
        '+0.012 [+0.003, +0.021]'
    """
    if mean is None or interval is None:
        return MISSING
    return f"{signed(mean, digits)} [{signed(interval[0], digits)}, {signed(interval[1], digits)}]"


def duration(seconds: float) -> str:
    """A time span for people, in its two largest units.

    Examples:
        >>> duration(4321), duration(59.6), duration(0.25)
        ('1 h 12 min', '1 min 0 s', '0.2 s')
    """
    if seconds < 10:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def to_rich(
    rows: Sequence[dict[str, Any]], paired: Sequence[dict[str, Any]] = (), *, title: str | None = None
) -> Table:
    """The table for a terminal; the arguments are those of :func:`summarise`."""
    records = summarise(rows, paired)
    table = Table(title=title, title_justify="left", header_style="bold", box=SIMPLE_HEAD, padding=(0, 1))
    for name in header(records):
        table.add_column(name, justify="left" if name == "method" else "right", no_wrap=True)
    for row in cells(records):
        table.add_row(*row)
    return table


def print_table(
    rows: Sequence[dict[str, Any]],
    paired: Sequence[dict[str, Any]] = (),
    *,
    title: str | None = None,
) -> None:
    """Print the table.

    Args:
        rows: see :func:`summarise`.
        paired: see :func:`summarise`.
        title: above the table.
    """
    print_whole(to_rich(rows, paired, title=title), Console(markup=False))


def print_whole(table: Table, console: Console) -> None:
    """Print a table without folding cells: numbers over two lines are misread, and terminals wrap or scroll lines."""
    options = console.options.update(width=1_000)
    options = options.update(width=console.measure(table, options=options).maximum)
    console.print(Segments(console.render(table, options)), crop=False, soft_wrap=True, end="")


def to_markdown(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in GitHub's Markdown; what is in no first column is set to the right.

    Examples:
        >>> print(to_markdown(["method", "realism"], [["reference", "0.700"]]))
        | method | realism |
        | --- | ---: |
        | reference | 0.700 |
    """
    lines = [titles, ["---", *["---:"] * (len(titles) - 1)], *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _setting(value: float | None) -> str:
    """An option with two digits, or as many as it needs: two that differ must not look alike."""
    return number(value, 2) if value is None or round(value, 2) == value else f"{value:g}"


def _decoding(records: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Titles and keys of what is told of the decoding; a temperature of 1 is not."""
    told = {"top-p": ("top_p", {None}), "temperature": ("temperature", {None, 1.0})}
    return [(title, key) for title, (key, plain) in told.items() if {record[key] for record in records} - plain]


def mean_over_seeds(values: Sequence[float | None]) -> float | None:
    """The mean, or None where a seed lacks a value: means over some of them would stand beside means over all.

    Examples:
        >>> mean_over_seeds([0.5, 0.7]), mean_over_seeds([0.5, None])
        (0.6, None)
    """
    return None if not values or None in values else math.fsum(values) / len(values)


def _mean(values: list[float | None], method: str, key: str) -> float | None:
    if any(value is not None and math.isnan(value) for value in values):
        raise ValueError(f"{method}: {key} is NaN in one of its rows; write None where nothing was measured.")
    return mean_over_seeds(values)


def _owner(entry: Mapping[str, Any], records: list[dict[str, Any]]) -> dict[str, Any]:
    names = ("method", "top_p", "temperature")
    found = [record for record in records if all(entry.get(name, record[name]) == record[name] for name in names)]
    if len(found) != 1:
        raise ValueError(
            f"the paired difference of {entry['method']!r} (top_p {entry.get('top_p')}, temperature "
            f"{entry.get('temperature')}) fits {len(found)} of the table's rows; it must name the method, and the "
            "decoding where the method has several."
        )
    return found[0]
