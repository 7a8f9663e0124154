"""What can be asked of scenes from SUMO: the settings of ``sumo.yaml``, and how a request replaces some of them."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib.resources import files

import numpy as np
import yaml

from envs.scene import LOG_STEPS, STEP_SECONDS
from envs.sources.sumo.cut import Crop

_FROM_ZERO = ("warmup", "trucks", "cyclists", "pedestrians", "imperfection")
"""Options that may be 0; all others must be positive."""


@dataclass(frozen=True)
class SumoOptions:
    """Options of ``sumo.yaml``, which explains each one and holds all defaults."""

    scenes_per_unit: int
    windows: int
    window_spacing: float
    warmup: float
    radius: float
    map_margin: float
    max_agents: int
    min_agents: int
    max_predict: int
    point_spacing: float
    density: float
    trucks: float | None
    cyclists: float | None
    pedestrians: float | None
    imperfection: float

    @property
    def crop(self) -> Crop:
        """What belongs to a scene."""
        return Crop(**{field.name: getattr(self, field.name) for field in fields(Crop)})

    @property
    def changed(self) -> dict[str, float]:
        """Those that differ from ``sumo.yaml``.

        Examples:
            >>> make_options(radius=60, windows=4).changed
            {'radius': 60.0}
        """
        default = make_options()
        return {name: getattr(self, name) for name in NAMES if getattr(self, name) != getattr(default, name)}


NAMES = [field.name for field in fields(SumoOptions)]


@cache
def settings() -> dict[str, dict]:
    """Everything in ``sumo.yaml``."""
    return yaml.safe_load(files("envs.sources.sumo").joinpath("sumo.yaml").read_text(encoding="utf-8"))


def settings_digest() -> int:
    """A number of 32 bits that changes with ``sumo.yaml``."""
    return zlib.crc32(json.dumps(settings(), sort_keys=True).encode())


def check_names(what: str, asked: Iterable[object], names: Iterable[str]) -> None:
    """Refuse names that do not exist.

    Raises:
        ValueError: naming the first one and all that exist.

    Examples:
        >>> check_names("split", ["eval"], ["train", "test"])
        Traceback (most recent call last):
        ...
        ValueError: SUMO scenes have no split 'eval'; there are train, test.
    """
    names = list(names)
    for name in asked:
        if name not in names:
            raise ValueError(f"SUMO scenes have no {what} {name!r}; there are {', '.join(names)}.")


def check_count(what: str, value: object, least: int, most: int, fix: str = "") -> None:
    """Refuse what is no integer in a range.

    Raises:
        ValueError: quoting the value.

    Examples:
        >>> check_count("seed", 1.5, 0, 9)
        Traceback (most recent call last):
        ...
        ValueError: seed must lie in 0 ... 9 (an integer), got 1.5.
    """
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{what} must lie in {least} ... {most} (an integer), got {value!r}.")
    if not least <= value <= most:
        raise ValueError(f"{what} must lie in {least} ... {most}, got {value}{fix}.")


def make_options(**overrides: float) -> SumoOptions:
    """The options of ``sumo.yaml``, some replaced.

    Raises:
        ValueError: an option that does not exist, or a value that makes no scenes.

    Examples:
        >>> make_options(radius=60.0).radius
        60.0
    """
    check_names("option", sorted(overrides), NAMES)
    given = {name: _check_value(name, value) for name, value in overrides.items()}
    options = replace(SumoOptions(**settings()["options"]), **given)
    shortest = LOG_STEPS * STEP_SECONDS
    if options.window_spacing < shortest:
        raise ValueError(f"window_spacing must be at least {shortest:.1f} s, got {options.window_spacing}.")
    return options


def _check_value(name: str, value: object) -> float | None:
    """The value as the number that an option takes."""
    default = settings()["options"][name]
    if value is None and default is None:
        return None
    whole = isinstance(default, int)
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    if not number or (whole and value != int(value)):
        raise ValueError(f"SUMO option {name} takes {'an integer' if whole else 'a number'}, got {value!r}.")
    if value < 0 or (value == 0 and name not in _FROM_ZERO):
        raise ValueError(
            f"SUMO option {name} must {'not be negative' if name in _FROM_ZERO else 'be positive'}, got {value}."
        )
    if name == "trucks" and value > 1:
        raise ValueError(f"SUMO option trucks is a share of the vehicles, 0 to 1, got {value}.")
    return int(value) if whole else float(value)


def parse(text: str) -> dict[str, object]:
    """Words ``name=value,name=value`` -> arguments; numbers become numbers.

    Raises:
        ValueError: a word without a ``=``, or a name that comes twice.

    Examples:
        >>> parse("num_scenes=160,split=train,radius=60.5,net=a/b.net.xml")
        {'num_scenes': 160, 'split': 'train', 'radius': 60.5, 'net': 'a/b.net.xml'}
    """
    told: dict[str, object] = {}
    for word in text.split(","):
        name, equals, value = (part.strip() for part in word.partition("="))
        if not equals:
            raise ValueError(
                f"{text!r}: {name!r} is not of the form name=value; write for example num_scenes=160,seed=0."
            )
        if name in told:
            raise ValueError(f"{text!r}: {name} comes twice; say it once.")
        told[name] = _number_or_text(value)
    return told


def _number_or_text(value: str) -> object:
    for kind in (int, float):
        try:
            return kind(value)
        except ValueError:
            continue
    return value


def draw_options(ranges: dict[str, object], rng: np.random.Generator) -> dict[str, object]:
    """Draw a value for every option that is a pair ``[low, high]``; integers if both are.

    Examples:
        >>> draw_options({"rand": True, "lanes": [2, 2], "speed": [8.0, 8.0]}, np.random.default_rng(0))
        {'rand': True, 'lanes': 2, 'speed': 8.0}
    """

    def draw(value: object) -> object:
        if not isinstance(value, list | tuple):
            return value
        low, high = value
        if isinstance(low, int) and isinstance(high, int):
            return int(rng.integers(low, high + 1))
        return round(float(rng.uniform(low, high)), 3)

    return {name: draw(value) for name, value in ranges.items()}
