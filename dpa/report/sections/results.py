"""What one experiment found: tables at both decodings, differences, decoding-matched curves, and how it was made."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dpa.report.charts import Chart, Difference, Line, curves, forest, gallery, lines
from dpa.report.experiment import Comparison, Experiment, decoding_of, in_words
from dpa.report.markup import (
    Html,
    Section,
    command,
    element,
    facts,
    folded,
    hint,
    html,
    interval,
    joined,
    sources,
    table,
    tabs,
)
from dpa.report.sections.likelihood import likelihood_table
from dpa.report.sections.safety import safety_table
from dpa.report.sections.scaling import scaling_charts
from dpa.report.study import Evaluations
from dpa.report.table import COLUMNS, DIFFERENCE_TITLE, MISSING, REFERENCE, duration, number, signed

MAIN = ("kinematic", "interactive", "map_based", "realism", "min_ade")
"""Figures of the first table, in the paper's order."""
OWN_BEST, COMMON = "each at its own best decoding", "all at the common decoding"


def experiment_section(experiment: Experiment, colours: Mapping[str, str], evaluations: Evaluations) -> Section:
    """Everything about one experiment.

    Args:
        experiment: to show.
        colours: of its methods.
        evaluations: figures of every scene behind its rows.
    """
    panels = {
        OWN_BEST: _panel(experiment, experiment.own_best, evaluations),
        COMMON: _panel(experiment, experiment.at_common, evaluations),
    }
    charts = [differences(experiment), *scaling_charts(experiment, colours), *matched_curves(experiment, colours)]
    about = [
        _scenes(experiment),
        f"seeds {', '.join(map(str, experiment.seeds))}",
        f"realism metric of {experiment.metric}",
        *([f"in the paper: {experiment.paper}"] if experiment.paper else []),
    ]
    body = [
        element("p", experiment.question, class_="question"),
        hint("; ".join(about) + "."),
        tabs(panels, f"decoding-{experiment.name}"),
        gallery([chart for chart in charts if chart is not None]),
        likelihood_table(experiment),
        folded("command, configuration, versions and machine", _made(experiment)),
    ]
    return Section(f"experiment-{experiment.name}", experiment.title, joined(body))


def differences(experiment: Experiment) -> Chart | None:
    """Forest of paired differences at both decodings; None where nothing was compared."""
    groups = {
        "own best": _differences(experiment, experiment.own_best, experiment.chosen.get(REFERENCE)),
        "common": _differences(experiment, experiment.at_common, experiment.common),
    }
    groups = {kind: found for kind, found in groups.items() if found}
    if not groups:
        return None
    caption = (
        "Paired scene by scene; blue is better, orange worse, grey not told apart. Full: own best decodings. Hollow: "
        "the common decoding, where the reference at other decodings shows what sampling alone does."
    )
    title = "Realism minus that of the reference, 95 % intervals"
    return forest(groups, title, x="difference in realism", caption=caption)


def matched_curves(experiment: Experiment, colours: Mapping[str, str]) -> list[Chart]:
    """Realism against the spread of rollouts, over the decodings tried: methods compare at equal sharpness."""
    content = []
    for method in experiment.methods:
        records = Comparison([row for row in experiment.tuning if row["method"] == method], []).records()
        known = [r for r in records if r.get("spread") is not None and r["realism"] is not None]
        known.sort(key=lambda record: record["spread"])
        if not known:
            continue
        label, chosen = experiment.label(method), experiment.chosen.get(method)
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
                    )
                    for record in known
                ],
                dash="dot" if method == REFERENCE else "solid",
                markers=[15 if decoding_of(record) == chosen else 6 for record in known],
                opacity=0.45 if "@" in method else 1.0,
            )
        )
    if not any(len(line.x) > 1 for line in content):
        return []
    caption = (
        "Every decoding of the grid, mean over seeds; the large marker is the one chosen. Left is sharper sampling. A "
        "method that only samples more sharply lies on the line of the reference."
    )
    title = "Realism against sharpness of sampling, tuning scenes"
    return [curves(content, title, x="distance between the rollouts of a scene [m]", y="realism", caption=caption)]


def _panel(experiment: Experiment, comparison: Comparison, evaluations: Evaluations) -> Html:
    parts = [_main_table(experiment, comparison), safety_table(experiment, comparison, evaluations)]
    return joined(part for part in parts if part)


def _main_table(experiment: Experiment, comparison: Comparison) -> Html:
    records = _ordered(experiment, comparison)
    columns = [column for column in COLUMNS if column.key in MAIN]
    head = ["method", "decoding", *(f"{column.title}\N{NO-BREAK SPACE}{column.better}" for column in columns)]
    head += [DIFFERENCE_TITLE, "seeds"]
    rows, shown = [], set()
    for record in records:
        method = record["method"]
        # The paper has one decoding for each method: its numbers stand at the first row only.
        published = {} if method in shown else experiment.published.get(method, {})
        shown.add(method)
        cells = [_beside(number(record[c.key], c.digits), published.get(c.key), c.digits) for c in columns]
        files = [row["file"] for row in comparison.of(method, decoding_of(record))]
        change = interval(record["realism_difference"], record["ci95"])
        rows.append([experiment.label(method), in_words(decoding_of(record)), *cells, change, sources(files)])
    quiet = " In grey: the paper's numbers, from its own data and scale." if experiment.published else ""
    note = (
        f"Means over seeds on {experiment.scenes['eval']} evaluation scenes; Δ in bold where its interval does not "
        f"contain 0; arrows point to better values.{quiet}"
    )
    return joined([table(head, rows), hint(note)])


def _beside(text: str, published: float | None, digits: int) -> Html:
    if published is None:
        return html(text)
    return joined([text, element("small", number(published, digits), title="published")], "")


def _differences(experiment: Experiment, comparison: Comparison, base: Any) -> dict[str, Difference]:
    found = {}
    for entry in _in_order(experiment, comparison.paired):
        method, decoding = entry["method"], decoding_of(entry)
        against = (float(entry["against_top_p"]), float(entry["against_temperature"]))
        seeds = _by_seed(comparison, method, decoding, against)
        name = experiment.label(method) + (f",\n{in_words(decoding)}" if method == REFERENCE else "")
        found[name] = Difference(
            entry["realism_difference"],
            *entry["ci95"],
            hover=[
                f"{in_words(decoding)}, against the reference at {in_words(against)}",
                f"{entry['n_seeds']} seeds, interval over {entry['over']}",
                *([f"by seed: {', '.join(map(signed, seeds))}"] if seeds else []),
            ],
        )
    return found


def _by_seed(comparison: Comparison, method: str, decoding: Any, against: Any) -> list[float]:
    """Difference of the means of each seed, where both rows stand in the comparison."""
    base = {row["seed"]: row.get("realism") for row in comparison.of(REFERENCE, against)}
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
    """Command, versions and configuration of an experiment."""
    named = {
        "numbers": element("code", f"experiments/{experiment.path.name}"),
        "date": experiment.date or MISSING,
        "machine": experiment.machine or MISSING,
        "wall time": duration(experiment.wall_seconds),
        "stages": ", ".join(f"{name} {duration(spent)}" for name, spent in experiment.stages.items()) or MISSING,
        "versions": ", ".join(f"{name} {version}" for name, version in experiment.versions.items()),
    }
    config = json.dumps(experiment.config, indent=2, ensure_ascii=False, allow_nan=False)
    return joined([command(experiment.command), facts(named), folded("configuration", element("pre", config))])
