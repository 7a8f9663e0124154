"""What a source of scenes must offer, so that one converter serves them all."""

from __future__ import annotations

import glob
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from envs.scene import Scene, SceneError


@dataclass(frozen=True)
class Unit:
    """One scene that can be made: the smallest piece of work of a conversion.

    Attributes:
        input: the file that holds it, or whatever else a generator is told (a configuration file).
        record: its index in the input.
        key: what the reader needs to find it again (a byte offset, a seed); 0 where an input is one scene.
    """

    input: str
    record: int = 0
    key: int = 0

    @property
    def name(self) -> str:
        """What errors call it."""
        return f"{self.input}, record {self.record}"


@dataclass(frozen=True)
class Source:
    """A kind of input: how to find the inputs, the scenes in them, and how to make one.

    The functions must be importable by name and depend on nothing but their arguments: workers in other processes
    call them, and a conversion must give the same bytes whoever calls.

    Attributes:
        name: as in ``python -m envs.convert NAME ...``.
        help: one line on what the inputs are.
        find: what the user named (files, folders, patterns) -> inputs, in the order of the store.
        locate: an input -> one unit for each of its scenes, without making them. Raises SceneError where the rest of
            the input is unreadable.
        open: an input -> a context whose value makes the scene of a unit. It may raise SceneError for one unit and go
            on with the next.

    Examples:
        A source that reads nothing:

        >>> from contextlib import nullcontext
        >>> from envs.sources.synthetic import straight_road
        >>> roads = Source(
        ...     name="roads",
        ...     help="straight roads",
        ...     find=list,
        ...     locate=lambda road: (Unit(road, seed, seed) for seed in range(3)),
        ...     open=lambda road: nullcontext(lambda unit: straight_road(seed=unit.key)),
        ... )
        >>> [scene.scene_id for scene in roads.scenes("any")]
        ['straight_road_2_0', 'straight_road_2_1', 'straight_road_2_2']
    """

    name: str
    help: str
    find: Callable[[Sequence[str]], list[str]]
    locate: Callable[[str], Iterator[Unit]]
    open: Callable[[str], AbstractContextManager[Callable[[Unit], Scene]]]

    def scenes(self, source_input: str) -> Iterator[Scene]:
        """Every scene of one input, validated.

        Raises:
            SceneError: naming the input and the record.
        """
        with self.open(source_input) as make:
            for unit in self.locate(source_input):
                yield make(unit).validate(unit.name)


def find_files(paths: Sequence[str], *patterns: str) -> list[str]:
    """Expand files, folders and patterns to files, in the order given and sorted within each.

    Args:
        paths: a file is taken whatever its name; a folder gives the files below it whose name fits one of ``patterns``;
            anything else must be a pattern that matches something.
        patterns: shell patterns of file names.

    Raises:
        SceneError: for a path that gives no file.
    """
    files: list[str] = []
    for path in map(str, paths):
        if Path(path).is_dir():
            found = sorted({str(file) for pattern in patterns for file in Path(path).rglob(pattern) if file.is_file()})
            fix = f"a folder must hold files named {' or '.join(patterns)}"
        else:
            found = [path] if Path(path).is_file() else sorted(glob.glob(path, recursive=True))
            fix = "give files, folders or patterns that exist"
        if not found:
            raise SceneError(f"{path}: no input there; {fix}.")
        files += found
    return files
