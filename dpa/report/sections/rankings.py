"""Studies of rankings: a distance and realism (figure 3 of the paper), its options, and a discriminator (figure 10)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from dpa.report.canvas import CYCLE
from dpa.report.charts import Chart, Difference, Line, curves, forest, gallery, heat, lines
from dpa.report.markup import Html, Section, element, hint, html, interval, joined, table
from dpa.report.sections.origin import origin, scope
from dpa.report.statistics import SCENES, SEEDS_AND_SCENES
from dpa.report.table import MINUS, MISSING, difference, number

Value = Mapping[str, Any]
"""``{"mean", "ci95", "scenes"}``, as the studies write an interval."""


def validity_section(found: Mapping[str, Any]) -> Section:
    """Realism of windows of rollouts against their distance, for each ranking.

    Args:
        found: ``validity/summary.json`` of a study.
    """
    rankings = found["rankings"]
    columns = {"correlation": "Spearman", "near_half": "nearer half", "nearest": "nearest window",
               "farthest": "farthest window"}  # fmt: skip
    paired = list(columns)[1:]
    parts = [
        element(
            "p",
            "Are the rollouts that a distance calls near to the log also the more realistic ones?",
            class_="question",
        ),
        scope(found),
        gallery(_validity_charts(rankings)),
        table(
            ["ranking", *columns.values()],
            [[name, *(_cell(v[key], found) for key in columns)] for name, v in rankings.items()],
        ),
    ]
    if found.get("differences"):
        parts += [
            element("h3", f"The same minus {found['minus']}"),
            table(
                ["ranking", *(columns[key] for key in paired)],
                [[name, *(_cell(v[key], found) for key in paired)] for name, v in found["differences"].items()],
            ),
        ]
    return Section("validity", "Does the distance tell realism?", joined([*parts, origin("validity", found)]))


def _validity_charts(rankings: Mapping[str, Any]) -> list[Chart]:
    content = []
    for place, (name, values) in enumerate(rankings.items()):
        x, y = [window["mean"] for window in values["distance"]], values["realism"]
        content.append(
            Line(
                name,
                x,
                [window["mean"] for window in y],
                CYCLE[place % len(CYCLE)],
                hover=[
                    lines(
                        name, f"realism {_text(window)}", f"distance {at:.2f} of the scene's mean, window {number_ + 1}"
                    )
                    for number_, (at, window) in enumerate(zip(x, y, strict=True))
                ],
                markers=6,
                band=([window["ci95"][0] for window in y], [window["ci95"][1] for window in y]),
            )
        )
    keys = {"all windows": "correlation", "nearer half": "near_half"}
    groups = {name: {row: _difference(values[key]) for row, key in keys.items()} for name, values in rankings.items()}
    return [
        curves(
            content,
            "Realism of a window of rollouts",
            x="distance over the scene's mean",
            y="realism minus that of random rollouts",
            caption="Rollouts of a scene sorted by each distance, a window slid from the nearest to the farthest.",
            zero=True,
        ),
        forest(
            groups,
            "Rank correlation of distance and realism within a scene",
            x="Spearman, 95 % intervals",
            caption=f"{MINUS}1 is best: the nearer a window, the more realistic.",
            colours={line.name: line.colour for line in content},
        ),
    ]


def sensitivity_section(found: Mapping[str, Any]) -> Section:
    """How far variants of the distance rank as it does.

    Args:
        found: ``sensitivity/summary.json`` of a study.
    """
    variants, margins, rollouts = found["variants"], found["margins"], found["rollouts"]
    agreement = {name: _difference(values["correlation"]) for name, values in variants.items()}
    names = list(variants)
    shares = [[margin[name]["mean"] for margin in margins.values()] for name in names]
    told = [
        [lines(name, f"gap {title}", f"share {_plain(margin[name])}") for title, margin in margins.items()]
        for name in names
    ]
    sizes = [float(size) for size in rollouts]
    pairs = [
        Line(
            title, sizes, [values[key]["mean"] for values in rollouts.values()], CYCLE[place], markers=7,
            band=([v[key]["ci95"][0] for v in rollouts.values()], [v[key]["ci95"][1] for v in rollouts.values()]),
            hover=[lines(title, _plain(values[key]), f"{size} rollouts") for size, values in rollouts.items()],
        )
        for place, (key, title) in enumerate(
            (("margin", "margin of a pair over the scene's mean"), ("ade_agrees", "share that ADE orders alike"))
        )
    ]  # fmt: skip
    charts = [
        forest(
            {"Spearman": agreement}, "Rank correlation with the distance", x="Spearman, 95 % intervals",
            colours={"Spearman": CYCLE[0]},
        ),
        heat(
            shares, names, list(margins), "Share of pairs in the same order", low=0.5, high=1.0, hover=told,
            x="gap of the pair",
            caption="By the gap of a pair's distances over the scene's mean; half of the pairs agree by chance.",
        ),
        curves(
            pairs, "Pairs of the nearest and farthest quarter", x="rollouts of a scene", y="share", log_x=True,
            caption="What these pairs are like when a scene has fewer rollouts.",
        ),
    ]  # fmt: skip
    columns = {"correlation": "Spearman", "overlap": "same nearest quarter", "turned": "pairs turned round"}
    seconds = found["seconds"]
    rows = [
        [name, *(_plain(values[key]) for key in columns), number(seconds.get(name), 3)]
        for name, values in variants.items()
    ]
    parts = [
        element("p", "What do the options of the preference distance change?", class_="question"),
        scope(found),
        gallery(charts),
        table(["variant", *columns.values(), "s per scene"], rows),
        hint("Means over scenes and policies with 95 % intervals; time of the processor for ranking one scene."),
    ]
    return Section("sensitivity", "What the options change", joined([*parts, origin("sensitivity", found)]))


def discriminator_section(found: Mapping[str, Any]) -> Section:
    """What a discriminator of log and rollouts ranks by (figure 10 of the paper).

    Args:
        found: ``discriminator/summary.json`` of a study.
    """
    correlation, realism, labels = found["correlation"], found["realism"], found["labels"]
    kinds = list(next(iter(correlation.values())))
    shades = {kind: "#8b9096" if kind == "random" else CYCLE[place] for place, kind in enumerate(kinds)}
    groups = {
        kind: {labels[q]: _difference(values[kind]) for q, values in correlation.items() if values[kind] is not None}
        for kind in kinds
    }
    ends = {"best quarter": "best", "worst quarter": "worst"}
    quarters = {
        kind: {row: _difference(values[end]["realism"]) for row, end in ends.items()}
        for kind, values in realism.items()
    }
    charts = [
        forest(
            groups, "Rank correlation of a score with what a rollout does", x="Spearman, 95 % intervals",
            caption="Within a scene; below 0 the ranking prefers less of it.", colours=shades,
        ),
        forest(
            quarters, "Realism of the rollouts that a ranking prefers", x="realism minus that of random rollouts",
            colours={kind: shades[kind] for kind in quarters},
        ),
    ]  # fmt: skip
    head = ["within a scene", *kinds]
    rows = [[labels[q], *(_cell(values[kind], found) for kind in kinds)] for q, values in correlation.items()]
    chance = {name: _plain(value) for name, value in found["auc"].items()}
    held_out = [f"{name} {number(run['best']['held_out_auc'], 3)}" for name, run in found["policies"].items()]
    parts = [
        element("p", "What does a discriminator of logs and rollouts rank rollouts by?", class_="question"),
        scope(found),
        gallery(charts),
        table(head, rows),
        hint(
            "How much more strongly by jerk than by the preference distance: "
            f"{_text(found['jerk_minus_distance'])}. Share of rollouts below the log: by the discriminator "
            f"{chance['discriminator']}, by jerk alone {chance['jerk']}. "
            f"Held-out AUC for each policy, the best of all looks, by which training stops: {', '.join(held_out)}."
        ),
    ]
    return Section("discriminator", "What a discriminator ranks by", joined([*parts, origin("discriminator", found)]))


def _difference(value: Value) -> Difference:
    return Difference(value["mean"], *value["ci95"], hover=[f"{value['scenes']} scenes"])


def _cell(value: Value | None, found: Mapping[str, Any]) -> Html:
    if value is None:
        return html(MISSING)
    over = SCENES if len(found["made"]["policies"]) == 1 else SEEDS_AND_SCENES
    return interval(value["mean"], value["ci95"], over)


def _text(value: Value) -> str:
    return difference(value["mean"], value["ci95"])


def _plain(value: Value | None) -> str:
    """A mean with its interval, without signs."""
    if value is None:
        return MISSING
    low, high = value["ci95"]
    return f"{number(value['mean'], 3)} [{number(low, 3)}, {number(high, 3)}]"
