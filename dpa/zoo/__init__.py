"""Pre-trained reference policies that come with the package, each in a folder with a card.

A policy of the zoo is named ``zoo:NAME`` wherever a recipe takes a policy; ``python -m recipes.zoo`` lists them.

    policies/NAME/policy.pt   weights, as any recipe writes them
    policies/NAME/card.json   what made it, what it scores, and the checksum of the weights

Only policies of simulated scenes lie here: no licence is attached to what they learnt from.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import re
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "policies"
PREFIX = "zoo:"
POLICY, CARD = "policy.pt", "card.json"


def names(folder: Path = FOLDER) -> list[str]:
    """Names of all policies in alphabetical order.

    Examples:
        >>> "motionlm-nano-sumo" in names()
        True
    """
    return sorted(card.parent.name for card in folder.glob(f"*/{CARD}"))


def card(name: str, folder: Path = FOLDER) -> dict[str, Any]:
    """What is known of a policy.

    Raises:
        ValueError: there is none of this name, or its card is damaged.

    Examples:
        >>> card("motionlm-nano-sumo")["parameters"]
        153297
    """
    file = _folder_of(name, folder) / CARD
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (RecursionError, ValueError) as error:
        raise ValueError(f"{file} is damaged ({type(error).__name__}); install the package again.") from None
    if not isinstance(found, dict) or not re.fullmatch("[0-9a-f]{64}", str(found.get("sha256"))):
        raise ValueError(f"{file} has no sha256 of the weights; install the package again.")
    return found


def find(name: str, folder: Path = FOLDER) -> Path:
    """The file of a policy, as its card has it.

    Raises:
        ValueError: there is none of this name, or its file is missing or has changed.

    Examples:
        >>> find("motionlm-nano-sumo").name
        'policy.pt'
    """
    expected, file = card(name, folder)["sha256"], _folder_of(name, folder) / POLICY
    if not file.is_file():
        raise ValueError(f"{file} is missing, the weights of zoo:{name}; install the package again.")
    if (found := checksum(file)) != expected:
        raise ValueError(
            f"{file} has the checksum {found[:12]}… and its card says {expected[:12]}…: the weights of zoo:{name} are "
            "damaged; install the package again."
        )
    return file


def checksum(file: Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _folder_of(name: str, folder: Path) -> Path:
    known = names(folder)
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f" Did you mean zoo:{near[0]}?" if near else ""
        raise ValueError(
            f"the zoo has no policy {name!r}; it has {', '.join(known) or 'none'} (python -m recipes.zoo).{hint}"
        )
    return folder / name
