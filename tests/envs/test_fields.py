"""Typed questions to decoded JSON."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from envs.scene import SceneError
from envs.sources.fields import LARGEST_ID, Field, shown


def field(value: Any, path: str = "a.b") -> Field:
    return Field(value, "file.json, record 0", path)


def test_values_come_back_as_they_are() -> None:
    top = Field({"n": 2, "x": -1.5, "t": "text", "f": False, "l": [1, 2]}, "file.json")
    assert top["n"].integer() == 2
    assert top["n"].number() == 2.0 and isinstance(top["n"].number(), float)
    assert top["x"].number() == -1.5
    assert top["t"].text() == "text"
    assert top["f"].flag() is False
    assert [item.integer() for item in top["l"].items()] == [1, 2]
    assert [entry.path for entry in top.entries()] == ["[n]", "[x]", "[t]", "[f]", "[l]"]


def test_an_entry_may_be_absent() -> None:
    assert field({}).get("x") is None
    assert field({"x": None}).get("x").value is None


@pytest.mark.parametrize(
    ("ask", "value", "message"),
    [
        (Field.number, "abc", "a.b is 'abc'; must be a number"),
        (Field.number, True, "a.b is True; must be a number"),
        (Field.number, None, "a.b is None; must be a number"),
        (Field.number, math.nan, "a.b is nan; must be a finite number"),
        (Field.number, -math.inf, "a.b is -inf; must be a finite number"),
        (Field.number, 10**400, "must be a finite number"),
        pytest.param(Field.number, 10**5000, "a number of about 5000 digits; must be a finite number", id="endless"),
        (Field.number, 1.1e7, "between -1e\\+07 and 1e\\+07"),
        (Field.integer, 1.0, "must be a whole number"),
        (Field.integer, True, "must be a whole number"),
        (Field.integer, -1, "from 0 to"),
        (Field.integer, LARGEST_ID + 1, "from 0 to"),
        (Field.text, 5, "a.b is 5; must be text"),
        (Field.flag, 1, "must be true or false"),
        (Field.items, {}, "must be a list"),
        (Field.entries, [], "must be an object"),
        (lambda item: item["x"], 3, "a.b is 3; must be an object"),
        (lambda item: item["x"], {}, "a.b.x is missing"),
        (lambda item: item.items(at_least=2), [1], "a.b has 1 items; must have 2 or more"),
        (lambda item: item.table("x", at_least=2), [{"x": 1}], "a.b has 1 items; must have 2 or more"),
        (lambda item: item.table("x"), 7, "a.b is 7; must be a list"),
        (lambda item: item.table("x", "y"), [{"x": 1, "y": 1}, {"x": 1}], r"a.b\[1\].y is missing"),
        (lambda item: item.table("x"), [{"x": 1}, "z"], r"a.b\[1\] is 'z'; must be an object"),
        (lambda item: item.table("x"), [{"x": [1]}], r"a.b\[0\].x is \[1\]; must be a number"),
        (lambda item: item.table("x"), [{"x": False}], r"a.b\[0\].x is False; must be a number"),
        (lambda item: item.table("x"), [{"x": 1}, {"x": math.nan}], r"a.b\[1\].x is nan; must be a finite"),
        (lambda item: item.table("x"), [{"x": 10**400}], r"a.b\[0\].x is 1000.*; must be a finite"),
    ],
)
def test_a_wrong_value_is_named_with_its_path(ask, value: Any, message: str) -> None:
    with pytest.raises(SceneError, match=rf"^file\.json, record 0: .*{message}"):
        ask(field(value))


def test_a_table_has_a_row_for_each_object() -> None:
    table = field([{"x": 1, "y": 2.5, "more": "text"}, {"x": 3, "y": 4}]).table("y", "x")
    assert table.dtype == np.float64
    assert table.tolist() == [[2.5, 1], [4, 3]]
    assert field([]).table("x", "y").shape == (0, 2)


def test_an_error_stays_short_whatever_the_value() -> None:
    deep = json.loads("[" * 300 + "]" * 300)
    for value in ("x" * 10_000, [list(range(1000))] * 1000, deep):
        with pytest.raises(SceneError) as caught:
            field(value).number()
        assert len(str(caught.value)) < 400
    with pytest.raises(SceneError) as caught:
        field({"k" * 10_000: 1}).entries()[0].text()
    assert len(str(caught.value)) < 400


if __name__ == "__main__":
    pytest.main([__file__])


def test_a_value_of_any_depth_is_shown_in_a_part_of_a_line() -> None:
    point = {"x": -2292.0485964632376, "y": -9414.106851291828, "z": -39.45788746194938}
    assert len(shown([{"geometry": [point] * 9, "type": "road_edge"}] * 9)) < 250
