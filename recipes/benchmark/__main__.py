"""How fast the parts are, and how much memory they take, on the machine at hand.

python -m recipes.benchmark device --model nano                    # kernels and synchronisations of a decision
python -m recipes.benchmark realism                                # crowded scenes made on the spot
python -m recipes.benchmark realism --scenarios FILE --json out.json    # scenarios of your own
python -m recipes.benchmark rollout --sweep                        # against a naive decoder and the machine's limit
python -m recipes.benchmark scenes womd FILES                      # size and speed of stores
python -m recipes.benchmark training --against ../before           # beside another version of the code
python -m recipes.benchmark transport --threads 2                  # against a loop over POT
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from envs.files import check_file, write_json
from recipes.benchmark import device, realism, rollout, scenes, training, transport
from recipes.common.cli import check_device
from recipes.common.provenance import processor

PARTS = {
    "device": (device, "kernels and synchronisations of a decision and of a ranking, part by part"),
    "realism": (realism, "seconds of the realism metric per scene"),
    "rollout": (rollout, "agent-steps per second with the policy in the loop"),
    "scenes": (scenes, "raw files against a store: size, conversion, batches"),
    "training": (training, "scenes per second of pre-training, against another checkout"),
    "transport": (transport, "transport problems per second, and seconds of a whole ranking"),
}


def make_parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m recipes.benchmark", description=__doc__.split("\n")[0])
    parts = parser.add_subparsers(dest="part", required=True, metavar="PART")
    for name, (module, text) in PARTS.items():
        part = parts.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        module.add_options(part)
        part.add_argument("--json", type=Path, metavar="OUT", help="write the figures here too")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    options = vars(make_parser().parse_args(arguments))
    part, out = options.pop("part"), options.pop("json")
    try:
        check_file(out, "--json ")
        if part != "device":  # which may be pretended there
            check_device(options.get("device", "cpu"))
        rows = PARTS[part][0].measure(options)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    machine = {"processor": processor(), "torch": torch.__version__}
    if out is not None:
        write_json(out, {"part": part, "options": options, "machine": machine, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
