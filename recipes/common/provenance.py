"""What made a result: code, packages, machine, command."""

from __future__ import annotations

import contextlib
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("torch", "torchrl", "tensordict", "pot", "numpy")


def provenance(recipe: str, device: str) -> dict[str, Any]:
    """Versions, git revision (None outside a checkout), machine, date, and a command that can be pasted into a shell.

    Args:
        recipe: that is running.
        device: of torch.

    Examples:
        >>> sorted(provenance("compare", "cpu"))
        ['command', 'date', 'machine', 'revision', 'versions']
    """
    vectors = torch.backends.cpu.get_cpu_capability()  # on these depends how a CPU rounds
    machine = f"{platform.system()}, {processor()} ({vectors}), {os.cpu_count()} CPU cores"
    if torch.device(device).type == "cuda":
        machine += f", {torch.cuda.get_device_name(device)}"
    return {
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in PACKAGES}},
        "revision": revision(),
        "machine": machine,
        "date": datetime.now(UTC).date().isoformat(),
        "command": pasteable(recipe),
    }


def merged(made: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What made several pieces of work, as one: what differs is told side by side, dates from the first to the last.

    Args:
        made: :func:`provenance` of each piece.

    Examples:
        >>> one = {"revision": "a1", "machine": "here", "date": "2026-11-23", "versions": {"torch": "2.13.0"}}
        >>> merged([one, one | {"revision": None, "date": "2026-11-24"}])["revision"]
        'a1, none'
        >>> merged([one | {"revision": None}])["revision"] is None  # outside a checkout, as :func:`provenance` says it
        True
        >>> merged([one, one | {"date": "2026-11-24"}])["date"]
        '2026-11-23 to 2026-11-24'
    """

    def told(values: Iterable[str | None]) -> str | None:
        each = dict.fromkeys(values)
        return None if each.keys() == {None} else ", ".join("none" if value is None else value for value in each)

    names = dict.fromkeys(name for each in made for name in each["versions"])
    dates = sorted({each["date"] for each in made})
    return {
        "versions": {name: told(each["versions"].get(name) for each in made) for name in names},
        "revision": told(each["revision"] for each in made),
        "machine": told(each["machine"] for each in made),
        "date": " to ".join(dict.fromkeys((dates[0], dates[-1]))),
    }


def processor() -> str:
    """Name of the CPU, such as AMD EPYC 7763; of its architecture where the system does not tell."""
    with contextlib.suppress(OSError):  # Linux alone has this file
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def pasteable(recipe: str) -> str:
    """The command at hand, quoted for a shell."""
    return shlex.join(["python", "-m", f"recipes.{recipe}", *sys.argv[1:]])


def revision() -> str | None:
    """Commit of the code, with a mark where files differ from it; None where it is no git checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
