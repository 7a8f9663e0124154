"""One page from everything that a study has found, to put beside a paper.

    python -m recipes.report RUNS OUT

RUNS is the folder that recipes.compare fills (its output). OUT is the page: a .html file, or a folder for index.html.
With a .png it is one picture, the differences of one experiment; with a .md the tables of all experiments, for a
document; with a .zip what the numbers rest on, to hand on: results of every scene, options and curves, without weights,
scenes and rollouts. Unpacked it is a RUNS again. The numbers are those of the files in RUNS.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dpa.report.archive import write_archive
from dpa.report.figures import plot_comparison
from dpa.report.page import write_study, write_whole
from dpa.report.study import read_study
from dpa.report.text import study_text
from recipes.common.cli import refused

EXPERIMENTS = Path(__file__).parent / "config" / "experiment"
"""One YAML for each experiment that recipes.compare knows."""
KINDS = (".html", ".png", ".md", ".zip")
"""What a study is written as."""


def report(runs: Path, out: Path, experiment: str | None = None) -> Path:
    """Write the page of a study, the picture of an experiment, its tables, or what they rest on.

    Args:
        runs: folder of results.
        out: ``.html``, a folder for ``index.html``, ``.png``, ``.md``, or ``.zip``.
        experiment: of the picture; by default the first that the page shows.

    Returns:
        The file that was written.

    Raises:
        ValueError: no results in ``runs``, a file of it that cannot be read, another ending, an experiment that is not
            there or with which nothing is drawn; the message names it.
    """
    study, kind = read_study(runs), "" if out.is_dir() else out.suffix
    if kind in (".png", ".md") and not study.experiments:
        raise ValueError(f"{runs} holds no experiments/*.json, and {out.name} would show nothing else; say page.html.")
    if kind not in ("", *KINDS):
        raise ValueError(f"{out} must end in one of {', '.join(KINDS)}, or be a folder.")
    if experiment is not None and kind != ".png":
        raise ValueError(f"--experiment={experiment} is for a picture.png; {out.name or out} shows all experiments.")
    if experiment is not None and experiment not in study.experiments:
        raise ValueError(f"{runs} has no experiment {experiment!r}; it has {', '.join(study.experiments)}.")
    out.parent.mkdir(parents=True, exist_ok=True)
    if kind == ".png":
        plot_comparison(study.experiments[experiment or next(iter(study.experiments))], out)
        return out
    if kind == ".zip":
        return write_archive(out, runs)
    if kind == ".md":
        return write_whole(out, study_text(study))
    page = out if kind == ".html" else out / "index.html"
    return write_study(page, study, experiments=known_experiments())


def known_experiments() -> list[str]:
    """Names of all experiments there are."""
    return sorted(path.stem for path in EXPERIMENTS.glob("*.yaml") if path.stem != "base")


def make_parser() -> argparse.ArgumentParser:
    """Arguments of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m recipes.report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", metavar="RUNS", type=Path, help="folder of results")
    parser.add_argument(
        "out", metavar="OUT", type=Path, help="page.html, a folder, picture.png, tables.md, or results.zip"
    )
    parser.add_argument("--experiment", metavar="NAME", help="experiment of picture.png; by default the first")
    return parser


def main() -> None:
    """Entry point of ``python -m recipes.report``."""
    given = make_parser().parse_args()
    try:
        print(report(given.runs, given.out, given.experiment))
    except (ValueError, OSError) as error:
        sys.exit(refused(error))


if __name__ == "__main__":
    main()
