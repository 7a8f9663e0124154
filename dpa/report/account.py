"""The compute account of a study: worker time of every stage, by experiment and in all."""

from __future__ import annotations

import math

from dpa.report.study import Study
from dpa.report.table import MISSING, duration

ONCE = "all, each job once"
"""Name of the last row: experiments share references and rollouts, so that it is less than the sum of theirs."""


def account_rows(study: Study) -> list[list[str]]:
    """A table of worker time: a row of titles, one for each experiment, and one for the study.

    Args:
        study: see :func:`dpa.report.study.read_study`.

    Returns:
        Cells; an experiment's are of all jobs that it needed, whoever ran them first. Empty where no time is kept.
    """
    if not study.stages:
        return []
    total = study.seconds
    rows = [["experiment", *total, "all"]]
    for label, spent in [*((each.title, each.stages) for each in study.experiments.values()), (ONCE, total)]:
        known = [spent.get(name) for name in total]
        cells = [MISSING if seconds is None else duration(seconds) for seconds in known]
        rows.append([label, *cells, duration(math.fsum(seconds for seconds in known if seconds is not None))])
    return rows
