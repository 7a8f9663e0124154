"""A page as its reader gets it: text, attributes, tables, and whether the HTML is whole."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from typing import Any

VOID = {"meta", "br", "img", "input", "hr", "link"}


class Page(HTMLParser):
    """Checks that every element is closed in order, and collects what a page shows.

    Attributes:
        text: outside scripts and styles.
        attributes: element, name, value.
        tables: rows of cells of each table.
        data: content of each JSON in the page.
    """

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.pieces: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.tables: list[list[list[str]]] = []
        self.data: list[Any] = []
        self.is_json = False
        self.feed(text)
        self.close()
        assert self.open == []

    @property
    def text(self) -> str:
        return " ".join("".join(self.pieces).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        self.is_json = ("type", "application/json") in attrs
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing, open are {self.open}"

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["script"]:
            if self.is_json:
                self.data.append(json.loads(data))
        elif self.open[-1:] != ["style"]:
            self.pieces.append(data)
            if {"td", "th"} & set(self.open):
                self.tables[-1][-1][-1] += data
