"""Reading one input and telling whether it went as it must: sound scenes, or one error that names the file."""

from __future__ import annotations

import re
import traceback
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import torch

from envs.codec import decode, encode
from envs.convert import convert
from envs.scene import Scene, SceneError, collate
from envs.sources.synthetic import red_light
from tests.fuzz.case import Case, Format

MOST_SCENES = 1000
"""Records of one input that are read: a broken file may hold as many as it has bytes."""


class Fault(Exception):
    """Something that must not come out of an input."""


@dataclass
class Verdict:
    """What came of one input.

    Attributes:
        scenes: sound ones, or what else a format gives.
        errors: kinds of errors.
        fault: what must not be, or nothing.
    """

    scenes: int = 0
    errors: list[str] = field(default_factory=list)
    fault: str | None = None


def judge(format: Format, case: Case, folder: Path) -> Verdict:
    """Read an input that lies in a folder of its own."""
    verdict = Verdict()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            names = (*case.files, *format.also_named)
            path = folder / next(iter(case.files))
            _read(format, path, names, verdict)
            if case.converted:
                _convert(format, path, names, verdict)
        except Fault as fault:
            verdict.fault = str(fault)
        except Exception as error:
            verdict.fault = _told(error)
    return verdict


def _read(format: Format, path: Path, names: Sequence[str], verdict: Verdict) -> None:
    check = format.check or _check_scene
    with _scene_errors(names, verdict, format.answer):
        for make in islice(format.read(path), MOST_SCENES):
            with _scene_errors(names, verdict, format.answer):
                check(make())
                verdict.scenes += 1


def _convert(format: Format, path: Path, names: Sequence[str], verdict: Verdict) -> None:
    with _scene_errors(names, verdict):
        store = convert(format.source, [path], path.parent / "store", skip_bad=True)
        store.verify()
        for skip in store.manifests[0].skipped:
            _check_error(SceneError(skip["error"]), names)


class _scene_errors:
    """Takes the error of a format as an answer, if it is a good one."""

    def __init__(self, names: Sequence[str], verdict: Verdict, answer: type[Exception] = SceneError) -> None:
        self.names, self.verdict, self.answer = names, verdict, answer

    def __enter__(self) -> None: ...

    def __exit__(self, _, error: BaseException | None, __) -> bool:
        if isinstance(error, self.answer):
            _check_error(error, self.names)
            self.verdict.errors.append(kind_of(str(error), self.names))
            return True
        return False


def _check_error(error: Exception, names: Sequence[str]) -> None:
    message = str(error)
    if not any(name in message for name in names):
        raise Fault(f"an error that names no file: {message[:300]}")
    if len(message) > 2000 or not message.isprintable():
        raise Fault(f"an error that no terminal can show ({len(message)} letters): {message[:300]!a}")
    for cause in _causes(error):
        if isinstance(cause, MemoryError):
            raise Fault(f"out of memory: {message[:300]}") from error


def _causes(error: BaseException) -> Iterator[BaseException]:
    while error := error.__cause__ or error.__context__:
        yield error


def _check_scene(scene: Scene) -> None:
    scene.validate()
    other = decode(encode(scene))
    if not same(scene, other):
        raise Fault("the scene does not come back from the store as it is")
    if collate([scene, red_light()]).agents.valid.shape[0] != 2:
        raise Fault("the scene cannot be put into a batch")


def same(ours: Scene, theirs: Scene) -> bool:
    """Equal to the last bit, but for the bits of NaN that no valid state holds."""
    if ours.scene_id != theirs.scene_id:
        return False
    pairs = [(ours.origin, theirs.origin), (ours.lacks, theirs.lacks)]
    for part in ("agents", "road", "lights"):
        mine, other = getattr(ours, part), getattr(theirs, part)
        pairs += [(getattr(mine, name), getattr(other, name)) for name in mine.__dataclass_fields__]
    return all(a.dtype == b.dtype and a.shape == b.shape and torch.equal(a, b) for a, b in pairs)


def kind_of(message: str, names: Sequence[str]) -> str:
    """An error without what differs from input to input."""
    for name in names:
        message = message.rpartition(name)[2] or message
    message = re.sub(r"\(scene .*?\):", ":", message)
    message = re.sub(r"'[^']*'|\"[^\"]*\"", "'...'", message)
    message = re.sub(r"-?\d[\d.e+-]*", "N", message)
    return message.lstrip(", :")[:70]


def _told(error: Exception) -> str:
    frame = traceback.extract_tb(error.__traceback__)[-1]
    where = [f for f in traceback.extract_tb(error.__traceback__) if "/envs/" in f.filename]
    frame = where[-1] if where else frame
    return f"{type(error).__name__} in {Path(frame.filename).name}:{frame.lineno}: {str(error)[:300]}"
