"""One page from everything that a study has found, to put beside a paper.

    python -m recipes.report RUNS OUT

RUNS is the folder that recipes.compare fills (its output). OUT is the page: a .html file, or a folder for index.html.
With a .png it is one figure of one experiment; with a .md the tables of all experiments, for a document; with a .zip
what the numbers rest on, to hand on: results of every scene, options and curves, without weights, scenes and rollouts.
Unpacked it is a RUNS again. The numbers are those of the files in RUNS.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dpa.report.archive import write_archive
from dpa.report.figures import plot_comparison
from dpa.report.page import write_study, write_whole
from dpa.report.stills import FIGURES, draw_charts, experiment_charts
from dpa.report.study import Study, read_study
from dpa.report.text import study_text
from recipes.common.cli import refused

EXPERIMENTS = Path(__file__).parent / "config" / "experiment"
"""One YAML for each experiment that recipes.compare knows."""
KINDS = (".html", ".png", ".md", ".zip")
"""What a study is written as."""
DIFFERENCES = "differences"
"""The figure that is drawn unless another one is named."""


def report(
    runs: Path, out: Path, experiment: str | None = None, figure: str | None = None, *, numbered: bool = False
) -> Path:
    """Write the page of a study, the picture of an experiment, its tables, or what they rest on.

    Args:
        runs: folder of results.
        out: ``.html``, a folder for ``index.html``, ``.png``, ``.md``, or ``.zip``.
        experiment: of the picture; by default the first that the page shows.
        figure: of the picture, ``differences`` or one of :data:`~dpa.report.stills.FIGURES`.
        numbered: a ``.zip`` calls scenes by number.

    Returns:
        The file that was written.

    Raises:
        ValueError: no results in ``runs``, a file of it that cannot be read, another ending, an experiment or a figure
            that is not there or with which nothing is drawn; the message names it.
    """
    study, kind = read_study(runs), "" if out.is_dir() else out.suffix
    if kind in (".png", ".md") and not study.experiments:
        raise ValueError(f"{runs} holds no experiments/*.json, and {out.name} would show nothing else; say page.html.")
    if kind not in ("", *KINDS):
        raise ValueError(f"{out} must end in one of {', '.join(KINDS)}, or be a folder.")
    for option, value in {"experiment": experiment, "figure": figure}.items():
        if value is not None and kind != ".png":
            raise ValueError(f"--{option}={value} is for a picture.png; {out.name or out} shows all of them.")
    if numbered and kind != ".zip":
        raise ValueError(f"--number-scenes is for results.zip; {out.name or out} shows scenes by their names.")
    if experiment is not None and experiment not in study.experiments:
        raise ValueError(f"{runs} has no experiment {experiment!r}; it has {', '.join(study.experiments)}.")
    out.parent.mkdir(parents=True, exist_ok=True)
    if kind == ".png":
        draw(study, experiment or next(iter(study.experiments)), figure or DIFFERENCES, out)
        return out
    if kind == ".zip":
        return write_archive(out, runs, numbered=numbered)
    if kind == ".md":
        return write_whole(out, study_text(study))
    page = out if kind == ".html" else out / "index.html"
    return write_study(page, study, experiments=known_experiments())


def draw(study: Study, name: str, figure: str, out: Path) -> None:
    """Draw one figure of one experiment.

    Raises:
        ValueError: the experiment has no such figure.
    """
    experiment = study.experiments[name]
    if figure == DIFFERENCES:
        plot_comparison(experiment, out)
        return
    charts = experiment_charts(experiment, study.folder)
    if figure not in charts:
        has = ", ".join((DIFFERENCES, *charts))
        raise ValueError(f"--figure={figure}: experiment {name!r} in {study.folder} has {has}.")
    draw_charts(charts[figure], out)


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
    parser.add_argument(
        "--figure",
        choices=(DIFFERENCES, *FIGURES),
        help="figure of picture.png: differences in realism (the default), realism over sharpness, figure 7 (scaling), "
        "realism over minutes (compute), figures 4 and 6 (likelihood), health of the alignment",
    )
    parser.add_argument("--number-scenes", action="store_true", help="results.zip calls scenes by number, not by name")
    return parser


def main() -> None:
    """Entry point of ``python -m recipes.report``."""
    given = make_parser().parse_args()
    try:
        print(report(given.runs, given.out, given.experiment, given.figure, numbered=given.number_scenes))
    except (ValueError, OSError) as error:
        sys.exit(refused(error))


if __name__ == "__main__":
    main()
