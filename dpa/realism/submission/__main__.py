"""Look at a submission, or find what is wrong with it.

    python -m dpa.realism.submission validate submission.tar.gz --scenes runs/scenes/validation
    python -m dpa.realism.submission info submission.tar.gz

Exit status: 0 valid, 1 faults (or a damaged file), 2 bad usage or nothing to read.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from dpa.realism.submission.messages import CorruptError, SubmissionError
from dpa.realism.submission.metadata import metadata_faults, read_fields
from dpa.realism.submission.reader import check_exists, damage_told, entries
from dpa.realism.submission.validate import Present, PresentOf, find_faults
from envs.files import write_json
from envs.progress import progress
from envs.scene import CURRENT_STEP
from envs.sources.scenario import Scenario
from envs.sources.womd import WOMD, payloads
from envs.store import MANIFEST_FILE, SceneStore

FAULTS_STATUS, BAD_INPUT_STATUS, INTERRUPTED_STATUS = 1, 2, 130


def open_present(paths: list[str]) -> Mapping[str, Present]:
    """The objects of the scenes that a submission must hold, by scenario id.

    Args:
        paths: the folder of one store, or WOMD files, folders and patterns. Of those only the ids and the current step
            are read, so that the test split (11 steps) serves as well.

    Raises:
        ValueError: nothing there, or it cannot be read.
    """
    if len(paths) == 1 and (Path(paths[0]) / MANIFEST_FILE).is_file():
        return PresentOf(SceneStore(paths[0]))
    present: dict[str, Present] = {}
    for name in progress(WOMD.find(paths), "scenes", unit="file"):
        for index, read in enumerate(payloads(name)):
            try:
                scenario = Scenario.FromString(read())
            except DecodeError as error:
                raise SubmissionError(
                    f"{name}, record {index}: no Scenario proto ({error}); give files of scenarios."
                ) from None
            present[scenario.scenario_id] = _present_in(scenario)
    return present


def _present_in(scenario: Any) -> Present:
    states = [(track.id, track.states[CURRENT_STEP]) for track in scenario.tracks if len(track.states) > CURRENT_STEP]
    now = [(track, state.center_x, state.center_y) for track, state in states if state.valid]
    table = np.array(now, dtype=np.float64).reshape(-1, 3)
    return Present(table[:, 0].astype(np.int64), table[:, 1:])


def check(path: str, scenes: list[str], out: str | None) -> int:
    """Print every fault of a submission; returns the exit status."""
    present = open_present(scenes)
    check_exists(path)
    faults = []
    with progress(total=len(present), description="validate", unit="scenario") as bar:
        for fault in find_faults(path, present, bar.update):
            faults.append(fault)
            bar.write(str(fault), file=sys.stdout)
    if out is not None:
        write_json(Path(out), {"path": path, "valid": not faults, "faults": [asdict(fault) for fault in faults]})
    sys.stdout.write(f"{path}: {len(faults) or 'no'} faults, {len(present)} scenes\n")
    return FAULTS_STATUS if faults else 0


def describe(path: str) -> int:
    """Print what a submission holds; returns the exit status."""
    found = check_exists(path)
    shards = scenarios = size = objects = 0
    metadata: dict[str, Any] = {}
    with progress(description="read", unit="scenario") as bar, damage_told(found):
        for entry in entries(found):
            for message in entry.rollouts():
                scenarios += 1
                objects += len(message.joint_scenes[0].simulated_trajectories) if message.joint_scenes else 0
                bar.update()
            metadata = metadata or _fields(entry.name, entry.metadata)
            shards, size = shards + 1, size + entry.size
    lines = [f"{path}", f"  shards      {shards}, {size / 1e6:.1f} MB unpacked", f"  scenarios   {scenarios}"]
    lines.append(f"  objects     {objects / max(scenarios, 1):.1f} in a scenario")
    lines += [f"  {name}: {value}" for name, value in metadata.items()]
    lines += [f"  metadata: {fault}" for fault in metadata_faults(metadata)]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


def _fields(name: str, data: bytes) -> dict[str, Any]:
    try:
        return read_fields(data)
    except DecodeError as error:
        raise CorruptError(f"{name}: the metadata cannot be read ({error}); write the file again.") from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m dpa.realism.submission",
        description="Submissions to the Waymo Open Sim Agents Challenge: say what one holds, or what is wrong with it.",
        epilog="Exit status: 0 valid, 1 faults or a damaged file, 2 bad usage or nothing to read.",
    )
    commands = parser.add_subparsers(dest="command", required=True)
    checked = commands.add_parser(
        "validate",
        help="list every fault of a submission",
        description="List every fault: all that the server refuses, and what breaks its metric.",
    )
    shown = commands.add_parser("info", help="say what a submission holds", description="Say what a submission holds.")
    for command in (checked, shown):
        command.add_argument("path", metavar="PATH", help="a .tar.gz, a folder of shards, or one shard (*.binproto*)")
    checked.add_argument(
        "--scenes",
        nargs="+",
        required=True,
        metavar="STORE_OR_PATHS",
        help="the scenes that must be in it: the folder of a store of scenes, or WOMD files, folders or patterns",
    )
    checked.add_argument("--json", metavar="OUT", help="also write the faults to this file")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    options = _parser().parse_args(arguments)
    run: Callable[[], int] = (
        (lambda: check(options.path, options.scenes, options.json))
        if options.command == "validate"
        else (lambda: describe(options.path))
    )
    try:
        return run()
    except CorruptError as error:
        sys.stderr.write(f"error: {error}\n")
        return FAULTS_STATUS
    except (ValueError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return BAD_INPUT_STATUS
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return INTERRUPTED_STATUS


if __name__ == "__main__":
    sys.exit(main())
