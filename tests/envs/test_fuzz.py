"""A short fuzz run over every format, and proof that the run sees what it looks for."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from random import Random

import numpy as np
import pytest

from envs.scene import Scene, SceneError
from envs.sources.synthetic import straight_road
from tests.fuzz import __main__ as command
from tests.fuzz.case import Case, Corpus, Files, Format
from tests.fuzz.formats import FORMATS
from tests.fuzz.judge import judge
from tests.fuzz.pen import MOST_MEMORY, run_apart

NEEDS = {"argoverse": ("pyarrow", "shapely")}
INPUTS = 80


def corpus_of(name: str) -> Corpus:
    for package in NEEDS.get(name, ()):
        pytest.importorskip(package, reason=f"needs the extra {name}")
    return Corpus(FORMATS[name], FORMATS[name].seeds(), with_bombs=False)


def lay_out(case: Case, folder: Path) -> Path:
    folder.mkdir()
    for name, content in case.files.items():
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("name", FORMATS)
def test_broken_inputs_give_sound_scenes_or_one_error_that_names_the_file(name: str, tmp_path: Path) -> None:
    corpus = corpus_of(name)
    scenes, errors, faults = 0, set(), []
    for number in range(INPUTS):
        case = corpus.case(number)
        verdict = judge(corpus.format, case, lay_out(case, tmp_path / str(number)))
        scenes, errors = scenes + verdict.scenes, errors.union(verdict.errors)
        faults += [(number, case.made_by, verdict.fault)] if verdict.fault else []
    assert not faults
    assert scenes > 5 and len(errors) > 15  # neither all in ruins nor all untouched


@pytest.mark.parametrize("name", FORMATS)
def test_the_input_of_a_number_is_the_same_at_every_time_of_day(name: str, monkeypatch) -> None:
    def cases_at(seconds: float) -> list[Case]:
        monkeypatch.setattr(time, "time", lambda: seconds)
        corpus = corpus_of(name)
        return [corpus.case(number) for number in range(20)]

    cases = cases_at(1e9)
    same = [one == other for one, other in zip(cases, cases_at(1.7e9), strict=True)]
    assert all(same)  # without a picture of the inputs, which are long
    assert cases[3] != cases[4]


# --- planted faults ---------------------------------------------------------------------------------------------------


def ruin(files: Files, r: Random) -> Files:
    return dict.fromkeys(files, b"bad")


def planted(read_bad: Callable[[Path], Scene]) -> Format:
    """A format whose one sound input reads well, and whose broken ones read as told."""

    def read(path: Path) -> Iterator[Callable[[], Scene]]:
        yield lambda: straight_road(2) if path.read_bytes() == b"good" else read_bad(path)

    return Format("planted", lambda: [{"a.txt": b"good"}], lambda path: {}, {ruin: 1}, {}, read)


def no_key(path: Path) -> Scene:
    return {}["position"]


def no_name(path: Path) -> Scene:
    raise SceneError("something is wrong")


def two_lines(path: Path) -> Scene:
    raise SceneError(f"{path}: two\nlines")


def no_memory(path: Path) -> Scene:
    try:
        raise MemoryError
    except MemoryError as error:
        raise SceneError(f"{path}: damaged") from error


def overflow(path: Path) -> Scene:
    return np.float32(1e38) * np.float32(10)


def other_type(path: Path) -> Scene:
    scene = straight_road(2)
    scene.agents.track_id = scene.agents.track_id.int()
    return scene


@pytest.mark.parametrize(
    ("read_bad", "fault"),
    [
        (no_key, "KeyError in "),
        (no_name, "an error that names no file"),
        (two_lines, "an error that no terminal can show"),
        (no_memory, "out of memory"),
        (overflow, "RuntimeWarning in .*overflow"),
        (other_type, "an error that names no file.*agents.track_id is torch.int32"),
    ],
)
def test_what_must_not_come_out_of_an_input_is_a_fault(read_bad, fault: str, tmp_path: Path) -> None:
    corpus = Corpus(planted(read_bad), [{"a.txt": b"good"}])
    case = corpus.case(0)
    assert re.match(fault, judge(corpus.format, case, lay_out(case, tmp_path / "0")).fault)


def hang(path: Path) -> Scene:
    time.sleep(60)


def crash(path: Path) -> Scene:
    os.kill(os.getpid(), signal.SIGKILL)


def leave(path: Path) -> Scene:
    os._exit(3)


def eat(path: Path) -> Scene:
    return bytearray(MOST_MEMORY + 2**28)


@pytest.mark.parametrize(
    ("read_bad", "seconds", "fault"),
    [
        (hang, 2.5, "hang: more than 2.5 s"),
        (crash, 60, "crash: .* signal 9"),
        (leave, 60, "crash: .* status 3"),
        (eat, 60, "MemoryError"),
    ],
)
def test_a_reader_that_hangs_crashes_or_eats_memory_is_reported_and_the_run_goes_on(
    read_bad, seconds: float, fault: str
) -> None:
    format = planted(read_bad)
    cases = [Case({"a.txt": content}, (), False) for content in (b"good", b"bad", b"good")]
    results = list(run_apart(range(3), cases.__getitem__, partial(judge, format), most_seconds=seconds))
    assert [result.number for result in results] == [0, 1, 2]
    assert re.match(fault, results[1].verdict.fault)
    assert [results[number].verdict.scenes for number in (0, 2)] == [1, 1]


def test_the_command_ends_with_an_error_and_keeps_what_it_found(monkeypatch, capsys, tmp_path: Path) -> None:
    monkeypatch.setitem(FORMATS, "planted", planted(no_key))
    assert command.main(["planted", "--inputs", "2", "--keep", str(tmp_path)]) == 1
    assert re.search(r"faults +2\n.*2  FAULT KeyError in ", capsys.readouterr().out, re.DOTALL)
    assert (tmp_path / "planted-0-1" / "a.txt").read_bytes() == b"bad"
    monkeypatch.setitem(FORMATS, "planted", planted(lambda path: straight_road(2)))
    assert command.main(["planted", "--inputs", "2"]) == 0


if __name__ == "__main__":
    pytest.main([__file__])
