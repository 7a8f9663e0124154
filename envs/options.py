"""Options of a run, as plain values: what two runs have in common and where they part.

Examples:
    >>> print(differences({"lr": 0.1, "model": {"width": 48}}, {"lr": 0.1, "model": {"width": 64}, "seed": 1}))
    'model.width': 48 there, 64 here; 'seed': nothing there, 1 here
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

_NOTHING = object()


def differences(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> str:
    """Every option that differs, with both values; empty if none does.

    Args:
        theirs: of the run that wrote a file.
        ours: of the run at hand. A tuple comes back from JSON or YAML as a list; that is no difference.
    """
    theirs, ours = (_flat(json.loads(json.dumps(dict(each)))) for each in (theirs, ours))
    lines = []
    for name in {**theirs, **ours}:
        there, here = theirs.get(name, _NOTHING), ours.get(name, _NOTHING)
        if there != here:
            lines.append(f"{name!r}: {_shown(there)} there, {_shown(here)} here")
    return "; ".join(lines)


def _flat(options: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in options.items():
        name = f"{prefix}{key}"
        flat |= _flat(value, f"{name}.") if isinstance(value, Mapping) and value else {name: value}
    return flat


def _shown(value: Any) -> str:
    return "nothing" if value is _NOTHING else repr(value)
