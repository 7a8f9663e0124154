"""How one method of an experiment, or one evaluation, differs from another in every measure, paired by seed and scene.

    python -m recipes.difference RUNS EXPERIMENT METHOD OTHER
    python -m recipes.difference EVALUATION OTHER

RUNS is the folder that recipes.compare fills (its output), or an archive of one, unpacked. Each method stands at its
own best decoding, or at those that are given. OTHER may be of another experiment of the same folder, NAME:METHOD, or a
rung of recipes.ladder on the same scenes, LADDER/log_through_tokens.json, which is the same under every seed.
EVALUATION is what recipes.evaluate writes, a JSON, or a folder with one for each seed. From the values of every scene:
nothing is run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from dpa.report.experiment import Decoding, Experiment, decoding_of, in_words, read_experiment, read_json
from dpa.report.paired import Evaluated, Rows, paired_values
from dpa.report.statistics import Interval, paired_bootstrap
from dpa.report.study import Evaluations
from dpa.report.table import print_whole
from recipes.common.cli import refused
from recipes.studies.laddered import read_rung

COMPARED = ("scenes", "evaluation", "ranking")
"""Options that two evaluations must share to be compared."""


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


class Side(NamedTuple):
    """A method of an experiment."""

    experiment: Experiment
    method: str


def differences(side: Side, other: Side, evaluations: Evaluations, at: Sequence[Decoding] = ()) -> Iterator[Difference]:
    """Every measure of an evaluation, and the likelihoods of the same policies, of one method minus another.

    Args:
        side: the one.
        other: what it is compared with, of the same folder and scenes.
        evaluations: figures of every scene.
        at: decoding of both, or one of each; by default each at its own best.

    Raises:
        ValueError: a method, or a decoding of it, that was not evaluated (the message names those that were), a file of
            values that is not there, or values of other scenes.
    """
    both = (side, other)
    if side.experiment.split != other.experiment.split:
        told = " and ".join(f"{experiment.name} on {experiment.reported}" for experiment, _ in both)
        raise ValueError(f"scenes are paired, and these are others: {told}; compare methods of one of the two.")
    own = tuple(experiment.chosen.get(method) for experiment, method in both)
    decodings = {0: own, 1: (*at, *at), 2: at}[len(at)]
    evaluated = [_rows(*each, decoding) for each, decoding in zip(both, decodings, strict=True)]
    for rows in evaluated:
        _check_files(rows, evaluations)
    likely = [_likely(*each, rows) for each, rows in zip(both, evaluated, strict=True)]
    for mine, base in (evaluated, likely):
        yield from _measures(mine, base, evaluations)


def differences_to_rung(
    side: Side, rung: Path, evaluations: Evaluations, at: Decoding | None = None
) -> Iterator[Difference]:
    """Every measure that a rung of a ladder has, of one method minus it.

    Args:
        side: the method.
        rung: file of the rung, which stands beside each seed of the method.
        evaluations: figures of every scene.
        at: decoding of the method; by default its own best.

    Raises:
        ValueError: as of :func:`differences`, or a rung of other scenes, rollouts or metric.
    """
    rows = _rows(*side, at or side.experiment.chosen.get(side.method))
    _check_files(rows, evaluations)
    values = read_rung(rung, {f"{side.method} of seed {row['seed']}": evaluations.folder / row["file"] for row in rows})
    beside = [{"seed": row["seed"], "file": str(rung)} for row in rows]
    yield from _measures(rows, beside, lambda file: values if file == str(rung) else evaluations(file))


def differences_of_files(evaluation: Path, other: Path) -> Iterator[Difference]:
    """Every measure of one evaluation, or of one for each seed, minus another.

    Args:
        evaluation: a JSON of ``recipes.evaluate``, or a folder with several of as many seeds.
        other: likewise, of the same scenes and seeds.

    Raises:
        ValueError: no such file, two of one seed, or evaluations of other seeds, scenes, metric, rollouts or ranking.
    """
    sides = [_read_seeds(path) for path in (evaluation, other)]
    if sides[0].keys() != sides[1].keys():
        mine, base = (", ".join(map(str, side)) for side in sides)
        raise ValueError(
            f"{evaluation} has seeds {mine} and {other} has seeds {base}; evaluate both with the same `seed`s."
        )
    for seed, mine in sides[0].items():
        base = sides[1][seed]
        for name in COMPARED:
            if mine.options[name] != base.options[name]:
                raise ValueError(
                    f"{mine.file} and {base.file} were evaluated with other {name!r}, {mine.options[name]} and "
                    f"{base.options[name]}; evaluate both with the same."
                )
    rows = [[{"seed": seed, "file": str(each.file.absolute())} for seed, each in side.items()] for side in sides]
    yield from _measures(*rows, Evaluations(Path()))


class _Evaluation(NamedTuple):
    """A result of ``recipes.evaluate``, and what it was made with."""

    file: Path
    options: Mapping[str, Any]


def _read_seeds(path: Path) -> dict[int, _Evaluation]:
    """Evaluations by seed, in its order."""
    files = sorted(path.glob("*.json")) if path.is_dir() else [path]
    found: dict[int, _Evaluation] = {}
    for file in files:
        content = read_json(file) if file.is_file() else None
        if not isinstance(content, dict) or not {"per_scene", "options"} <= content.keys():
            raise ValueError(
                f"{file} is no evaluation that recipes.evaluate wrote; for two methods of an experiment say RUNS "
                "EXPERIMENT METHOD."
            )
        if lacks := sorted({"seed", *COMPARED} - content["options"].keys()):
            raise ValueError(
                f"{file} is no evaluation that recipes.evaluate wrote: its options lack {', '.join(lacks)}; "
                "likelihoods of two methods of an experiment are compared by RUNS EXPERIMENT METHOD."
            )
        seed = content["options"]["seed"]
        if seed in found:
            raise ValueError(f"{found[seed].file} and {file} are both of seed {seed}; give a folder with one for each.")
        found[seed] = _Evaluation(file, content["options"])
    if not found:
        raise ValueError(f"{path} has no evaluation, a file NAME.json that recipes.evaluate writes.")
    return dict(sorted(found.items()))


def _measures(mine: Rows, base: Rows, evaluations: Evaluated) -> Iterator[Difference]:
    both_have = {row["seed"] for row in mine} & {row["seed"] for row in base}
    mine, base = ([row for row in rows if row["seed"] in both_have] for rows in (mine, base))
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


def _likely(experiment: Experiment, method: str, rows: Rows) -> Rows:
    """Rows of likelihood of the same policies: a method may have several checkpoints."""
    policies = {Path(row["file"]).parent for row in rows}
    return [row for row in experiment.likelihood if row["method"] == method and Path(row["file"]).parent in policies]


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
    parser.add_argument("runs", metavar="RUNS", type=Path, help="folder of results, or an evaluation")
    parser.add_argument("experiment", metavar="EXPERIMENT", help="name of it, such as methods, or another evaluation")
    parser.add_argument("method", metavar="METHOD", nargs="?", help="such as dpa_omf; none with two evaluations")
    parser.add_argument(
        "other",
        metavar="OTHER",
        nargs="?",
        default="reference",
        help="by default the reference; NAME:METHOD of another experiment; a rung's file, LADDER/log.json",
    )
    parser.add_argument(
        "--at", metavar="TOP_P,T", type=decoding, nargs="+", default=[], help="decoding of both, or one of each"
    )
    return parser


def main() -> None:
    """Entry point of ``python -m recipes.difference``."""
    given = make_parser().parse_args()
    try:
        if given.method is None:
            if given.at:
                raise ValueError("--at chooses decodings of an experiment's methods; an evaluation has its own.")
            names = str(given.runs), given.experiment
            found = list(differences_of_files(*map(Path, names)))
        else:
            names = given.method, in_table(given.other)
            found = list(_of_experiment(given))
        if not found:
            raise ValueError(f"{' and '.join(names)} have no seed and scene in common.")
    except (ValueError, OSError) as error:
        sys.exit(refused(error))
    _print(found, *names)


def _of_experiment(given: argparse.Namespace) -> Iterator[Difference]:
    if len(given.at) > 2:
        raise ValueError(f"--at takes one decoding for both, or one of each, got {len(given.at)}.")
    side = Side(_read(given.runs, given.experiment), given.method)
    if given.other.endswith(".json"):
        if len(given.at) > 1:
            raise ValueError("--at takes one decoding beside a rung, which has none.")
        return differences_to_rung(side, Path(given.other), Evaluations(given.runs), *given.at)
    name, _, method = given.other.rpartition(":")
    other = Side(_read(given.runs, name) if name else side.experiment, method)
    return differences(side, other, Evaluations(given.runs), given.at)


def in_table(other: str) -> str:
    """What a side is called: a rung as its ladder calls it.

    Examples:
        >>> in_table("runs/ladder/log_through_tokens.json")
        'log through tokens'
    """
    return Path(other).stem.replace("_", " ") if other.endswith(".json") else other


def _read(runs: Path, name: str) -> Experiment:
    path = runs / "experiments" / f"{name}.json"
    if not path.is_file():
        known = ", ".join(sorted(each.stem for each in path.parent.glob("*.json"))) or "none"
        raise ValueError(f"{runs} has no experiment {name!r}; it has {known}.")
    return read_experiment(path)


def _print(found: Sequence[Difference], method: str, other: str) -> None:
    one = found[0].interval.num_seeds == 1
    told = "; one training run: intervals are over its scenes alone and carry no claim about a method" if one else ""
    table = Table(title=f"{method} minus {other}{told}", title_justify="left")
    for title in ("measure", method, other, "difference [95 %]", "higher in seeds", "scenes"):
        table.add_column(title, justify="left" if title == "measure" else "right", no_wrap=True)
    for each in found:
        between = each.interval
        change = f"{between.mean:+.4f} [{between.low:+.4f}, {between.high:+.4f}]"
        seeds = f"{each.ahead} of {between.num_seeds}"
        numbers = (f"{each.mine:.4f}", f"{each.other:.4f}", change, seeds, str(between.num_scenes))
        table.add_row(each.measure, *numbers, style=None if between.verdict == "open" else "bold")
    print_whole(table, Console(markup=False))


if __name__ == "__main__":
    main()
