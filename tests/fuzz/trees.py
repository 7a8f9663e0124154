"""Edits of JSON: any value may become any other, and keys may be missing, strange or there twice."""

from __future__ import annotations

import json
from copy import deepcopy
from random import Random
from typing import Any

_MARK = "\x00raw{}\x00"
RAW = (
    "NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1e308", "-0.0", "1e-320", "1E7", "10000000.0001",
    "9" * 30, "-9223372036854775809", "18446744073709551616", "1.0", "1e3",
    "[" * 50 + "]" * 50, "[" * 900 + "]" * 900, '{"a":' * 800 + "1" + "}" * 800,
    '{"x": 1, "x": null, "y": 2, "y": [], "z": 3}', r'"\ud800"', r'"\ud83d\ude00"', r'"\u0000"', r'"\udc00\ud800"',
)  # fmt: skip
"""Values as text, for what a JSON writer would not write."""
NO_JSON = (
    "[" * 100_000, "[" * 100_000 + "]" * 100_000, '{"a":' * 100_000 + "1" + "}" * 100_000,
    "9" * 5000, "nul", "", "'x'", "0x10", "+1", "01", ".5", "[1,]", "//",
)  # fmt: skip
VALUES = (
    None, True, False, 0, 1, -1, 91, 2**31, 2**53, 2**63, -(2**63), 1e7, -1e7, 0.5, "", "x", "0", "NaN", " ", "\u202e",
    "\x00", "/../..", "a\nb", "é" * 300, "x" * 100_000, [], {}, [[]], [None], {"": None}, {"x": 1}, [{}], "vehicle",
)  # fmt: skip
KEYS = ("", "--1", "-1", "²", "٣", "0" * 60 + "7", "9" * 40, "5[7", "]", "a.b", "\x00", "x" * 5000, "１２", "\u202e")


class Broken:
    """A tree together with the pieces of text that replace some of its values once it is written."""

    def __init__(self, tree: Any) -> None:
        self.tree = tree
        self._raw: list[str] = []

    def raw(self, text: str) -> str:
        """A stand-in for some text."""
        self._raw.append(text)
        return _MARK.format(len(self._raw) - 1)

    def text(self) -> bytes:
        """The tree as JSON."""
        text = json.dumps(self.tree)
        for number, raw in enumerate(self._raw):
            text = text.replace(json.dumps(_MARK.format(number)), raw)
        return text.encode()


def edit_json(data: bytes, r: Random) -> bytes:
    """Some edits of a JSON file; of a file that is none any more, its bytes."""
    try:
        broken = Broken(json.loads(data))
    except (RecursionError, ValueError):
        return data[: r.randrange(len(data) + 1)]
    for _ in range(r.choice((1, 1, 1, 2, 5))):
        _edit_tree(broken, r)
    return broken.text()


def _edit_tree(broken: Broken, r: Random) -> None:
    parent, key = _place(broken.tree, r)
    if parent is None:
        broken.tree = _value(broken, r)
        return
    edit = r.choice((_replace, _replace, _replace, _remove, _rename, _resize, _nudge))
    edit(broken, parent, key, r)


def _place(tree: Any, r: Random) -> tuple[Any, Any]:
    """A container somewhere in the tree and a key of it; nothing for the top itself."""
    parent, key, value = None, None, tree
    while isinstance(value, dict | list) and value and (parent is None or r.random() < 0.9):
        if parent is None and r.random() < 0.01:
            break
        parent, key = value, r.choice([*value]) if isinstance(value, dict) else r.randrange(len(value))
        value = parent[key]
    return parent, key


def _value(broken: Broken, r: Random) -> Any:
    texts = r.choices((RAW, NO_JSON, None), (6, 1, 12))[0]
    return broken.raw(r.choice(texts)) if texts else deepcopy(r.choice(VALUES))  # edits may go into it


def _replace(broken: Broken, parent: Any, key: Any, r: Random) -> None:
    parent[key] = _value(broken, r)


def _remove(broken: Broken, parent: Any, key: Any, r: Random) -> None:
    del parent[key]


def _rename(broken: Broken, parent: Any, key: Any, r: Random) -> None:
    if isinstance(parent, dict):
        name = broken.raw(r'"\ud800"') if r.random() < 0.1 else r.choice((*KEYS, *parent))
        value = parent[key] if r.random() < 0.3 else parent.pop(key)
        parent[name] = value
    else:
        parent.insert(r.randrange(len(parent) + 1), parent[key])


def _resize(broken: Broken, parent: Any, key: Any, r: Random) -> None:
    """Empty a list or object, cut it, or fill it with a thousand times the same."""
    value = parent[key]
    if isinstance(value, list) and value:
        parent[key] = r.choice((value[:-1], value[:1], [], value * r.choice((2, 1000 // len(value) + 1)), value[::-1]))
    elif isinstance(value, dict) and value:
        one = next(iter(value.values()))
        parent[key] = r.choice(({}, {str(number): one for number in range(r.choice((10, 1000)))}, [*value.values()]))
    else:
        parent[key] = [value] * r.choice((0, 1, 91, 1000))


def _nudge(broken: Broken, parent: Any, key: Any, r: Random) -> None:
    """A number that may pass as sound."""
    value = parent[key]
    if isinstance(value, bool):
        parent[key] = not value
    elif isinstance(value, int | float):
        parent[key] = value + r.choice((-1, 1, 1e-3, 1e3, -value, 9e6 - value, -9e6 - value, 2**40))
    else:
        _replace(broken, parent, key, r)
