"""What an experiment found, as its logs keep it: tables, pictures and numbers, in CSV, TensorBoard or wandb."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from dpa.report.experiment import read_experiment
from dpa.report.figures import plot_comparison
from dpa.report.table import REFERENCE, cells, header, summarise
from dpa.training.loggers import make_logger
from recipes.alignment.likelihoods import PROBED
from recipes.common.cli import plain
from recipes.evaluate import SCENE_FIGURES
from recipes.experiment.jobs import runs_of


def log_experiment(cfg: DictConfig, found: Mapping[str, Any]) -> Path:
    """Log both comparisons of an experiment, and the picture of the differences.

    Args:
        cfg: with the section ``logger``.
        found: content of the experiment's JSON, which has been written.

    Returns:
        The folder of the logs.
    """
    path = runs_of(cfg).experiment(found["name"])
    folder = path.with_suffix("")
    logger = make_logger(cfg.logger.backend, folder, plain(cfg), name=found["name"], mode=cfg.logger.mode)
    compared = {"common": found, "own_best": found["own_best"]}
    try:
        for name, each in compared.items():
            records = summarise(each["rows"], each["paired"])
            logger.table(f"{name}/methods", header(records), cells(records), 0)
            first = {record["method"]: record for record in reversed(records)}  # the reference's other decodings follow
            values = {
                f"{name}/{key}/{method}": record[key] for method, record in first.items() for key in SCENE_FIGURES
            }
            for entry in each["paired"]:
                if entry["method"] != REFERENCE:
                    low, high = entry["ci95"]
                    told = {"difference": entry["realism_difference"], "low": low, "high": high}
                    values |= {f"{name}/realism_{end}/{entry['method']}": value for end, value in told.items()}
            logger.log({key: value for key, value in values.items() if value is not None}, 0)
        logger.log(_likelihoods(found), 0)
        with tempfile.TemporaryDirectory() as drawn:
            picture = Path(drawn) / "differences.png"
            plot_comparison(read_experiment(path), picture)
            logger.picture("own_best/differences", picture, 0)
    finally:
        logger.close()
    return folder


def _likelihoods(found: Mapping[str, Any]) -> dict[str, float]:
    """Pair accuracy, likelihoods, entropy and drift of each method, means over seeds."""
    means = {}
    for name in (*PROBED, "kl"):
        for method in found["methods"]:
            values = [entry[name] for entry in found["likelihood"] if entry["method"] == method]
            if values and None not in values:
                means[f"likelihood/{name}/{method}"] = sum(values) / len(values)
    return means
