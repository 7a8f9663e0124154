"""XML files of a user, read without trusting them: no document types, so no entities that grow or reach out."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path
from xml.etree import ElementTree

from envs.scene import SceneError

CHUNK = 1 << 20
"""Bytes that are parsed at once."""


class _Refusal(Exception):
    """The file has a document type."""


class Listener:
    """Hears of every element of a file; override what is of use (see ``xml.etree.ElementTree.XMLParser``)."""

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        """A document type begins: entities could follow."""
        raise _Refusal

    def start(self, tag: str, attributes: dict[str, str]) -> object:
        """An element begins."""

    def end(self, tag: str) -> object:
        """An element ends."""

    def data(self, text: str) -> object:
        """Text."""

    def close(self) -> object:
        """The file ends; what is returned here is what :func:`scan_xml` returns."""


class _Tree(ElementTree.TreeBuilder):
    doctype = Listener.doctype


def scan_xml(path: Path, listener: object, what: str) -> object:
    """Tell a listener of every element of a file.

    Args:
        path: plain or ``.gz``.
        listener: see :class:`Listener`.
        what: the file should be, for errors.

    Returns:
        What the listener's ``close`` returns.

    Raises:
        SceneError: no such file, no XML, or one with a document type; the message names the file and the fix.
    """
    parser = ElementTree.XMLParser(target=listener)
    opened = gzip.open if path.name.endswith(".gz") else open
    try:
        with opened(path, "rb") as file:
            while chunk := file.read(CHUNK):
                parser.feed(chunk)
        return parser.close()
    except _Refusal:
        raise SceneError(
            f"{path}: has a <!DOCTYPE>, which no file of SUMO has, and is not read; remove it if you trust the file."
        ) from None
    except (ElementTree.ParseError, OSError, EOFError, zlib.error) as error:
        raise SceneError(f"{path}: cannot be read as {what} ({error}); give a file that SUMO wrote.") from error


def read_xml(path: Path, what: str) -> ElementTree.Element:
    """The root of a file.

    Args:
        path: plain or ``.gz``.
        what: the file should be, for errors.

    Raises:
        SceneError: see :func:`scan_xml`.
    """
    return scan_xml(path, _Tree(), what)
