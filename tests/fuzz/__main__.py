"""``python -m tests.fuzz FORMAT``: ten thousand broken inputs of a format, each of which must end well.

    python -m tests.fuzz womd --inputs 10000 --seed 0 --file data/training.tfrecord-00000-of-01000
    python -m tests.fuzz store --seed 0 --only 4711 --keep broken

Each input gives sound scenes (or rollouts, or a policy) or one error that names its file, within ten seconds and two
gibibytes. The exit status is 1 if one does not.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

# Before pyarrow is imported: its own pools reserve a gibibyte of address space, by which memory is limited here.
os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")

from envs.progress import progress
from tests.fuzz.case import Corpus
from tests.fuzz.formats import FORMATS
from tests.fuzz.judge import judge
from tests.fuzz.pen import Result, run_apart

SHOWN_KINDS = 15
"""Kinds of errors in the table."""


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description="Break inputs of a format and read them.")
    parser.add_argument("format", choices=FORMATS)
    parser.add_argument("--inputs", type=int, default=10_000, help="how many (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of all of them (default: %(default)s)")
    parser.add_argument("--only", type=int, action="append", metavar="N", help="only the input of this number")
    parser.add_argument("--file", type=Path, nargs="+", default=[], help="sound inputs of yours, broken now and then")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="write inputs that end badly (or --only) there")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    options = make_parser().parse_args(arguments)
    format = FORMATS[options.format]
    corpus = Corpus(format, format.seeds(), [format.load(path) for path in options.file], options.seed)
    _warm_up(corpus)
    numbers = options.only or range(options.inputs)
    results, start = [], time.monotonic()
    with progress(total=len(numbers), description=f"fuzz {format.name}", unit="input") as bar:
        for result in run_apart(numbers, corpus.case, partial(judge, format)):
            results.append(result)
            if result.verdict.fault or options.only:
                _report(corpus, result, options.keep)
            bar.update()
    sys.stdout.write(table(format.name, options.seed, results, time.monotonic() - start))
    return int(any(result.verdict.fault for result in results))


def _warm_up(corpus: Corpus) -> None:
    """Every seed, once and unbroken: it must be sound, and what is loaded at first use counts for no input."""
    from tempfile import TemporaryDirectory

    from tests.fuzz.case import Case

    for files in (*corpus.small, *corpus.given):
        with TemporaryDirectory(prefix="fuzz-") as folder:
            for name, content in files.items():
                Path(folder, name).write_bytes(content)
            verdict = judge(corpus.format, Case(files, (), converted=corpus.format.source is not None), Path(folder))
            if verdict.fault or verdict.errors or not verdict.scenes:
                raise SystemExit(f"error: {next(iter(files))} is not sound to begin with: {verdict}")


def _report(corpus: Corpus, result: Result, keep: Path | None) -> None:
    case = corpus.case(result.number)
    verdict = result.verdict
    sys.stdout.write(f"\n{result.number} ({', '.join(case.made_by)}): {verdict.fault or verdict.errors!a}\n")
    if keep is not None:
        folder = keep / f"{corpus.format.name}-{corpus.seed}-{result.number}"
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in case.files.items():
            (folder / name).write_bytes(content)


def table(name: str, seed: int, results: Sequence[Result], seconds: float) -> str:
    """What came of all inputs, as text."""
    slowest, hungriest = max(results, key=lambda r: r.seconds), max(results, key=lambda r: r.memory)
    kinds = Counter(kind for result in results for kind in result.verdict.errors)
    faults = Counter((result.verdict.fault or "")[:100] for result in results if result.verdict.fault)
    rows = {
        "inputs": f"{len(results)} of {name}, seed {seed}, in {seconds:.0f} s",
        "sound scenes": sum(result.verdict.scenes for result in results),
        "inputs with one": sum(result.verdict.scenes > 0 for result in results),
        "errors": f"{sum(kinds.values())} of {len(kinds)} kinds",
        "slowest": f"{slowest.seconds:.2f} s (input {slowest.number})",
        "most memory": f"{hungriest.memory >> 20} MiB (input {hungriest.number})",
        "faults": sum(faults.values()),
    }
    lines = [f"{key:<16} {value}" for key, value in rows.items()]
    lines += [f"{count:>8}  {kind}" for kind, count in kinds.most_common(SHOWN_KINDS)]
    lines += [f"{count:>8}  FAULT {fault}" for fault, count in faults.most_common()]
    return "\n" + "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
