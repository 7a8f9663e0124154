"""The pre-trained policies that come with the package: zoo:NAME wherever a recipe takes a policy.

    python -m recipes.zoo                    # what there is
    python -m recipes.zoo show NAME          # the card of one: what made it, what it scores
    python -m recipes.zoo add NAME RUN --evaluation sumo=FILE --evaluation womd=FILE   # put one there

RUN is the folder of a finished recipes.pretrain, FILE what recipes.evaluate wrote for its policy. Only policies that
have seen nothing but simulated scenes are put into the zoo.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from dpa import zoo
from dpa.report.experiment import read_json
from dpa.report.table import MISSING, number, print_whole
from dpa.training.checkpoint import load_policy
from dpa.training.run import seconds_trained
from envs.files import write_json
from recipes.common.cli import refused
from recipes.common.models import build_policy, digest_of, num_parameters

SHOWN = ("realism", "collision_rate", "offroad_rate", "min_ade")
"""Measures in the list; the cards have all."""
FREE_SOURCES = ("sumo",)
"""Sources of scenes to which no licence is attached."""
SECONDS_OF_AN_HOUR = 3600


def make_card(run: Path, evaluations: dict[str, Path]) -> dict[str, Any]:
    """What is to be known of a pre-trained policy.

    Args:
        run: folder of the training.
        evaluations: results of :mod:`recipes.evaluate` by a name for their scenes.

    Raises:
        ValueError: it is not finished, was aligned, has learnt from scenes with a licence, or a result is of another
            policy.
    """
    file = run / zoo.POLICY
    if not file.is_file():
        raise ValueError(f"{run} holds no {zoo.POLICY}; run recipes.pretrain to its end first.")
    weights, config, made = load_policy(file)
    if made["method"] != "reference":
        raise ValueError(f"{file} was aligned by {made['method']}; the zoo takes policies of recipes.pretrain alone.")
    for source in sources(made):
        if source not in FREE_SOURCES:
            raise ValueError(
                f"{file} has learnt from scenes of the source {source}, and the zoo takes policies of "
                f"{', '.join(FREE_SOURCES)} alone: weights may not be given away where the licence of the scenes binds."
            )
    told = read_json(run / "result.json")
    return {
        "sha256": zoo.checksum(file),
        "parameters": num_parameters(build_policy(config)),
        "hours": round(seconds_trained(run) / SECONDS_OF_AN_HOUR, 2),
        "tune_nll": made["tune_nll"],
        "seed": made["seed"],
        "num_scenes": told["num_scenes"],
        "options": told["options"],
        "start": made["start"],
        "made_by": made["made_by"],
        "measures": {name: _measures(path, digest_of(weights)) for name, path in evaluations.items()},
    }


def sources(made: dict[str, Any]) -> Iterator[str | None]:
    """Sources of all scenes that a policy has learnt from, its own first, then those of what it started from."""
    while made is not None:
        yield made.get("source")
        made = made.get("start")


def _measures(path: Path, digest: str) -> dict[str, Any]:
    result = read_json(path)
    options = result["options"]
    if options["policy"] != digest:
        raise ValueError(f"{path} is of the policy {options['policy']} and this one is {digest}; evaluate it first.")
    return {"mean": result["mean"], "scenes": len(result["scenes"]), "options": options}


def add(name: str, run: Path, evaluations: dict[str, Path], folder: Path = zoo.FOLDER) -> Path:
    """Put a policy into the zoo.

    Returns:
        Its folder.

    Raises:
        ValueError: a name that is none or is taken, or see :func:`make_card`.
    """
    if not re.fullmatch("[a-z0-9][a-z0-9._-]*", name):
        raise ValueError(f"a name in the zoo has small letters and digits, and - _ . after the first, got {name!r}.")
    place = folder / name
    if (place / zoo.CARD).exists():
        raise ValueError(f"the zoo has a policy {name!r} already; give another name, or remove {place} first.")
    card = make_card(run, evaluations)
    place.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(run / zoo.POLICY, place / zoo.POLICY)
    write_json(place / zoo.CARD, card)
    return place


def listed() -> Table:
    """All policies, with their measures on each set of scenes."""
    cards = {name: zoo.card(name) for name in zoo.names()}
    kinds = list(dict.fromkeys(kind for card in cards.values() for kind in card["measures"]))
    table = Table("zoo:", "parameters", "hours", title="policies that come with the package")
    for kind in kinds:
        table.add_column(f"{kind}\nscenes", justify="right")
        for measure in SHOWN:
            table.add_column(f"{kind}\n{measure.replace('_', ' ')}", justify="right")
    for name, card in cards.items():
        measured = [card["measures"].get(kind, {"mean": {}, "scenes": MISSING}) for kind in kinds]
        cells = []
        for each in measured:
            cells += [str(each["scenes"]), *(number(each["mean"].get(measure), 3) for measure in SHOWN)]
        table.add_row(name, f"{card['parameters']:,}", f"{card['hours']:.1f}", *cells)
    return table


def _named(text: str) -> tuple[str, Path]:
    name, sign, path = text.partition("=")
    if not (name and sign and path):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=FILE")
    return name, Path(path)


def make_parser() -> argparse.ArgumentParser:
    """The options of the command."""
    parser = argparse.ArgumentParser(prog="python -m recipes.zoo", description="Pre-trained policies of the package.")
    commands = parser.add_subparsers(dest="command", metavar="show | add")
    show = commands.add_parser("show", help="the card of a policy")
    show.add_argument("name")
    put = commands.add_parser("add", help="put the policy of a finished recipes.pretrain into the zoo")
    put.add_argument("name")
    put.add_argument("run", type=Path, help="folder of the training")
    put.add_argument(
        "--evaluation", type=_named, action="append", default=[], metavar="NAME=FILE", help="result of recipes.evaluate"
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    options = make_parser().parse_args(arguments)
    try:
        if options.command == "show":
            print(json.dumps(zoo.card(options.name.removeprefix(zoo.PREFIX)), indent=2))
        elif options.command == "add":
            print(add(options.name, options.run, dict(options.evaluation)))
        else:
            print_whole(listed(), Console(markup=False))
    except (ValueError, OSError) as error:
        return refused(error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
