"""Values of options are judged by the annotations of whoever reads them, and no legitimate one is refused."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import pytest

from dpa.models.scene import ContextOptions
from dpa.realism.config import FOLDER
from dpa.rewards.ranking import RealismRanking
from recipes.common.kinds import check_kinds

if TYPE_CHECKING:
    from somewhere import Something


class Frame(StrEnum):
    SCENE = "scene"


@dataclass(frozen=True)
class Inherited(ContextOptions):
    far: float = float("inf")


class Row(NamedTuple):
    many: int
    name: str = "row"


def sight(
    pieces: int = 4,
    far: float | None = None,
    names: Sequence[str] = (),
    pair: tuple[float, float] = (0.0, 1.0),
    several: tuple[int, ...] = (),
    by_class: Mapping[str, float] | None = None,
    counts: Counter[str] | None = None,
    plain: dict | None = None,
    frame: Frame = Frame.SCENE,
    kind: Literal["a", "b"] = "a",
    unset: int = None,  # noqa: RUF013
    choose: Callable[[int], int] | None = None,
) -> None: ...


class Sight:
    def __init__(self, pieces: int = 4, where: Something = None) -> None: ...


FITTING = [
    (sight, {"pieces": 3, "far": 2, "names": ["a"], "pair": [1, 2.5], "several": [1, 2, 3], "by_class": {"car": 1}}),
    (sight, {"far": None, "by_class": None, "counts": {"a": 1}, "plain": {"a": "b"}, "frame": "scene", "kind": "c"}),
    (sight, {"unset": None, "choose": "anything", "unknown": object()}),
    (partial(sight, pieces=2), {"far": 1.5}),
    (Inherited, {"max_pieces": 3, "far": float("inf")}),
    (Row, {"many": 2, "name": "a"}),
    (Sight, {"pieces": "cannot be judged: a name that is only there for type checkers"}),
    (RealismRanking, {"metric": 2025}),
]
WRONG = [
    (sight, {"pieces": 1.5}, r"it\.pieces must be a whole number, got 1\.5"),
    (sight, {"pieces": True}, r"it\.pieces must be a whole number, got True"),
    (sight, {"far": "near"}, r"it\.far must be a number or null, got 'near'"),
    (sight, {"names": "abc"}, r"it\.names must be .*list.*, got 'abc'"),
    (sight, {"names": ["a", 1]}, r"it\.names must be .*list.*, got \['a', 1\]"),
    (sight, {"pair": [1]}, r"it\.pair must be a list of 2 numbers, got \[1\]"),
    (sight, {"several": [1, "b"]}, r"it\.several must be a list of whole numbers, got \[1, 'b'\]"),
    (partial(sight), {"pieces": "x"}, r"it\.pieces must be a whole number, got 'x'"),
    (Inherited, {"max_pieces": "x"}, r"it\.max_pieces must be a whole number, got 'x'"),
    (Row, {"many": "x"}, r"it\.many must be a whole number, got 'x'"),
]


@pytest.mark.parametrize(("target", "options"), FITTING)
def test_what_a_reader_takes_is_let_through(target: Callable, options: dict[str, Any]) -> None:
    check_kinds(target, options, "it")


@pytest.mark.parametrize(("target", "options", "told"), WRONG)
def test_what_it_does_not_take_is_told_by_name(target: Callable, options: dict[str, Any], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        check_kinds(target, options, "it")


def test_a_metric_in_a_file_is_known_by_what_it_says(tmp_path: Path) -> None:
    text, described = (FOLDER / "2024.yaml").read_text(), []
    for name, content in (("one", text), ("other", text.replace("pseudocount: 0.1", "pseudocount: 0.2", 1))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.yaml").write_text(content)
        described.append(RealismRanking(str(tmp_path / name / "mine.yaml")).describe())
    assert described[0]["digest"] != described[1]["digest"]
    assert "digest" not in RealismRanking("2024").describe(), "stores of a year stay what they are"


def test_a_year_is_a_metric_as_a_number_too() -> None:
    assert RealismRanking(2025).describe() == RealismRanking("2025").describe()


if __name__ == "__main__":
    pytest.main([__file__])
