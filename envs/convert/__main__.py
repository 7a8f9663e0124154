"""``python -m envs.convert SOURCE PATHS OUT``, ``info OUT`` and ``verify OUT``; see :mod:`envs.convert`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from envs.convert import SHARD_SIZE, convert
from envs.convert.describe import describe
from envs.progress import progress
from envs.sources import SOURCES
from envs.store import SceneStore

BAD_INPUT_STATUS = 2
"""Exit status after an error in the inputs or the store."""
INTERRUPTED_STATUS = 130


def make_parser() -> argparse.ArgumentParser:
    """The options of the command."""
    parser = argparse.ArgumentParser(
        prog="python -m envs.convert",
        description="Convert raw recordings to a store of scenes. Run it again to go on after an interruption.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="SOURCE | info | verify")
    for source in SOURCES.values():
        command = commands.add_parser(source.name, help=source.help, description=f"Convert {source.help}.")
        command.add_argument("paths", nargs="+", metavar="PATHS", help="inputs: files, folders, patterns or addresses")
        command.add_argument("out", metavar="OUT", help="folder of the store")
        command.add_argument("--workers", type=int, default=1, help="processes (default: %(default)s)")
        command.add_argument(
            "--shard-size", type=int, default=SHARD_SIZE, metavar="M", help="scenes in a shard (default: %(default)s)"
        )
        command.add_argument("--limit", type=int, metavar="N", help="take only the first N scenes")
        command.add_argument("--split", default="", metavar="NAME", help="a name for these scenes, to select them by")
        command.add_argument(
            "--skip-bad",
            action="store_true",
            help="leave bad inputs out and list them, instead of stopping at the first",
        )
    for name, help_text in (
        ("info", "say what a store holds"),
        ("verify", "compare a store with its checksums and validate every scene"),
    ):
        command = commands.add_parser(name, help=help_text, description=f"{help_text.capitalize()}.")
        command.add_argument("out", metavar="OUT", help="folder of the store")
        command.add_argument("--ids", action="store_true", help="list the scenes too: index, id and number of agents")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    options = vars(make_parser().parse_args(arguments))
    command, out, ids = options.pop("command"), options.pop("out"), options.pop("ids", False)
    try:
        if command in SOURCES:
            store = convert(command, options.pop("paths"), out, show_progress=True, **options)
        else:
            store = SceneStore(out)
        if command == "verify":
            with progress(total=len(store), description="verify", unit="scene") as bar:
                store.verify(bar.update)
            sys.stdout.write(f"verified: {len(store)} scenes, every checksum and every value is right\n")
        sys.stdout.write(describe(store) + "\n")
        if ids:
            rows = zip(store.scene_ids, store.num_agents.tolist(), strict=True)
            sys.stdout.writelines(f"{index:>8}  {name}  {agents}\n" for index, (name, agents) in enumerate(rows))
    except (ValueError, OSError, ImportError) as error:
        sys.stderr.write(f"error: {error}\n")
        return BAD_INPUT_STATUS
    except KeyboardInterrupt:
        sys.stderr.write("interrupted; run the same command again to go on\n")
        return INTERRUPTED_STATUS
    return 0


if __name__ == "__main__":
    sys.exit(main())
