"""Interactive figures: what the page's figures share, and the kinds of figures that it has.

A figure is a :class:`Chart`, plain data of Plotly; the page holds Plotly's code once and draws each when it is shown.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any, NamedTuple

import plotly.graph_objects as go

from dpa.report.canvas import CYCLE, INK, QUIET, RULE, VERDICTS
from dpa.report.markup import Html, element, in_script, joined
from dpa.report.table import REFERENCE, difference

FONT = 'system-ui, -apple-system, "Segoe UI", Roboto, sans-serif'
DIGITS = 5
"""Significant digits of a number in a figure."""
ROW_HEIGHT, LEGEND_HEIGHT = 34, 24
"""Of a row of a forest and of a row of a legend [pixels]."""


class Chart(NamedTuple):
    """A figure of the page.

    Attributes:
        figure: traces and layout.
        title: above it; also what a screen reader says.
        caption: below it.
        height: [pixels].
    """

    figure: go.Figure
    title: str
    caption: str = ""
    height: int = 360


class Difference(NamedTuple):
    """A difference to a reference with its interval.

    Attributes:
        mean: the difference.
        low: end of the 95 % interval.
        high: other end.
        verdict: what may be said of it; see :func:`~dpa.report.statistics.verdict`.
        hover: what is told of it, line by line.
    """

    mean: float
    low: float
    high: float
    verdict: str = "open"
    hover: Sequence[str] = ()

    @property
    def colour(self) -> str:
        """Better, worse, or not told apart."""
        return VERDICTS[self.verdict]

    @property
    def text(self) -> str:
        """Of the hover label."""
        return lines(difference(self.mean, (self.low, self.high)), *self.hover)


class Line(NamedTuple):
    """One line of a figure.

    Attributes:
        name: in the legend.
        x: positions.
        y: values, as many.
        colour: of line and markers.
        hover: text at each point; by default the values.
        dash: of the line.
        width: of the line [pixels]; 0 for markers alone.
        markers: sizes, one for each point or for all; 0 for none.
        band: lower and upper values, as many as ``x``.
        error: differences from ``y`` up and down, as many as ``x``.
        text: written beside each point.
        legend: it stands in the legend.
        opacity: of the line.
    """

    name: str
    x: Sequence[float]
    y: Sequence[float | None]
    colour: str
    hover: Sequence[str] | None = None
    dash: str = "solid"
    width: float = 2.0
    markers: float | Sequence[float] = 0
    band: tuple[Sequence[float], Sequence[float]] | None = None
    error: tuple[Sequence[float], Sequence[float]] | None = None
    text: Sequence[str] | None = None
    legend: bool = True
    opacity: float = 1.0


def palette(methods: Iterable[str], fixed: Mapping[str, str] | None = None) -> dict[str, str]:
    """A colour for each method; a snapshot has that of its method.

    Args:
        methods: of an experiment.
        fixed: colours that methods have elsewhere on the page, and keep.

    Examples:
        >>> palette(["reference", "dpa_omf", "dpa_omf@60"])
        {'reference': '#3c4043', 'dpa_omf': '#2a78b5', 'dpa_omf@60': '#2a78b5'}
        >>> palette(["reference", "collision only", "dpa_omf"], {"dpa_omf": "#2a78b5"})["collision only"]
        '#d55e00'
    """
    methods, fixed = list(methods), {REFERENCE: INK} | dict(fixed or {})
    bases = list(dict.fromkeys(method.partition("@")[0] for method in methods))
    taken = {fixed[name] for name in bases if name in fixed}
    free = itertools.cycle([colour for colour in CYCLE[:-1] if colour not in taken] or CYCLE)
    colours = {name: fixed[name] if name in fixed else next(free) for name in bases}
    return {method: colours[method.partition("@")[0]] for method in methods}


def lines(*texts: str) -> str:
    """Lines of a hover label; what is put in is text, never markup."""
    return "<br>".join(escape(text, quote=False) for text in texts)


def forest(
    groups: Mapping[str, Mapping[str, Difference]], title: str, *, x: str, caption: str = "",
    colours: Mapping[str, str] | None = None,
) -> Chart:  # fmt: skip
    """Values with their intervals, row by row.

    Args:
        groups: for each kind (a marker of its own) values by row, whose name may have two lines.
        title: above the figure.
        x: what the axis shows.
        caption: below the figure.
        colours: of each kind; by default a colour says whether 0 lies within the interval.
    """
    rows = list(dict.fromkeys(name for values in groups.values() for name in values))
    figure = go.Figure()
    step = min(0.28, 0.8 / len(groups))
    for place, (kind, values) in enumerate(groups.items()):
        shift, told = step * (place - (len(groups) - 1) / 2), escape(kind, quote=False)
        at = {name: rows.index(name) + shift for name in values}
        colour = {name: each.colour if colours is None else colours[kind] for name, each in values.items()}
        for shade in dict.fromkeys(colour.values()):
            ends = [(at[name], each) for name, each in values.items() if colour[name] == shade]
            figure.add_scatter(
                x=[value for _, each in ends for value in (each.low, each.high, None)],
                y=[value for y, _ in ends for value in (y, y, None)],
                mode="lines", line={"color": shade, "width": 2.5}, hoverinfo="skip", showlegend=False, legendgroup=kind,
            )  # fmt: skip
        hovers = [lines(f"{name}, {kind}".replace("\n", " ")) + "<br>" + each.text for name, each in values.items()]
        figure.add_scatter(
            x=[each.mean for each in values.values()], y=list(at.values()), mode="markers", name=told, legendgroup=kind,
            marker=_dot(list(colour.values()), hollow=bool(place) and colours is None), showlegend=False,
            hovertext=hovers, hoverinfo="text",
        )  # fmt: skip
        # The legend tells kinds apart; a colour that means better or worse is not theirs.
        shade = VERDICTS["open"] if colours is None else colours[kind]
        figure.add_scatter(
            x=[None], y=[None], mode="markers", name=told, legendgroup=kind,
            marker=_dot(shade, hollow=bool(place) and colours is None),
        )  # fmt: skip
    ends = [end for values in groups.values() for each in values.values() for end in (each.low, each.high)]
    if colours is None:
        ends.append(0.0)  # what a colour says is read off 0
    room = 0.06 * (max(ends) - min(ends)) or 1.0
    figure.update_layout(
        _layout(len(groups)),
        xaxis={
            **_axis(x), "zeroline": True, "zerolinecolor": QUIET, "zerolinewidth": 1,
            "range": [min(ends) - room, max(ends) + room],
        },
        yaxis={
            "tickvals": list(range(len(rows))), "ticktext": [lines(*row.split("\n")) for row in rows],
            "range": [len(rows) - 0.5, -0.5], "showgrid": False, "zeroline": False, "automargin": True,
            "fixedrange": True,
        },
        hovermode="closest",
    )  # fmt: skip
    height = max(ROW_HEIGHT, 13 * len(groups) + 12)
    return Chart(figure, title, caption, 90 + height * max(len(rows), 2) + LEGEND_HEIGHT * math.ceil(len(groups) / 3))


def _dot(colour: str | list[str], *, hollow: bool) -> dict[str, Any]:
    if hollow:
        return {"size": 10, "color": "white", "line": {"color": colour, "width": 2}}
    return {"size": 10, "color": colour, "line": {"color": "white", "width": 1}}


def curves(
    content: Sequence[Line], title: str, *, x: str, y: str, caption: str = "", log_x: bool = False, zero: bool = False,
    nonnegative: bool = False, height: int = 360,
) -> Chart:  # fmt: skip
    """Lines over an axis, with bands, error bars and markers where a line has them.

    Args:
        content: lines, the later ones on top.
        title: above the figure.
        x: what the axis shows.
        y: what the other shows.
        caption: below the figure.
        log_x: the axis is logarithmic.
        zero: y = 0 is marked.
        nonnegative: y cannot be below 0, so the axis is not either, also where all values are 0.
        height: without the legend [pixels].
    """
    figure = go.Figure()
    for line in content:
        if line.band is not None:
            low, high = line.band
            figure.add_scatter(
                x=[*line.x, *reversed(line.x)], y=[*high, *reversed(low)], fill="toself", fillcolor=line.colour,
                opacity=0.15, line={"width": 0}, hoverinfo="skip", showlegend=False, mode="lines",
                legendgroup=line.name,
            )  # fmt: skip
        figure.add_scatter(**_trace(line))
    named = sum(line.legend for line in content)
    # On a logarithmic axis every place that was measured has its tick: powers of ten are few and far between.
    places = {"type": "log", "tickvals": sorted({at for line in content for at in line.x}), "tickformat": "~g"}
    figure.update_layout(
        _layout(named),
        xaxis={**_axis(x), **(places if log_x else {})},
        yaxis={
            **_axis(y),
            "zeroline": zero,
            "zerolinecolor": QUIET,
            "zerolinewidth": 1,
            "rangemode": "nonnegative" if nonnegative else "normal",
        },
        hovermode="closest",
    )
    return Chart(figure, title, caption, height + (LEGEND_HEIGHT * math.ceil(named / 3) if named > 1 else 0))


def _trace(line: Line) -> dict[str, Any]:
    drawn = (("lines", line.width), ("markers", line.markers), ("text", line.text))
    shown = [mode for mode, there in drawn if there]
    trace: dict[str, Any] = {
        "x": list(line.x), "y": list(line.y), "name": escape(line.name, quote=False), "mode": "+".join(shown),
        "legendgroup": line.name, "showlegend": line.legend, "opacity": line.opacity,
        "line": {"color": line.colour, "width": line.width, "dash": line.dash},
    }  # fmt: skip
    if line.markers:
        sizes = line.markers if isinstance(line.markers, (int, float)) else list(line.markers)
        trace["marker"] = {"size": sizes, "color": line.colour, "opacity": 1, "line": {"color": "white", "width": 1}}
    if line.text is not None:
        texts = [escape(text, quote=False) for text in line.text]
        trace |= {"text": texts, "textposition": "top right", "textfont": {"color": line.colour}}
    if line.error is not None:
        up, down = map(list, line.error)
        trace["error_y"] = {
            "type": "data", "symmetric": False, "array": up, "arrayminus": down, "width": 4, "thickness": 1.4,
        }  # fmt: skip
    if line.hover is not None:
        trace |= {"hovertext": list(line.hover), "hoverinfo": "text"}
    elif not line.legend:
        trace["hoverinfo"] = "skip"
    return trace


def bars(values: Mapping[str, float], title: str, *, x: str, hover: Sequence[str]) -> Chart:
    """Lying bars, the first on top."""
    figure = go.Figure(
        go.Bar(
            x=list(values.values()), y=[escape(name, quote=False) for name in values], orientation="h",
            marker={"color": CYCLE[0]}, hovertext=list(hover), hoverinfo="text", textposition="none",
        )
    )  # fmt: skip
    figure.update_layout(
        _layout(1),
        xaxis=_axis(x),
        yaxis={"autorange": "reversed", "automargin": True, "fixedrange": True, "showgrid": False},
        bargap=0.45,
    )
    return Chart(figure, title, "", 80 + 28 * max(len(values), 2))


def heat(
    values: Sequence[Sequence[float]], rows: Sequence[str], columns: Sequence[str], title: str, *, x: str,
    low: float, high: float, hover: Sequence[Sequence[str]], caption: str = "",
) -> Chart:  # fmt: skip
    """A matrix of numbers, coloured from ``low`` to ``high``."""
    figure = go.Figure(
        go.Heatmap(
            z=[list(row) for row in values], x=[_broken(column) for column in columns],
            y=[escape(row, quote=False) for row in rows], zmin=low, zmax=high, showscale=False, xgap=2, ygap=2,
            colorscale=[[0, "#ffffff"], [1, "#6fa8d6"]], hovertext=[list(row) for row in hover], hoverinfo="text",
            text=[[f"{value:.2f}" for value in row] for row in values], texttemplate="%{text}",
            textfont={"size": 11, "color": INK},
        )
    )  # fmt: skip
    figure.update_layout(
        _layout(1),
        xaxis={**_axis(x), "showgrid": False, "type": "category", "fixedrange": True, "tickangle": 0},
        yaxis={"autorange": "reversed", "automargin": True, "fixedrange": True, "showgrid": False, "type": "category"},
    )
    return Chart(figure, title, caption, 90 + 24 * len(rows))


def _broken(title: str) -> str:
    """A title in two lines, so that many stand side by side on a phone."""
    return escape(title, quote=False).replace(" ", "<br>", 1)


def drawn(chart: Chart) -> Html:
    """A figure as the page's script finds it."""
    data = json.dumps(_rounded(chart.figure.to_plotly_json()), separators=(",", ":"), allow_nan=False)
    return element(
        "figure",
        element("h4", chart.title),
        element("div", class_="plot", role="img", aria_label=chart.title, style=f"height:{chart.height}px"),
        Html(f'<script type="application/json">{in_script(data)}</script>'),
        *([element("figcaption", chart.caption)] if chart.caption else []),
        class_="chart",
    )


def gallery(charts: Sequence[Chart], *, small: bool = False) -> Html:
    """Figures side by side where there is room."""
    return element("div", joined(map(drawn, charts)), class_="gallery small" if small else "gallery")


def _layout(named: int) -> dict[str, Any]:
    """What all figures share.

    Args:
        named: entries of the legend; one alone is not shown.
    """
    return {
        "font": {"family": FONT, "size": 12, "color": INK},
        "margin": {"l": 8, "r": 12, "t": 26, "b": 8},  # on top there is room for the buttons
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "showlegend": named > 1,
        "legend": {"orientation": "h", "x": 0, "xanchor": "left", "xref": "container", "y": 0, "yanchor": "bottom",
                   "yref": "container"},
        "hoverlabel": {"bgcolor": "white", "bordercolor": RULE, "font": {"family": FONT, "size": 12, "color": INK},
                       "align": "left"},
    }  # fmt: skip


def _axis(title: str) -> dict[str, Any]:
    return {
        "title": {"text": escape(title, quote=False), "font": {"size": 12, "color": QUIET}, "standoff": 8},
        "gridcolor": RULE, "linecolor": RULE, "zeroline": False, "automargin": True, "tickfont": {"size": 11},
    }  # fmt: skip


def _rounded(content: Any) -> Any:
    """Plain JSON with as many digits as a picture shows; a NaN has no place in it."""
    if isinstance(content, dict):
        return {key: _rounded(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_rounded(value) for value in content]
    if isinstance(content, float):
        return float(f"{content:.{DIGITS}g}")
    return content
