"""What one experiment found: tables at both decodings, differences, decoding-matched curves, and how it was made."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dpa.report.charts import Chart, Difference, Line, curves, forest, gallery, lines
from dpa.report.experiment import SAMPLED, Comparison, Experiment, decoding_against, decoding_of, in_words
from dpa.report.findings import budgets, chosen_on_the_same, left_out, ordering, saturated
from dpa.report.markup import (
    Html,
    Section,
    command,
    element,
    facts,
    folded,
    hint,
    html,
    joined,
    quiet,
    sources,
    stacked,
    table,
    tabs,
)
from dpa.report.matched import ABOUT_SHARPNESS, SHARPNESS, matched_difference, reference_line, sharpness_rows
from dpa.report.paired import paired_figure, quiet_change
from dpa.report.sections.compute import ABOUT_MINUTES, MINUTES, compute_charts, minute_rows
from dpa.report.sections.likelihood import likelihood_table
from dpa.report.sections.origin import code_of
from dpa.report.sections.safety import safety_tables
from dpa.report.sections.scaling import scaling_charts
from dpa.report.statistics import Interval, verdict
from dpa.report.study import FIRST, Evaluations
from dpa.report.table import COLUMNS, MISSING, REFERENCE, difference, duration, number, signed

DPO = {
    "kind": "contrastive", "link": "logistic", "reference": True, "conservative": 1.0, "score_reduction": "sum",
    "credit": "scene", "margin": 0.0, "label_smoothing": 0.0, "cloning": 0.0,
}  # fmt: skip
"""Options of a loss that is DPO's."""
MAIN = ("kinematic", "interactive", "map_based", "realism", "min_ade")
"""Figures of the first table, in the paper's order."""


def experiment_section(experiment: Experiment, colours: Mapping[str, str], evaluations: Evaluations) -> Section:
    """Everything about one experiment.

    Args:
        experiment: to show.
        colours: of its methods.
        evaluations: figures of every scene behind its rows.
    """
    compared = experiment.comparisons()
    panels = {SAMPLED.get(kind, kind): _panel(experiment, each, evaluations) for kind, each in compared.items()}
    charts = [
        differences(experiment),
        versus(experiment),
        *scaling_charts(experiment, colours),
        *compute_charts(experiment, colours),
        *matched_curves(experiment, colours, evaluations),
    ]
    about = [
        _scenes(experiment),
        f"numbers are of the {experiment.reported}, {experiment.num_rollouts} rollouts of each",
        f"seeds {', '.join(map(str, experiment.seeds))}",
        *(f"one decoding, {kind}" for kind in compared.keys() - SAMPLED.keys()),
        f"realism metric of {experiment.metric}",
        *([f"in the paper: {experiment.paper}"] if experiment.paper else []),
    ]
    notes = [note for note in (budgets(experiment), saturated(experiment, evaluations.folder)) if note]
    body = [
        element("p", experiment.question, class_="question"),
        hint("; ".join(about) + "."),
        tabs(panels, f"decoding-{experiment.name}"),
        *(element("p", note, class_="note") for note in notes),
        gallery([chart for chart in charts if chart is not None]),
        sharpness_table(experiment, evaluations),
        minute_table(experiment),
        likelihood_table(experiment, evaluations),
        folded("command, configuration, versions and machine", _made(experiment)),
    ]
    return Section(f"experiment-{experiment.name}", experiment.title, joined(body))


def differences(experiment: Experiment) -> Chart | None:
    """Forest of paired differences at every decoding; None where nothing was compared."""
    compared = experiment.comparisons()
    groups = {kind: _differences(experiment, each, each.paired) for kind, each in compared.items()}
    groups = {kind: found for kind, found in groups.items() if found}
    if not groups:
        return None
    caption = f"Paired scene by scene on {experiment.reported}; blue is better, orange worse, grey not told apart."
    if compared.keys() == SAMPLED.keys():
        caption += (
            " Full: own best decodings. Hollow: the common decoding, where the reference at other decodings shows what "
            "sampling alone does."
        )
    title = "Realism minus that of the reference, 95 % intervals"
    return forest(groups, title, x="difference in realism", caption=caption)


def versus(experiment: Experiment) -> Chart | None:
    """Forest of the other methods against ``experiment.versus``; None where there is no other."""
    kind, own = next(iter(experiment.comparisons().items()))
    found = _differences(experiment, own, own.versus)
    if not found:
        return None
    standard = experiment.labels[experiment.versus]
    how = f"{experiment.sampled}, on {experiment.reported}"
    caption = f"{how.capitalize()}. Against {standard}, {ordering(experiment)}."
    title = f"Realism minus that of {standard}, 95 % intervals"
    return forest({kind: found}, title, x=f"difference in realism to {standard}", caption=caption)


def matched_curves(experiment: Experiment, colours: Mapping[str, str], evaluations: Evaluations) -> list[Chart]:
    """Realism against the spread of rollouts, over the decodings tried: methods compare at equal sharpness.

    Args:
        experiment: to show.
        colours: of its methods.
        evaluations: figures of every scene, for the intervals.
    """
    content, tuned = [], Comparison(experiment.tuning, [])
    base = reference_line([tuned], experiment)
    for method in experiment.methods:
        records = Comparison([row for row in experiment.tuning if row["method"] == method], []).records()
        known = [r for r in records if r.get("spread") is not None and r["realism"] is not None]
        known.sort(key=lambda record: record["spread"])
        if not known:
            continue
        label, chosen = experiment.labels[method], experiment.chosen.get(method)
        line = [] if method == REFERENCE else base
        matched = [matched_difference(tuned.of(method, decoding_of(each)), line, evaluations) for each in known]
        above = [each and each.change for each in matched]
        content.append(
            Line(
                label,
                [record["spread"] for record in known],
                [record["realism"] for record in known],
                colours[method],
                hover=[
                    lines(
                        label + (", chosen" if decoding_of(record) == chosen else ""),
                        f"{in_words(decoding_of(record))}, {record['n_seeds']} seeds",
                        f"realism {number(record['realism'], 3)}, spread {number(record['spread'], 2)} m",
                        *([f"{difference(found.mean, (found.low, found.high))} at equal sharpness"] if found else []),
                    )
                    for record, found in zip(known, above, strict=True)
                ],
                error=_reach(above),
                dash="dot" if method == REFERENCE else "solid",
                markers=[15 if decoding_of(record) == chosen else 6 for record in known],
                opacity=0.45 if "@" in method else 1.0,
            )
        )
    if not any(len(line.x) > 1 for line in content):
        return []
    caption = (
        "Every decoding of the grid, mean over seeds; the large marker is the one chosen. Spread: root mean square "
        "distance of an agent's last position from its mean over rollouts. Left is sharper sampling. A "
        "method that only samples more sharply lies on the line of the reference; bars are 95 % intervals of how far "
        "above that line a point lies, beyond its ends above its end: one that does not reach it is told apart."
    )
    title = "Realism against sharpness of sampling, tuning scenes"
    return [curves(content, title, x="spread of the rollouts of a scene [m]", y="realism", caption=caption)]


def sharpness_table(experiment: Experiment, evaluations: Evaluations) -> Html:
    """Methods at equal sharpness; nothing where the reference was sampled at one decoding."""
    rows = sharpness_rows(experiment, evaluations)
    if not rows:
        return Html("")
    about = hint(f"On {experiment.reported}: {ABOUT_SHARPNESS}.")
    return joined([element("h3", "At equal sharpness of sampling"), table(SHARPNESS, rows), about])


def minute_table(experiment: Experiment) -> Html:
    """What methods took until each snapshot; nothing where none was evaluated."""
    rows = minute_rows(experiment)
    if not rows:
        return Html("")
    return joined(
        [element("h3", "Minutes of one worker"), table(MINUTES, rows), hint(f"{ABOUT_MINUTES}.".capitalize())]
    )


def _reach(above: Sequence[Interval | None]) -> tuple[list[float], list[float]] | None:
    """How far bars reach up and down from points above or below a line; None where a point is compared with nothing."""
    if not all(above):
        return None
    return [each.high - each.mean for each in above], [each.mean - each.low for each in above]


def _panel(experiment: Experiment, comparison: Comparison, evaluations: Evaluations) -> Html:
    parts = [_main_table(experiment, comparison, evaluations), safety_tables(experiment, comparison, evaluations)]
    return joined(part for part in parts if part)


def _main_table(experiment: Experiment, comparison: Comparison, evaluations: Evaluations) -> Html:
    columns = [column for column in COLUMNS if column.key in MAIN]
    against = {entry["method"]: entry for entry in comparison.versus}
    head = ["method", *(f"{column.title}\N{NO-BREAK SPACE}{column.better}" for column in columns)]
    head += [*([f"Δ realism to {experiment.labels[experiment.versus]}"] if against else []), "seeds"]
    rows, shown, base = [], set(), comparison.base()
    for record in _ordered(experiment, comparison):
        method, mine = record["method"], comparison.of(record["method"], decoding_of(record))
        # The paper has one decoding for each method: its numbers stand at the first row only.
        published = {} if method in shown else experiment.published.get(method, {})
        shown.add(method)
        cells = []
        for column in columns:
            if column.key == "realism":
                told = (record["realism_difference"], record["ci95"], record["over"])
                change = Html("") if None in told else quiet(*told, column.digits)
            else:
                found = None if mine == base else paired_figure(mine, base, column.key, evaluations)
                change = quiet_change(found, column.digits)
            value, paper = number(record[column.key], column.digits), published.get(column.key)
            cells.append(joined([value, change, _paper(paper, column.digits)], ""))
        if against:
            cells.append(_against(against.get(method)))
        steps = f", {count} steps" if (count := comparison.steps[method]) else ""
        name = joined([experiment.labels[method], element("small", in_words(decoding_of(record)) + steps)], "")
        rows.append([name, *cells, sources([row["file"] for row in mine])])
    note, remarks = _which_loss(experiment), hint(" ".join(_remarks(experiment, comparison)))
    return joined([table(head, rows), *([element("p", note, class_="note")] if note else []), remarks])


def _against(entry: Mapping[str, Any] | None) -> Html:
    return html(MISSING) if entry is None else stacked(entry["realism_difference"], entry["ci95"], entry["over"])


def _paper(published: float | None, digits: int) -> Html:
    return Html("") if published is None else element("small", f"paper {number(published, digits)}")


def _remarks(experiment: Experiment, comparison: Comparison) -> list[str]:
    """How to read a table of results."""
    own = comparison is experiment.own_best
    remarks = [
        f"Means over seeds on {experiment.reported}; arrows point to better values. In small type the difference from "
        "the reference with its 95 % interval, bold where that does not contain 0.",
        "The paper's numbers are from its own data and scale." if experiment.published else None,
        left_out(experiment),
        chosen_on_the_same(experiment) if own else None,
    ]
    return [remark for remark in remarks if remark]


def _which_loss(experiment: Experiment) -> str | None:
    """What stands behind the name of the paper's method in the main experiment, as it was run."""
    loss = experiment.config.get("methods", {}).get("dpa_omf", {}).get("loss", {})
    if experiment.name != FIRST or any(loss.get(name) != value for name, value in DPO.items()):
        return None
    return (
        f"{experiment.labels['dpa_omf']} here is eq. 4 with the reference term, which is DPO. The plain form that the "
        "paper writes is the method cpl of the experiment losses (docs/method.md)."
    )


def _differences(
    experiment: Experiment, comparison: Comparison, entries: Sequence[Mapping[str, Any]]
) -> dict[str, Difference]:
    found = {}
    for entry in _in_order(experiment, entries):
        method, decoding, against = entry["method"], decoding_of(entry), decoding_against(entry)
        seeds = _by_seed(comparison, method, decoding, entry["against"], against)
        name = experiment.labels[method] + (f",\n{in_words(decoding)}" if method == REFERENCE else "")
        found[name] = Difference(
            entry["realism_difference"],
            *entry["ci95"],
            verdict(entry["ci95"], entry["over"]),
            hover=[
                f"{in_words(decoding)}, against {_called(experiment, entry['against'])} at {in_words(against)}",
                f"{entry['n_seeds']} seeds, interval over {entry['over']}",
                *([f"by seed: {', '.join(map(signed, seeds))}"] if seeds else []),
            ],
        )
    return found


def _called(experiment: Experiment, method: str) -> str:
    return "the reference" if method == REFERENCE else experiment.labels[method]


def _by_seed(comparison: Comparison, method: str, decoding: Any, other: str, against: Any) -> list[float]:
    """Difference of the means of each seed, where both rows stand in the comparison."""
    base = {row["seed"]: row.get("realism") for row in comparison.of(other, against)}
    mine = {row["seed"]: row.get("realism") for row in comparison.of(method, decoding)}
    return [mine[seed] - base[seed] for seed in mine if None not in (mine[seed], base.get(seed))]


def _ordered(experiment: Experiment, comparison: Comparison) -> list[dict[str, Any]]:
    return _in_order(experiment, comparison.records())


def _in_order(experiment: Experiment, entries: Sequence[Any]) -> list[Any]:
    return sorted(entries, key=lambda entry: list(experiment.methods).index(entry["method"]))


def _scenes(experiment: Experiment) -> str:
    scenes = experiment.scenes
    counts = f"{scenes['train']} training, {scenes['tune']} tuning and {scenes['eval']} evaluation scenes"
    return f"{counts} of {scenes['source']}"


def _made(experiment: Experiment) -> Html:
    """Command, budgets, versions and configuration of an experiment."""
    named = {
        "numbers": element("code", f"experiments/{experiment.path.name}"),
        **code_of(experiment.date, experiment.revision, experiment.machine, experiment.versions),
        "worker time": duration(experiment.worker_seconds),
        "stages": ", ".join(f"{name} {duration(spent)}" for name, spent in experiment.stages.items()) or MISSING,
    }
    config = json.dumps(experiment.config, indent=2, ensure_ascii=False, allow_nan=False)
    parts = [command(experiment.command), facts(named), _budget(experiment)]
    return joined([*parts, folded("configuration", element("pre", config))])


def _budget(experiment: Experiment) -> Html:
    rows = [
        [experiment.labels[method], f"{each['steps']:,}", f"{each['rollouts']:,}", experiment.labels[each["start"]]]
        for method, each in experiment.budget.items()
    ]
    if not rows:
        return Html("")
    about = hint(
        "Of one training run; a further round counts those of the method that it starts from. GRPO learns from the "
        "rollouts of a step more than once."
    )
    return joined([table(["method", "steps", "rollouts read", "starts from"], rows), about])
