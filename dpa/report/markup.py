"""Pieces of HTML: text is escaped unless it is marked as HTML."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import resources
from typing import NamedTuple

from dpa.report.statistics import verdict
from dpa.report.table import difference, signed


class Html(str):
    """Text that is HTML already."""

    __slots__ = ()


class Section(NamedTuple):
    """A part of the page.

    Attributes:
        name: anchor in the page, unique.
        title: in the index and as heading.
        body: what it shows.
        headed: the body lacks a heading of its own.
    """

    name: str
    title: str
    body: Html
    headed: bool = True


def html(text: object) -> Html:
    """Text as HTML.

    Examples:
        >>> html("a < b"), html(Html("<b>a</b>")), html(3)
        ('a &lt; b', '<b>a</b>', '3')
    """
    return text if isinstance(text, Html) else Html(escape(str(text)))


def joined(parts: Iterable[object], between: str = "\n") -> Html:
    """Parts one after the other."""
    return Html(between.join(html(part) for part in parts))


def element(tag: str, *parts: object, **attributes: str | bool) -> Html:
    """An element; ``True`` stands for an attribute without a value, and a trailing underscore is left out of names.

    Examples:
        >>> element("p", "a < b", class_="hint")
        '<p class="hint">a &lt; b</p>'
    """
    texts = []
    for name, value in attributes.items():
        name = name.rstrip("_").replace("_", "-")
        if value is True:
            texts.append(f" {name}")
        elif value is not False:
            texts.append(f' {name}="{escape(value)}"')
    return Html(f"<{tag}{''.join(texts)}>{joined(parts, '')}</{tag}>")


def table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> Html:
    """A table that scrolls within its box.

    Args:
        head: titles of the columns.
        rows: cells; the first of a row names it.
    """
    # A title may wrap between words, so that the table fits a screen; a hyphen is no such place.
    titles = [element("th", Html(html(title).replace("-", "&#8209;")), scope="col") for title in head]
    body = []
    for name, *cells in rows:
        texts = [element("th", name, scope="row"), *(element("td", cell) for cell in cells)]
        body.append(element("tr", *texts))
    content = element("table", element("thead", element("tr", *titles)), element("tbody", joined(body)))
    return element("div", content, class_="wide", tabindex="0")


def facts(named: Mapping[str, object]) -> Html:
    """Names and values."""
    pairs = (element("dt", name) + element("dd", value) for name, value in named.items())
    return element("dl", joined(map(Html, pairs)))


def tabs(panels: Mapping[str, Html], name: str) -> Html:
    """Panels of which one is shown; without a script all are, one below the other. A single one needs no tabs.

    Args:
        panels: by title.
        name: unique in the page.
    """
    if len(panels) == 1:
        return next(iter(panels.values()))
    buttons = [
        element(
            "button", title, type="button", role="tab", id=f"{name}-tab-{place}", aria_controls=f"{name}-{place}",
            aria_selected="true" if place == 0 else "false",
        )
        for place, title in enumerate(panels)
    ]  # fmt: skip
    shown = [
        element("div", panel, role="tabpanel", id=f"{name}-{place}", aria_labelledby=f"{name}-tab-{place}")
        for place, panel in enumerate(panels.values())
    ]
    return element("div", element("div", *buttons, role="tablist"), *shown, class_="tabs")


def folded(title: object, *parts: object, open_: bool = False) -> Html:
    """Parts that are shown on request."""
    return element("details", element("summary", title), *parts, open=open_)


def hint(text: object) -> Html:
    """A quiet remark."""
    return element("p", text, class_="hint")


def command(text: str) -> Html:
    """A command line."""
    return element("pre", element("code", text))


def interval(mean: float, ci95: Sequence[float], over: str) -> Html:
    """A difference with its interval, standing out where something may be said of it."""
    return _weighed(difference(mean, ci95), ci95, over)


def quiet(mean: float, ci95: Sequence[float], over: str, digits: int = 3) -> Html:
    """A difference with its interval below the value that it belongs to; otherwise as :func:`interval`."""
    ends = f"[{signed(ci95[0], digits)}, {signed(ci95[1], digits)}]"
    return element("small", _weighed(signed(mean, digits), ci95, over), Html("<br>"), ends)


def stacked(mean: float, ci95: Sequence[float], over: str) -> Html:
    """A difference above its interval, for a narrow column; otherwise as :func:`interval`."""
    ends = element("small", f"[{signed(ci95[0])}, {signed(ci95[1])}]")
    return joined([_weighed(signed(mean), ci95, over), ends], "")


def _weighed(text: str, ci95: Sequence[float], over: str) -> Html:
    return html(text) if verdict(ci95, over) == "open" else element("strong", text)


def sources(files: Sequence[str]) -> Html:
    """How many files a row is the mean of, with their names in the folder of the study."""
    names = joined((element("code", file) for file in files), "<br>")
    return element("details", element("summary", str(len(files))), names, class_="files")


def filled(template: str, parts: Mapping[str, str]) -> Html:
    """Fill a template's ``<!--{name}-->`` marks in one pass, so that what is put in is never searched for marks."""
    return Html(re.sub(r"<!--\{(\w+)\}-->", lambda mark: parts[mark[1]], resource(template)))


def resource(name: str) -> str:
    """Text of a file of this package."""
    return resources.files("dpa.report").joinpath(name).read_text(encoding="utf-8")


def in_script(json_text: str) -> Html:
    """JSON as it may stand in a script element."""
    # Inside a script element only these could end it or open a comment; JSON may write any character as an escape.
    for character in "<>&":
        json_text = json_text.replace(character, f"\\u{ord(character):04x}")
    return Html(json_text)
