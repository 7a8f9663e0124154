"""Decoded JSON behind typed questions, so that a wrong value gives one error that names its place.

Files of other people hold text where a number belongs, NaN, lists of lists of lists. A :class:`Field` is a value
together with the path that led to it; whoever asks it for a number gets one or a :class:`~envs.scene.SceneError` like
``scene.json, record 0: lanes[7].left[4].x is 'abc'; must be a number.``
"""

from __future__ import annotations

import json
import math
import re
import reprlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from envs.scene import LARGEST_NUMBER, SceneError

LARGEST_ID = 2**62
"""Ids up to this one fit int64 with room to count on from them."""
MOST_ITEMS = 200_000
"""Of one list or object that is asked item by item; the lists of a scene have some thousands."""
MOST_LETTERS = 200
"""Of a value in an error message."""
_KEY = re.compile(r"-?[0-9]{1,18}")
"""An id as the key of an entry, within int64."""


@dataclass(frozen=True, slots=True)
class Field:
    """One value of a decoded JSON file.

    Attributes:
        value: what the decoder gave.
        name: the file and record, for errors.
        path: how the value was reached from the top, for errors.
        key: of an entry of an object that was asked for all of them.

    Examples:
        >>> top = Field({"lanes": {"7": {"id": 7, "left": [{"x": 1, "y": 2.5}, {"x": "abc", "y": 3}]}}}, "a.json")
        >>> lane = top["lanes"].entries()[0]
        >>> lane["id"].integer()
        7
        >>> lane["left"].table("x", "y")
        Traceback (most recent call last):
        ...
        envs.scene.SceneError: a.json: lanes[7].left[1].x is 'abc'; must be a number.
    """

    value: Any
    name: str
    path: str = ""
    key: str = ""

    def error(self, must: str) -> SceneError:
        """The error that says what the value is and what it ``must`` be."""
        return SceneError(f"{self.name}: {self.path or 'the top level'} is {shown(self.value)}; must {must}.")

    def __getitem__(self, key: str) -> Field:
        """The entry of an object; an error where there is none."""
        found = self.get(key)
        if found is None:
            raise SceneError(f"{self.name}: {self._below(key)} is missing; fetch the file again.")
        return found

    def get(self, key: str) -> Field | None:
        """The entry of an object, or None where there is none."""
        if not isinstance(self.value, dict):
            raise self.error("be an object")
        return Field(self.value[key], self.name, self._below(key)) if key in self.value else None

    def entries(self) -> list[Field]:
        """All values of an object, in the order of the file."""
        if not isinstance(self.value, dict):
            raise self.error("be an object")
        self._check_count(0)
        return [Field(value, self.name, f"{self.path}[{shown(key)[1:-1]}]", key) for key, value in self.value.items()]

    def items(self, at_least: int = 0) -> list[Field]:
        """All values of a list, which must have ``at_least`` so many."""
        if not isinstance(self.value, list):
            raise self.error("be a list")
        self._check_count(at_least)
        return [Field(value, self.name, f"{self.path}[{index}]") for index, value in enumerate(self.value)]

    def _check_count(self, at_least: int) -> None:
        count = len(self.value)
        if count < at_least:
            raise SceneError(f"{self.name}: {self.path} has {count} items; must have {at_least} or more.")
        if count > MOST_ITEMS:
            raise SceneError(f"{self.name}: {self.path} has {count} items; at most {MOST_ITEMS} are read.")

    def number(self, largest: float = LARGEST_NUMBER, *, finite: bool = True) -> float:
        """A finite number of a size that is at most ``largest``; NaN instead of any other one unless ``finite``."""
        if type(self.value) not in (int, float):  # bool is an int to isinstance
            raise self.error("be a number")
        # Compared before it is made a float: an integer of JSON may be too large for one.
        if -largest <= self.value <= largest:
            return float(self.value)
        if finite:
            raise self.error(f"be a finite number between -{largest:g} and {largest:g}")
        return math.nan

    def integer(self, lowest: int = 0, highest: int = LARGEST_ID) -> int:
        """A whole number of a range."""
        if type(self.value) is not int:
            raise self.error("be a whole number")
        if not lowest <= self.value <= highest:
            raise self.error(f"be a whole number from {lowest} to {highest}")
        return self.value

    def key_as_integer(self) -> int:
        """The whole number that is the key of this entry of an object (JSON has no other keys than text)."""
        if not _KEY.fullmatch(self.key):
            raise SceneError(f"{self.name}: the key of {self.path} must be a whole number.")
        return int(self.key)

    def text(self) -> str:
        """A string."""
        if not isinstance(self.value, str):
            raise self.error("be text")
        return self.value

    def flag(self) -> bool:
        """``true`` or ``false``."""
        if not isinstance(self.value, bool):
            raise self.error("be true or false")
        return self.value

    def table(self, *keys: str, at_least: int = 0, finite: bool = True) -> np.ndarray:
        """A list of objects of numbers, such as points.

        Args:
            keys: entries of each object.
            at_least: number of objects that there must be.
            finite: as in :meth:`number`.

        Returns:
            ``[n, len(keys)]`` float64, each checked as :meth:`number` does.
        """
        rows = self._quick_table(keys) if isinstance(self.value, list) and len(self.value) >= at_least else None
        if rows is None:  # asked one by one, so that the error names the place
            rows = np.array(
                [[item[key].number(finite=finite) for key in keys] for item in self.items(at_least)], dtype=np.float64
            )
        return rows.reshape(-1, len(keys))

    def _quick_table(self, keys: tuple[str, ...]) -> np.ndarray | None:
        """The table if all is well with it, or None; ten times as fast as a question for each number."""
        try:
            flat = [item[key] for item in self.value for key in keys]
        except (IndexError, KeyError, TypeError):
            return None
        if not set(map(type, flat)) <= {int, float}:
            return None
        if not all(-LARGEST_NUMBER <= number <= LARGEST_NUMBER for number in flat):
            return None
        return np.array(flat, dtype=np.float64)

    def _below(self, key: str) -> str:
        return f"{self.path}.{key}" if self.path else key


def decode_json(data: bytes, name: str) -> Field:
    """The content of a JSON file.

    Args:
        data: bytes of the file.
        name: what errors call it.

    Raises:
        SceneError: it is no JSON, or nested too deeply.
    """
    try:
        return Field(json.loads(data), name)
    except (RecursionError, ValueError) as error:  # no JSON, no UTF-8, an endless number
        raise SceneError(f"{name}: is no JSON ({one_line(error)}); fetch the file again.") from error


def one_line(error: Exception) -> str:
    r"""What another library says is wrong, as a part of one line.

    Examples:
        >>> one_line(ValueError("no such\ncolumn\n"))
        'no such column'
    """
    text = " ".join(str(error).split())[:300]
    return text if text.isprintable() else ascii(text)


def shown(value: Any) -> str:
    """A value for an error message, cut to a length that a line can hold.

    Examples:
        >>> shown(math.nan), shown("x" * 1000)
        ('nan', "'xxxxxxxxxxxx...xxxxxxxxxxxxx'")
    """
    try:
        text = reprlib.repr(value)
    except ValueError:  # an integer of more digits than Python likes to print
        return f"a number of about {int(math.log10(2) * value.bit_length())} digits"
    return text if len(text) <= MOST_LETTERS else text[:MOST_LETTERS] + "..."
