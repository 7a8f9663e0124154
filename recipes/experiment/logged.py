"""What an experiment found, as its logs keep it: tables, pictures and numbers, in CSV, TensorBoard or wandb."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from dpa.report.cards import preference_rows, read_preference_cards
from dpa.report.experiment import Comparison, Experiment
from dpa.report.figures import plot_comparison
from dpa.report.likelihoods import FIGURES, LEARNT, Learnt, who_learns
from dpa.report.matched import equal_sharpness
from dpa.report.scenes import read_scene_cards
from dpa.report.sections.safety import MEASURES
from dpa.report.stills import draw_charts, experiment_charts
from dpa.report.study import Evaluations
from dpa.report.table import REFERENCE, cells, header, measured, summarise
from dpa.training.loggers import make_logger
from recipes.common.cli import plain
from recipes.evaluate import SCENE_FIGURES
from recipes.experiment.runs import RunFolder

DECODING = {"top_p": "top-p", "temperature": "temperature"}
SAFETY = {key: f"{title} ↓" for key, title in MEASURES.items()}
TUNING = {"realism": "realism ↑", "spread": "spread [m]"}
"""Figures of the tuning grid: what decodings are chosen by, and how far apart the rollouts of a scene lie."""

Cells = tuple[Sequence[str], Sequence[Sequence[Any]]]
"""Titles and rows of a table."""


def log_experiment(cfg: DictConfig, experiment: Experiment, pictures: Mapping[str, Path]) -> Path:
    """Log an experiment's tables, its numbers, the picture of its differences, and those that were drawn of it.

    Args:
        cfg: with the section ``logger``, and ``output``, the folder of the study.
        experiment: to log.
        pictures: files by the names that they have in the logs.

    Returns:
        The folder of the logs.
    """
    folder, runs = experiment.path.with_suffix(""), RunFolder(Path(cfg.output))
    logs = make_logger(cfg.logger.backend, folder, plain(cfg), name=experiment.name, mode=cfg.logger.mode)
    with closing(logs) as logger, tempfile.TemporaryDirectory() as drawn:
        for name, (titles, rows) in _tables(experiment, runs):
            logger.table(name, titles, rows, 0)
        logger.log({name: value for name, value in _numbers(experiment) if value is not None}, 0)
        differences = Path(drawn) / "differences.png"
        plot_comparison(experiment, differences)
        figures = _figures(experiment, runs.root, Path(drawn))
        shown = {"own_best/differences": differences, **figures, **pictures}
        for name, picture in shown.items():
            logger.picture(name, picture, 0)
    return folder


def _figures(experiment: Experiment, study: Path, drawn: Path) -> dict[str, Path]:
    """The page's figures, drawn into a folder, by the names that they have in the logs."""
    charts = experiment_charts(experiment, study)
    files = {f"figures/{name}": drawn / f"{name}.png" for name in charts}
    for found, file in zip(charts.values(), files.values(), strict=True):
        draw_charts(found, file)
    return files


def _tables(experiment: Experiment, runs: RunFolder) -> Iterator[tuple[str, Cells]]:
    for name, compared in _compared(experiment).items():
        records = compared.records()
        yield f"{name}/methods", (header(records), cells(records))
        yield f"{name}/safety", _measured(records, SAFETY)
    if experiment.likelihood:
        yield "likelihood/methods", _measured(summarise(experiment.likelihood), FIGURES)
        if learnt := who_learns(experiment, Evaluations(runs.root)):
            yield "learnt/methods", _learnt(learnt)
    if experiment.tuning:
        yield "tuning/decodings", _measured(summarise(experiment.tuning), TUNING)
    if rows := list(_equal_sharpness(experiment, Evaluations(runs.root))):
        titles = ["method", *DECODING.values(), "spread [m]", "beyond [m]", "Δ realism", "low", "high"]
        yield "equal_sharpness/methods", (titles, rows)
    if experiment.stages:
        rows = [[name, _short(seconds)] for name, seconds in experiment.stages.items()]
        yield "account/stages", (["stage", "seconds of one worker"], rows)
    for split, card in (read_scene_cards(runs.scenes) if runs.scenes.is_file() else {}).items():
        yield f"scenes/{split}", (["of all scenes", split], list(card.facts.items()))
    if cards := read_preference_cards(runs.root):
        titles, *rows = preference_rows(cards)
        yield "preferences/stores", (titles, rows)


def _equal_sharpness(experiment: Experiment, evaluations: Evaluations) -> Iterator[list[Any]]:
    for method, decoding, (change, *place) in equal_sharpness(experiment, evaluations):
        yield [method, *decoding, *map(_short, (*place, change.mean, change.low, change.high))]


def _learnt(learnt: Learnt) -> Cells:
    """The paper's table 3: figures of its methods, then differences with the ends of their intervals."""
    ends = [f"{title} {end}" for title in LEARNT.values() for end in ("low", "high")]
    rows = [[name, *(_short(cell.mean) for cell in row), *([None] * len(ends))] for name, row in learnt.means.items()]
    for name, changes in learnt.changes.items():
        found = [[None] * 3 if each is None else [each.mean, each.low, each.high] for each in changes]
        rows.append([name, *(_short(mean) for mean, *_ in found), *(_short(end) for _, *pair in found for end in pair)])
    return ["of", *LEARNT.values(), *ends], rows


def _measured(records: Sequence[Mapping[str, Any]], figures: Mapping[str, str]) -> Cells:
    """Records of :func:`~dpa.report.table.summarise` as numbers: method, decoding, and the figures that some have."""
    named = {**DECODING, **figures}
    shown = {key: named[key] for key in measured(records, named)}
    rows = [[record["method"], *(_short(record[key]) for key in shown)] for record in records]
    return ["method", *shown.values()], rows


def _short(value: float | None) -> float | None:
    """More digits than the page has, and few enough to read."""
    return None if value is None else float(f"{value:.5g}")


def _numbers(experiment: Experiment) -> Iterator[tuple[str, float | None]]:
    """Figures of each method, differences with their intervals, and likelihoods, pair accuracy, entropy and drift."""
    for name, compared in _compared(experiment).items():
        first = {record["method"]: record for record in reversed(compared.records())}  # other decodings follow
        for method, record in first.items():
            yield from ((f"{name}/{key}/{method}", record[key]) for key in SCENE_FIGURES)
        for entry in (*compared.paired, *compared.versus):
            if entry["method"] != REFERENCE:
                to = "" if entry["against"] == REFERENCE else f"_to_{entry['against']}"
                told = zip(("difference", "low", "high"), (entry["realism_difference"], *entry["ci95"]), strict=True)
                yield from ((f"{name}/realism_{end}{to}/{entry['method']}", value) for end, value in told)
    for record in summarise(experiment.likelihood):
        yield from ((f"likelihood/{key}/{record['method']}", record.get(key)) for key in FIGURES)


def _compared(experiment: Experiment) -> dict[str, Comparison]:
    return {"common": experiment.at_common, "own_best": experiment.own_best}
