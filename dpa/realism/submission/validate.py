"""What is wrong with a submission: all that the server refuses, and what breaks its metric (realism.md section 9).

The whole submission is gone through scenario by scenario, and every fault is listed. Where a file is damaged, that is
its one fault: what cannot be read is not called missing.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from dpa.realism.submission import wire
from dpa.realism.submission.messages import NUM_ROLLOUTS, POSE_FIELDS, CorruptError
from dpa.realism.submission.metadata import metadata_faults, read_fields
from dpa.realism.submission.reader import Entry, check_exists, damage_told, entries
from dpa.realism.tracks import HORIZON
from envs.scene import CURRENT_STEP, Scene, SceneSource

MAX_FIRST_STEP = 100.0
"""Where half the objects are farther than this from where they were 0.1 s before, the frame is not the world's [m]."""


class Present(NamedTuple):
    """The objects that a scenario's rollouts must hold.

    Attributes:
        track_id: ``[A]`` int64.
        position: ``[A, 2]`` float64, x, y at the current step in world coordinates [m].
    """

    track_id: np.ndarray
    position: np.ndarray


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong.

    Attributes:
        kind: one word for it, the same for faults of a kind.
        message: a sentence that names the place, quotes the value and says what must be.
        shard: file that it is in, if it is in one.
        scenario: id, if it is about one.
        rollout: index of the joint scene, if it is about one.
        object_id: if it is about one object.
    """

    kind: str
    message: str
    shard: str | None = None
    scenario: str | None = None
    rollout: int | None = None
    object_id: int | None = None

    def __str__(self) -> str:
        return self.message


def validate(path: str | Path, scenes: SceneSource) -> list[Fault]:
    """All faults of a submission, in the order of its files; none if the server would take it.

    Args:
        path: a ``.tar.gz``, a folder of shards, or one shard.
        scenes: exactly the scenes that must be in the submission.

    Raises:
        SubmissionError: there is nothing at the path.

    Examples:
        >>> import tempfile
        >>> from envs.sources.synthetic import straight_road
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     size = Path(folder, "submission.binproto").write_bytes(b"")
        ...     faults = validate(folder, [straight_road(2)])
        >>> sorted({fault.kind for fault in faults}), faults[-1].scenario
        (['metadata', 'missing-scenario'], 'straight_road_2_None')
    """
    return list(find_faults(path, PresentOf(scenes)))


def find_faults(
    path: str | Path, present: Mapping[str, Present], tick: Callable[[], object] = lambda: None
) -> Iterator[Fault]:
    """The faults of :func:`validate` while they are found.

    Args:
        path: a ``.tar.gz``, a folder of shards, or one shard.
        present: the objects of each scenario that must be in the submission, by its id.
        tick: called after each scenario.

    Raises:
        SubmissionError: there is nothing at the path.
    """
    path = check_exists(path)
    check = _Check(present, tick)
    try:
        with damage_told(path):
            for entry in entries(path):
                yield from check.entry(entry)
    except CorruptError as error:
        yield Fault("corrupt", str(error))
        return
    yield from check.shards_of_the_set(path)
    if check.whole:
        yield from check.missing_scenarios()


class PresentOf(Mapping):
    """The objects of scenes by scenario id; a scene is loaded when it is asked for.

    Args:
        scenes: whose ids differ.
    """

    def __init__(self, scenes: SceneSource) -> None:
        self._scenes = scenes
        ids = getattr(scenes, "scene_ids", None) or [scenes[index].scene_id for index in range(len(scenes))]
        self._index = {scene_id: index for index, scene_id in enumerate(ids)}

    def __len__(self) -> int:
        return len(self._index)

    def __iter__(self) -> Iterator[str]:
        return iter(self._index)

    def __getitem__(self, scene_id: str) -> Present:
        return present_of(self._scenes[self._index[scene_id]])


def present_of(scene: Scene) -> Present:
    """The objects that rollouts of one uncollated scene must hold."""
    agents, present = scene.agents, scene.agents.present
    position = agents.position[present, CURRENT_STEP].double() + scene.origin
    return Present(agents.track_id[present].numpy(), position[:, :2].numpy())


@dataclass
class _Check:
    """What is known so far of a submission that is gone through; ``whole`` while every shard could be read."""

    present: Mapping[str, Present]
    tick: Callable[[], object]
    whole: bool = True
    names: list[str] = field(default_factory=list)
    metadata: tuple[str, dict[str, Any]] | None = None
    seen: dict[str, str] = field(default_factory=dict)

    def entry(self, entry: Entry) -> Iterator[Fault]:
        """Faults of one file of the submission."""
        name = entry.name
        if entry.file is None:
            yield Fault("not-a-file", f"{name}: a folder or link; pack the shards alone, by their bare names.", name)
            return
        if not wire.SHARD_NAME.fullmatch(name):
            bare = PurePosixPath(name).name
            if bare == name or not wire.SHARD_NAME.fullmatch(bare):
                fix = "name shards like submission.binproto-00007-of-00150, and pack nothing else"
                yield Fault("shard-name", f"{name}: no name of a shard; {fix}.", name)
                return
            yield Fault("folder", f"{name}: lies in a folder; pack the shards by their bare names.", name)
        self.names.append(PurePosixPath(name).name)
        if entry.size >= wire.MAX_SHARD_BYTES:
            yield Fault(
                "shard-size",
                f"{name}: has {entry.size} bytes; a shard must have less than {wire.MAX_SHARD_BYTES}: use more shards.",
                name,
            )
        try:
            for message in entry.rollouts():
                yield from self._scenario(name, message)
                self.tick()
            fields = read_fields(entry.metadata)
        except CorruptError as error:
            self.whole = False
            yield Fault("corrupt", str(error), name)
        except DecodeError as error:
            yield Fault("metadata", f"{name}: the metadata cannot be read ({error}); write the file again.", name)
        else:
            yield from self._metadata(name, fields)

    def _metadata(self, shard: str, fields: dict[str, Any]) -> Iterator[Fault]:
        if self.metadata is None:
            self.metadata = shard, fields
            for text in metadata_faults(fields):
                yield Fault("metadata", f"{shard}: metadata: {text}.", shard)
            return
        first, expected = self.metadata
        for name in sorted(fields.keys() | expected.keys()):
            if fields.get(name) != expected.get(name):
                yield Fault(
                    "metadata-differ",
                    f"{shard}: {name} is {fields.get(name)!r}, but {expected.get(name)!r} in {first}; every shard must "
                    "repeat the same metadata.",
                    shard,
                )

    def _scenario(self, shard: str, message: Any) -> Iterator[Fault]:
        name = message.scenario_id
        here = _Place(shard, name)
        if not name:
            yield here.fault("no-scenario-id", "the scenario id is missing")
            return
        if name in self.seen:
            yield here.fault("duplicate-scenario", f"comes again; it is in {self.seen[name]} already")
        elif name not in self.present:
            yield here.fault("unknown-scenario", f"is none of the {len(self.present)} scenes to submit")
        self.seen.setdefault(name, shard)
        if len(message.joint_scenes) != NUM_ROLLOUTS:
            count = len(message.joint_scenes)
            yield here.fault("rollouts", f"must have {NUM_ROLLOUTS} rollouts (joint scenes), has {count}")
        present = self.present.get(name)
        for number, joint in enumerate(message.joint_scenes):
            yield from _rollout(_Place(shard, name, number), joint.simulated_trajectories, present)
        if present is not None and message.joint_scenes:
            yield from _frame(_Place(shard, name, 0), message.joint_scenes[0].simulated_trajectories, present)

    def shards_of_the_set(self, path: Path) -> Iterator[Fault]:
        """Faults of the names taken together. One shard that is looked at alone is no set."""
        if not self.names:
            yield Fault("no-shards", f"{path}: holds no shard; pack files named *.binproto-00000-of-00001.")
        if not path.is_dir() and wire.SHARD_NAME.fullmatch(path.name):
            return
        for name, count in sorted(Counter(self.names).items()):
            if count > 1:
                yield Fault("duplicate-shard", f"{name}: comes {count} times; pack each shard once.", name)
        sets: dict[tuple[str, int], set[int]] = {}
        for name in self.names:
            suffix, number, total = wire.SHARD_NAME.fullmatch(name).groups()
            numbered = (name.removesuffix(suffix), int(total)) if suffix else (name, 1)
            sets.setdefault(numbered, set()).add(int(number) if suffix else 0)
        if len(sets) > 1:
            shown = ", ".join(f"{prefix} of {total}" for prefix, total in sorted(sets))
            yield Fault("mixed-shards", f"{path}: shards of different sets ({shown}); pack those of one set only.")
        for (prefix, total), numbers in sorted(sets.items()):
            for number in sorted(set(range(total)) - numbers):
                name = f"{prefix}-{number:05d}-of-{total:05d}"
                yield Fault("missing-shard", f"{name}: is missing from {path}; pack all {total} shards.", name)
            for number in sorted(numbers - set(range(total))):
                name = f"{prefix}-{number:05d}-of-{total:05d}"
                yield Fault("shard-name", f"{name}: its number is not below {total}; numbers count from 0.", name)

    def missing_scenarios(self) -> Iterator[Fault]:
        """Scenes that are nowhere in the submission."""
        for name in self.present:
            if name not in self.seen:
                yield Fault("missing-scenario", f"scenario {name}: is not in the submission; add it.", scenario=name)


class _Place(NamedTuple):
    """Where a fault is."""

    shard: str
    scenario: str
    rollout: int | None = None

    def fault(self, kind: str, text: str, object_id: int | None = None) -> Fault:
        where = f"{self.shard}: scenario {self.scenario or '(no id)'}"
        where += "" if self.rollout is None else f", rollout {self.rollout}"
        where += "" if object_id is None else f", object {object_id}"
        return Fault(kind, f"{where}: {text}.", self.shard, self.scenario or None, self.rollout, object_id)


def _rollout(here: _Place, trajectories: Any, present: Present | None) -> Iterator[Fault]:
    """Faults of one rollout; its objects are compared with those that must be there, if those are known."""
    for trajectory in trajectories:
        yield from _trajectory(here, trajectory)
    given = Counter(trajectory.object_id for trajectory in trajectories)
    for track, count in sorted(given.items()):
        if count > 1:
            yield here.fault("duplicate-object", f"comes {count} times; give each object once", track)
    if present is None:
        return
    expected = set(present.track_id.tolist())
    for track in sorted(expected - given.keys()):
        yield here.fault("missing-object", "is missing; every object that is there at the current step counts", track)
    for track in sorted(given.keys() - expected):
        yield here.fault("extra-object", "is not there at the current step; leave it out", track)


def _trajectory(here: _Place, trajectory: Any) -> Iterator[Fault]:
    track = trajectory.object_id
    if not trajectory.HasField("object_id"):
        yield here.fault("no-object-id", "a trajectory has no object id")
    for name in POSE_FIELDS:
        values = getattr(trajectory, name)
        if len(values) != HORIZON:
            yield here.fault("length", f"{name} must have {HORIZON} entries, has {len(values)}", track)
        # A sum of float32 in float64 is finite if and only if all of them are.
        if not math.isfinite(sum(values)):
            step = next(step for step, value in enumerate(values) if not math.isfinite(value))
            yield here.fault("not-finite", f"{name} is {values[step]} at simulated step {step}", track)


def _frame(here: _Place, trajectories: Any, present: Present) -> Iterator[Fault]:
    """One fault for a scenario that is not in world coordinates; its first rollout tells."""
    away = _first_steps(trajectories, present)
    if len(away) and np.median(away) > MAX_FIRST_STEP:
        yield here.fault(
            "frame",
            f"half of the objects start {np.median(away):.0f} m or more from where they are at the current step; "
            "submissions are in world coordinates",
        )


def _first_steps(trajectories: Any, present: Present) -> np.ndarray:
    """How far the known objects are from their current position at the first simulated step [m], where finite."""
    current = dict(zip(present.track_id.tolist(), present.position.tolist(), strict=True))
    starts = [
        (trajectory.center_x[0], trajectory.center_y[0], *current[trajectory.object_id])
        for trajectory in trajectories
        if trajectory.object_id in current and trajectory.center_x and trajectory.center_y
    ]
    x, y, old_x, old_y = np.array(starts, dtype=np.float64).reshape(-1, 4).T
    away = np.hypot(x - old_x, y - old_y)
    return away[np.isfinite(away)]
