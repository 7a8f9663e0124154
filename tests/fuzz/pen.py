"""A process of its own for the reading: what hangs is ended, what crashes is noticed, memory is bounded."""

from __future__ import annotations

import json
import os
import resource
import select
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.fuzz.case import Case
from tests.fuzz.judge import Verdict

MOST_SECONDS = 10.0
MOST_MEMORY = 2 * 2**30
"""Bytes of one input beyond what the interpreter had before it."""
_GRACE_SECONDS = 60.0
"""For making an input, which is not on trial."""

Judge = Callable[[Case, Path], Verdict]


@dataclass(frozen=True)
class Result:
    """What came of one number.

    Attributes:
        number: of the input.
        verdict: on it.
        seconds: that reading took.
        memory: bytes at the peak, beyond what was there before.
    """

    number: int
    verdict: Verdict
    seconds: float
    memory: int


def run_apart(
    numbers: Sequence[int], make: Callable[[int], Case], judge: Judge, most_seconds: float = MOST_SECONDS
) -> Iterator[Result]:
    """Judge many inputs in a child process, and in a new one after each that did not survive.

    Args:
        numbers: of the inputs, in order.
        make: the input of a number.
        judge: reads the input that lies in a folder.
        most_seconds: for one input.
    """
    left = list(numbers)
    with TemporaryDirectory(prefix="fuzz-") as folder:
        while left:
            for result in _run_child([*left], make, judge, Path(folder), most_seconds):
                left.remove(result.number)
                yield result


def _run_child(
    numbers: list[int], make: Callable[[int], Case], judge: Judge, folder: Path, most_seconds: float
) -> Iterator[Result]:
    """Results until the child is done or dead."""
    receiver, sender = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns of threads; ours are idle
        child = os.fork()
    if child == 0:
        os.close(receiver)
        _be_child(numbers, make, judge, folder, sender)
    os.close(sender)
    ended, results = False, 0
    try:
        for number in numbers:
            result = _await(receiver, child, number, most_seconds)
            results += 1
            ended = result.seconds < 0
            yield result if not ended else Result(number, result.verdict, 0.0, 0)
            if ended:
                return
    finally:
        os.close(receiver)
        if not ended:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)


def _await(receiver: int, child: int, number: int, most_seconds: float) -> Result:
    """The result of one number; its seconds are negative if the child has ended."""
    start = _line(receiver, _GRACE_SECONDS)
    line = _line(receiver, most_seconds) if start else start
    if line:
        content = json.loads(line)
        return Result(number, Verdict(**content["verdict"]), content["seconds"], content["memory"])
    if line is None:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    what = (
        f"hang: more than {most_seconds} s" if line is None else f"crash: the interpreter ended with {_ending(status)}"
    )
    return Result(number, Verdict(fault=what if start else f"the input could not be made: {what}"), -1.0, 0)


def _ending(status: int) -> str:
    return f"signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else f"status {os.WEXITSTATUS(status)}"


def _line(receiver: int, seconds: float) -> bytes | None:
    """One line; nothing in time: None; the end of the pipe: empty."""
    line, end = b"", time.monotonic() + seconds
    while not line.endswith(b"\n"):
        if not select.select([receiver], [], [], max(0.0, end - time.monotonic()))[0]:
            return None
        byte = os.read(receiver, 1)
        if not byte:
            return b""
        line += byte
    return line


def _be_child(numbers: list[int], make: Callable[[int], Case], judge: Judge, folder: Path, sender: int) -> None:
    status = 1
    try:
        for number in numbers:
            place = folder / "input"
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir()
            case = make(number)
            for name, content in case.files.items():
                (place / name).write_bytes(content)
            os.write(sender, b"start\n")
            content = _measured(judge, case, place)
            os.write(sender, json.dumps(content).encode() + b"\n")
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _measured(judge: Judge, case: Case, place: Path) -> dict:
    before = _memory("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + MOST_MEMORY, limits[1]))
    start = time.monotonic()
    try:
        verdict = judge(case, place)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    seconds, memory = time.monotonic() - start, _memory("VmHWM") - before
    if memory > MOST_MEMORY and not verdict.fault:
        verdict.fault = f"memory: {memory >> 20} MiB"
    verdict.errors = verdict.errors[:20]
    return {"verdict": asdict(verdict), "seconds": seconds, "memory": memory}


def _memory(field: str) -> int:
    """Bytes, as the system counts them for this process."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise KeyError(field)
