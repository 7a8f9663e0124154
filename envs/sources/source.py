"""What a source of scenes must offer, so that one converter serves them all."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from envs.scene import Lacks, Scene
from envs.sources.files import file_size

Notes = Counter[str]
"""What a reader met and could not take over as it is -> how often; a conversion adds them up and reports them."""


@dataclass(frozen=True)
class Record:
    """One scene that can be made, at its turn in a pass over its input.

    Attributes:
        input: the file that holds it, or whatever else a generator is told.
        index: its place in the input.
        make: reads it; only until the next record is asked for, and at most once.
    """

    input: str
    index: int
    make: Callable[[Notes], Scene] = field(repr=False)

    @property
    def name(self) -> str:
        """What errors call it."""
        return f"{self.input}, record {self.index}"

    def scene(self, notes: Notes | None = None) -> Scene:
        """Make the scene and validate it.

        Args:
            notes: gets what the reader could not take over.

        Raises:
            SceneError: naming the input and the record.
        """
        return self.make(Counter() if notes is None else notes).validate(self.name)


@dataclass(frozen=True)
class Source:
    """A kind of input: how to find the inputs, and how to go through the scenes of one.

    The functions must be importable by name and depend on nothing but their arguments: workers in other processes
    call them, and a conversion must give the same bytes whoever calls.

    Attributes:
        name: as in ``python -m envs.convert NAME ...``.
        help: one line on what the inputs are.
        find: what the user named (files, folders, patterns) -> inputs, in the order of the store.
        records: an input -> its scenes, in one pass. Asking for the next record without making this one costs little.
            It raises SceneError where the rest of the input is unreadable; a record that is bad in itself raises only
            when it is made.
        count: an input -> how many records it gives, or None where only reading it could tell.
        size: an input -> its bytes, by which a changed file is known.
        lacks: what no scene of this source has.

    Examples:
        A source that reads nothing:

        >>> from functools import partial
        >>> from envs.sources.synthetic import straight_road
        >>> roads = Source(
        ...     name="roads",
        ...     help="straight roads",
        ...     find=list,
        ...     records=lambda road: (Record(road, i, lambda notes, i=i: straight_road(seed=i)) for i in range(3)),
        ...     count=lambda road: 3,
        ...     size=lambda road: 0,
        ... )
        >>> [scene.scene_id for scene in roads.scenes("any")]
        ['straight_road_2_0', 'straight_road_2_1', 'straight_road_2_2']
    """

    name: str
    help: str
    find: Callable[[Sequence[str]], list[str]]
    records: Callable[[str], Iterator[Record]]
    count: Callable[[str], int | None]
    size: Callable[[str], int] = file_size
    lacks: Lacks = Lacks.NOTHING

    def scenes(self, source_input: str, notes: Notes | None = None) -> Iterator[Scene]:
        """Every scene of one input, validated.

        Raises:
            SceneError: naming the input and the record.
        """
        return (record.scene(notes) for record in self.records(source_input))
