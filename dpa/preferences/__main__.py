"""Look at a preference store: ``python -m dpa.preferences info STORE`` or ``... verify STORE``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dpa.preferences.card import data_card
from dpa.preferences.store import PreferenceStore, verify
from envs.files import write_json


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; the exit status is 1 for a problem in the store."""
    parser = argparse.ArgumentParser(prog="python -m dpa.preferences", description="Look at a preference store.")
    commands = parser.add_subparsers(dest="command", required=True)
    info = commands.add_parser("info", help="print the data card and where the groups come from")
    info.add_argument("--pairs", type=int, help="pairs per scene (default: a quarter of the rollouts)")
    info.add_argument("--json", type=Path, help="also write the card to this file")
    check = commands.add_parser("verify", help="read every byte and check what must hold for every group")
    for command in (info, check):
        command.add_argument("store", type=Path, help="folder of the store")
    options = parser.parse_args(arguments)
    try:
        return (
            _info(options.store, options.pairs, options.json) if options.command == "info" else _verify(options.store)
        )
    except (OSError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 1


def _info(folder: Path, pairs: int | None, json_file: Path | None) -> int:
    card = data_card(PreferenceStore(folder), pairs)
    sys.stdout.write(f"{card}\n")
    if json_file is not None:
        write_json(json_file, card.to_json())
    return 0


def _verify(folder: Path) -> int:
    problems = verify(folder)
    sys.stdout.write("\n".join(problems or [f"{folder}: every byte and every group is as it should be."]) + "\n")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
