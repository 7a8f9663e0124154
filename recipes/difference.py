"""How one method of an experiment differs from another in every measure, paired by seed and scene.

    python -m recipes.difference RUNS EXPERIMENT METHOD OTHER

RUNS is the folder that recipes.compare fills (its output), or an archive of one, unpacked. Each method stands at its
own best decoding, or at those that are given. From the values of every scene: nothing is run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from dpa.report.experiment import Decoding, Experiment, decoding_of, in_words, read_experiment
from dpa.report.paired import Rows, paired_values
from dpa.report.statistics import Interval, paired_bootstrap
from dpa.report.study import Evaluations
from recipes.common.cli import refused


class Difference(NamedTuple):
    """A measure of two methods, over the scenes where both have a value under all seeds.

    Attributes:
        measure: as the files of results call it.
        mine: mean of the one.
        other: mean of the other.
        interval: of the one minus the other.
        ahead: seeds in which the one has the higher mean.
    """

    measure: str
    mine: float
    other: float
    interval: Interval
    ahead: int


def differences(
    experiment: Experiment, method: str, other: str, evaluations: Evaluations, at: Sequence[Decoding] = ()
) -> Iterator[Difference]:
    """Every measure of an evaluation, and the likelihoods of the same policies, of one method minus another.

    Args:
        experiment: that has both.
        method: the one.
        other: what it is compared with.
        evaluations: figures of every scene.
        at: decoding of both, or one of each; by default each at its own best.

    Raises:
        ValueError: a method, or a decoding of it, that was not evaluated (the message names those that were), or a file
            of values that is not there.
    """
    own = (experiment.chosen.get(method), experiment.chosen.get(other))
    decodings = {0: own, 1: (*at, *at), 2: at}[len(at)]
    evaluated = [_rows(experiment, *side) for side in zip((method, other), decodings, strict=True)]
    for rows in evaluated:
        _check_files(rows, evaluations)
    policies = {Path(row["file"]).parent for rows in evaluated for row in rows}  # a method may have several checkpoints
    kept = [row for row in experiment.likelihood if Path(row["file"]).parent in policies]
    likely = [[row for row in kept if row["method"] == name] for name in (method, other)]
    for mine, base in (evaluated, likely):
        measures = evaluations(mine[0]["file"]) if mine else None
        for measure in measures or ():
            both = paired_values(mine, base, measure, evaluations)
            if both is not None:
                ahead = int((both[0].mean(-1) > both[1].mean(-1)).sum())
                yield Difference(measure, both[0].mean(), both[1].mean(), paired_bootstrap(*both), ahead)


def _rows(experiment: Experiment, method: str, decoding: Decoding | None) -> Rows:
    everywhere = [*experiment.own_best.rows, *experiment.at_common.rows]
    if decoding is None or method not in experiment.methods:
        raise ValueError(f"{experiment.name} has no method {method!r}; it has {', '.join(experiment.methods)}.")
    found = {row["seed"]: row for row in everywhere if row["method"] == method and decoding_of(row) == decoding}
    if not found:
        known = sorted({decoding_of(row) for row in everywhere if row["method"] == method})
        raise ValueError(
            f"{method} was not evaluated at {in_words(decoding)}, but at {'; '.join(map(in_words, known))}: say --at "
            f"{' '.join(f'{top_p:g},{temperature:g}' for top_p, temperature in known[:1])}."
        )
    return [found[seed] for seed in sorted(found)]


def _check_files(rows: Rows, evaluations: Evaluations) -> None:
    lost = next((row["file"] for row in rows if evaluations(row["file"]) is None), None)
    if lost is not None:
        raise ValueError(
            f"{evaluations.folder / lost} is not there, and it holds the values of every scene; put it back."
        )


def decoding(text: str) -> Decoding:
    """Read a decoding from the command line.

    Examples:
        >>> decoding("0.95,1")
        (0.95, 1.0)
    """
    try:
        top_p, temperature = map(float, text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no TOP_P,TEMPERATURE; say for example 0.95,1") from None
    return top_p, temperature


def make_parser() -> argparse.ArgumentParser:
    """Arguments of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m recipes.difference", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", metavar="RUNS", type=Path, help="folder of results")
    parser.add_argument("experiment", metavar="EXPERIMENT", help="name of it, such as methods")
    parser.add_argument("method", metavar="METHOD", help="such as dpa_omf")
    parser.add_argument("other", metavar="OTHER", nargs="?", default="reference", help="by default the reference")
    parser.add_argument(
        "--at", metavar="TOP_P,T", type=decoding, nargs="+", default=[], help="decoding of both, or one of each"
    )
    return parser


def main() -> None:
    """Entry point of ``python -m recipes.difference``."""
    given = make_parser().parse_args()
    try:
        path = given.runs / "experiments" / f"{given.experiment}.json"
        if not path.is_file():
            known = ", ".join(sorted(each.stem for each in path.parent.glob("*.json"))) or "none"
            raise ValueError(f"{given.runs} has no experiment {given.experiment!r}; it has {known}.")
        if len(given.at) > 2:
            raise ValueError(f"--at takes one decoding for both, or one of each, got {len(given.at)}.")
        experiment = read_experiment(path)
        found = list(differences(experiment, given.method, given.other, Evaluations(given.runs), given.at))
        if not found:
            raise ValueError(f"{given.method} and {given.other} of {path} have no seed and scene in common.")
    except (ValueError, OSError) as error:
        sys.exit(refused(error))
    _print(found, given.method, given.other)


def _print(found: Sequence[Difference], method: str, other: str) -> None:
    table = Table(title=f"{method} minus {other}", title_justify="left")
    for title in ("measure", method, other, "difference [95 %]", "higher in seeds", "scenes"):
        table.add_column(title, justify="left" if title == "measure" else "right")
    for each in found:
        between = each.interval
        change = f"{between.mean:+.4f} [{between.low:+.4f}, {between.high:+.4f}]"
        seeds = f"{each.ahead} of {between.num_seeds}"
        numbers = (f"{each.mine:.4f}", f"{each.other:.4f}", change, seeds, str(between.num_scenes))
        table.add_row(each.measure, *numbers, style="bold" if between.excludes_zero else None)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
