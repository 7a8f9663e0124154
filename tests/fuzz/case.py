"""What a format of the fuzz run is, and how the input of one number is made from it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Protocol

from envs.scene import Scene, SceneError
from envs.sources import SOURCES

Files = dict[str, bytes]
"""Name -> content of the files of one input; the first is the one that is read."""
Mutator = Callable[[Files, Random], Files]
"""Files -> the same, broken in one way."""

HAND_MADE_SHARE = 0.9
"""Of the inputs, where the user gives files too: those are larger and slower."""
CONVERTED_EVERY = 50
"""One input of so many goes through the whole converter, which also draws a card."""


class Maker(Protocol):
    """Makes one scene, or what else a format gives, or raises the error of the format."""

    def __call__(self) -> Scene | Any: ...


@dataclass(frozen=True)
class Format:
    """One format.

    Attributes:
        name: on the command line.
        seeds: makes the small valid inputs.
        load: a file of the user -> an input.
        mutators: each with how often it is drawn, relative to the others.
        bombs: more of them, whose inputs are large or slow.
        read: the path of an input -> its scenes, each to be made.
        also_named: what an error may name instead of a file that is there.
        source: its name in :data:`~envs.sources.SOURCES`, if the converter reads it.
        answer: what a broken input may end with.
        check: what a sound result must pass; by default it is a scene.
    """

    name: str
    seeds: Callable[[], list[Files]]
    load: Callable[[Path], Files]
    mutators: Mapping[Mutator, float]
    bombs: Mapping[Mutator, float]
    read: Callable[[Path], Iterator[Maker]]
    also_named: tuple[str, ...] = ()
    source: str | None = None
    answer: type[Exception] = SceneError
    check: Callable[[Any], None] | None = None


@dataclass(frozen=True)
class Case:
    """The input of one number.

    Attributes:
        files: what lies in its folder.
        made_by: names of the mutators that made it.
        converted: it goes through the converter as well.
    """

    files: Files
    made_by: tuple[str, ...]
    converted: bool


@dataclass(frozen=True)
class Corpus:
    """Valid inputs of one format, to be broken.

    Attributes:
        format: of the inputs.
        small: made by hand.
        given: of the user, possibly none.
        seed: of all numbers.
        with_bombs: draw from those mutators too.
    """

    format: Format
    small: Sequence[Files]
    given: Sequence[Files] = ()
    seed: int = 0
    with_bombs: bool = True

    def case(self, number: int) -> Case:
        """The input of a number; it depends on the seed and the number alone."""
        r = Random(f"{self.format.name}/{self.seed}/{number}")
        hand_made = not self.given or r.random() < HAND_MADE_SHARE
        files = dict(r.choice(self.small if hand_made else self.given))
        mutators = {**self.format.mutators, **(self.format.bombs if self.with_bombs else {})}
        chosen = r.choices([*mutators], [*mutators.values()], k=r.choice((1, 1, 1, 1, 1, 2, 3)))
        chosen.sort(key=lambda mutate: mutate in self.format.bombs)  # a bomb comes last: to edit one would take minutes
        for mutate in chosen:
            files = mutate(files, r)
        converted = self.format.source is not None and number % CONVERTED_EVERY == CONVERTED_EVERY - 1
        return Case(files, tuple(mutate.__name__ for mutate in chosen), converted)


def read_source(name: str) -> Callable[[Path], Iterator[Maker]]:
    """The scenes of an input as the converter asks for them."""

    def read(path: Path) -> Iterator[Maker]:
        return (record.scene for record in SOURCES[name].records(str(path)))

    return read


def on_first(edit: Callable[[bytes, Random], bytes]) -> Mutator:
    """An edit of bytes as a mutator of the first file."""

    def mutate(files: Files, r: Random) -> Files:
        first = next(iter(files))
        return files | {first: edit(files[first], r)}

    mutate.__name__ = edit.__name__
    return mutate


def load_file(path: Path) -> Files:
    """An input that is one file."""
    return {path.name: path.read_bytes()}
