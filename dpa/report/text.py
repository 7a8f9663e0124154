"""The tables of a study in Markdown, to put into a document: the numbers of the page, word for word."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dpa.report.account import account_rows
from dpa.report.experiment import Comparison, Experiment
from dpa.report.findings import budgets, chosen_on_the_same, headline, left_out, ordering, saturated
from dpa.report.likelihoods import ABOUT_LEARNT, LEARNT, Learnt, likelihoods, shown_figures, who_learns
from dpa.report.matched import ABOUT_SHARPNESS, SHARPNESS, sharpness_rows
from dpa.report.paired import Cell
from dpa.report.sections.compute import ABOUT_MINUTES, MINUTES, minute_rows
from dpa.report.sections.safety import groups_of, safety_rows
from dpa.report.statistics import Interval
from dpa.report.study import Evaluations, Study
from dpa.report.table import (
    COLUMNS,
    MISSING,
    cells,
    difference,
    duration,
    header,
    measured,
    number,
    to_markdown,
)

WITH_DIFFERENCE = "with the difference from the reference; less is better, but for spread"


def study_text(study: Study) -> str:
    """Every experiment of a study: its finding, both tables, likelihoods, command, seeds and hours.

    Args:
        study: see :func:`dpa.report.study.read_study`.

    Returns:
        Markdown, with a heading of second level for each experiment and for the account.
    """
    evaluations = Evaluations(study.folder)
    parts = [block for experiment in study.experiments.values() for block in _experiment(experiment, evaluations)]
    if told := account_table(study):
        parts += ["## Time of one worker", told]
    return "\n\n".join(parts) + "\n"


def _experiment(experiment: Experiment, evaluations: Evaluations) -> Iterator[str]:
    repeats = f" ({experiment.paper} of the paper)" if experiment.paper else ""
    yield f"## {experiment.title}"
    yield f"{experiment.question}{repeats}"
    yield "\n".join(f"    {line}" for line in experiment.command.splitlines())
    yield _made(experiment)
    yield headline(experiment)
    compared = experiment.comparisons()
    if "own best" in compared:
        chosen = experiment.config.get("decoding", {}).get("chosen")
        by = f"as {chosen} chose" if chosen else f"chosen on the {experiment.scenes['tune']} tuning scenes"
        yield f"**Each at its own best decoding**, {by}:"
    else:
        yield f"**All at {next(iter(compared))}**, the one decoding of this experiment:"
    yield comparison_table(experiment, experiment.own_best)
    if safety := safety_table(experiment, experiment.own_best, evaluations):
        yield f"**Safety, and what it costs**, {WITH_DIFFERENCE}:"
        yield safety
    if told := ordering(experiment):
        yield f"Against {experiment.labels[experiment.versus]}, {told}."
    remarks = (
        budgets(experiment),
        saturated(experiment, evaluations.folder),
        chosen_on_the_same(experiment),
        left_out(experiment),
    )
    if told := [remark for remark in remarks if remark]:
        yield " ".join(told)
    if "common" in compared:
        yield "**All at the common decoding**, and the reference at the others:"
        yield comparison_table(experiment, experiment.at_common)
        if safety := safety_table(experiment, experiment.at_common, evaluations):
            yield f"**Safety, and what it costs, at the common decoding**, {WITH_DIFFERENCE}:"
            yield safety
    if told := sharpness_table(experiment, evaluations):
        yield f"**At equal sharpness** of sampling: {ABOUT_SHARPNESS}:"
        yield told
    if took := minute_table(experiment):
        yield f"**Minutes of one worker**, {ABOUT_MINUTES}:"
        yield took
    if experiment.likelihood:
        if learnt := who_learns(experiment, evaluations):
            yield f"**Who learns the ranking** (table 3); {ABOUT_LEARNT}:"
            yield learnt_table(learnt)
        yield (
            f"**Likelihood** of the reference's ranked rollouts of {experiment.reported}, per token [nats], in "
            "parentheses the difference from the reference; KL along rollouts of the method:"
        )
        yield likelihood_table(experiment, evaluations)


def comparison_table(experiment: Experiment, comparison: Comparison) -> str:
    """The results table of an experiment, with differences to the reference and to ``experiment.versus``.

    Args:
        experiment: that it is of.
        comparison: one of its two.
    """
    records = comparison.records()
    titles, rows = header(records), cells(records)
    titles.insert(1, "steps")
    for record, row in zip(records, rows, strict=True):
        row[:1] = [experiment.labels[record["method"]], str(comparison.steps[record["method"]] or MISSING)]
    against = {entry["method"]: entry for entry in comparison.versus}
    if against:
        titles.append(f"Δ to {experiment.labels[experiment.versus]}")
        for record, row in zip(records, rows, strict=True):
            entry = against.get(record["method"], {})
            row.append(difference(entry.get("realism_difference"), entry.get("ci95")))
    return to_markdown(titles, [*rows, *_published(experiment, titles)])


def safety_table(experiment: Experiment, comparison: Comparison, evaluations: Evaluations) -> str | None:
    """Rates of every method (``docs/safety.md``), and what they may be paid with, minADE and spread [m].

    Args:
        experiment: that it is of.
        comparison: one of its two.
        evaluations: figures of every scene; without them the differences have no intervals and are left out.

    Returns:
        Markdown, in the order of :func:`~dpa.report.sections.safety.groups_of`; None where no safety was measured.
    """
    names = {key: name for group in groups_of(experiment).values() for key, name in group.items()}
    records = comparison.records()
    shown = measured(records, names)
    if not shown:
        return None
    rows = safety_rows(experiment, comparison, records, shown, evaluations)
    titles = ["method", *(names[key] for key in shown)]
    return to_markdown(titles, [[name, *map(_with_change, cells)] for name, cells in rows])


def _published(experiment: Experiment, titles: Sequence[str]) -> Iterator[list[str]]:
    """The paper's own numbers of the methods that ran, in the columns that it has."""
    columns = {f"{column.title} {column.better}": column for column in COLUMNS}
    told = {method: figures for method, figures in experiment.published.items() if method in experiment.labels}
    for method, figures in told.items():
        cells = (
            number(figures.get(columns[title].key), columns[title].digits) if title in columns else MISSING
            for title in titles[1:]
        )
        yield [f"*paper: {experiment.labels[method]}*", *cells]


def sharpness_table(experiment: Experiment, evaluations: Evaluations) -> str | None:
    """Realism of every method minus that of the reference at the same spread of rollouts.

    Args:
        experiment: that tried several decodings.
        evaluations: figures of every scene.

    Returns:
        Markdown; None where nothing can be compared.
    """
    rows = sharpness_rows(experiment, evaluations)
    return to_markdown(SHARPNESS, rows) if rows else None


def minute_table(experiment: Experiment) -> str | None:
    """Minutes of every method until each of its snapshots.

    Args:
        experiment: to tell of.

    Returns:
        Markdown; None where no snapshot was evaluated, or no time was kept.
    """
    rows = minute_rows(experiment)
    return to_markdown(MINUTES, rows) if rows else None


def likelihood_table(experiment: Experiment, evaluations: Evaluations) -> str:
    """Means over seeds of what every method thinks of ranked rollouts and logs, and the change from the reference.

    Args:
        experiment: with rows of likelihood.
        evaluations: figures of every scene; without them the differences are left out.
    """
    rows = [
        [experiment.labels[method], *map(_with_change, cells)]
        for method, cells in likelihoods(experiment, evaluations).items()
    ]
    return to_markdown(["method", *shown_figures(experiment).values()], rows)


def learnt_table(learnt: Learnt) -> str:
    """Table 3 of the paper, with its own numbers beside ours.

    Args:
        learnt: see :func:`~dpa.report.likelihoods.who_learns`.
    """
    rows = [[name, *(number(cell.mean, cell.digits) for cell in cells)] for name, cells in learnt.means.items()]
    rows += [[name, *map(_change, changes)] for name, changes in learnt.changes.items()]
    rows += [[f"*paper: {name}*", *(number(each, 3) for each in paper)] for name, paper in learnt.published.items()]
    return to_markdown(["method", *LEARNT.values()], rows)


def _with_change(cell: Cell) -> str:
    value, found = number(cell.mean, cell.digits), cell.change
    return value if found is None else f"{value} ({difference(found.mean, (found.low, found.high), cell.digits)})"


def _change(found: Interval | None) -> str:
    return MISSING if found is None else difference(found.mean, (found.low, found.high))


def _made(experiment: Experiment) -> str:
    scenes, over = experiment.scenes, "both" if len(experiment.seeds) > 1 else "scenes alone"
    return (
        f"{scenes['train']} training, {scenes['tune']} tuning and {scenes['eval']} evaluation scenes of "
        f"{scenes['source']}; numbers are of the {experiment.reported}, {experiment.num_rollouts} rollouts of each; "
        f"seeds {', '.join(map(str, experiment.seeds))}; realism of {experiment.metric}; "
        f"{experiment.date or MISSING}, commit {experiment.revision or MISSING}; {experiment.machine}; "
        f"{duration(experiment.worker_seconds)} of one worker. "
        f"Differences are paired by scene and seed, with 95 % intervals over {over}."
    )


def account_table(study: Study) -> str | None:
    """Worker time of every stage, by experiment and in all; None where no time is kept.

    Args:
        study: see :func:`dpa.report.study.read_study`.
    """
    rows = account_rows(study)
    return to_markdown(rows[0], rows[1:]) if rows else None
