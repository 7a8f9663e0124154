"""Settings of the realism metric; one YAML file for each year of the challenge."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from dpa.realism.quirks import Quirk

FOLDER = Path(__file__).parent / "config"
"""Where the named configurations live."""

Differences = Literal["central", "backward"]
"""How speeds come from positions."""

BUCKETS: dict[str, tuple[str, ...]] = {
    "kinematic": ("linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration"),
    "interactive": ("distance_to_nearest_object", "collision_indication", "time_to_collision"),
    "map_based": ("distance_to_road_edge", "offroad_indication", "traffic_light_violation"),
}
"""Metrics of each part of the meta-metric (realism.md section 7)."""
CONTINUOUS = (*BUCKETS["kinematic"], "distance_to_nearest_object", "time_to_collision", "distance_to_road_edge")
INDICATORS = ("collision_indication", "offroad_indication", "traffic_light_violation")


@dataclass(frozen=True)
class Histogram:
    """How a continuous feature is scored.

    Attributes:
        low: lower end of the first bin, in the unit of the feature.
        high: upper end of the last bin.
        bins: number of bins.
        pseudocount: added to the count of every bin.
        weight: of the feature in the meta-metric.
        pooled: one distribution for all agents of a scene, instead of one for each.
        per_step: one distribution for each step, instead of one for all.
    """

    low: float
    high: float
    bins: int
    pseudocount: float
    weight: float
    pooled: bool = False
    per_step: bool = False

    def __post_init__(self) -> None:
        _check_weight(self.weight)
        if self.bins < 1:
            raise ValueError(f"bins must be 1 or more, got {self.bins}.")
        if not self.low < self.high:
            raise ValueError(f"low must be less than high, got {self.low} and {self.high}.")
        _check_pseudocount(self.pseudocount)


@dataclass(frozen=True)
class Kernel:
    """How a continuous feature is scored by a Gaussian kernel density instead; no challenge does.

    Attributes:
        bandwidth: standard deviation of the kernel, in the unit of the feature.
        weight: of the feature in the meta-metric.
        pooled: see :class:`Histogram`.
        per_step: see :class:`Histogram`.
    """

    bandwidth: float
    weight: float
    pooled: bool = False
    per_step: bool = False

    def __post_init__(self) -> None:
        _check_weight(self.weight)
        if not 0 < self.bandwidth < math.inf:
            raise ValueError(f"bandwidth must be above 0, got {self.bandwidth}.")


@dataclass(frozen=True)
class Indicator:
    """How an event that happens in a rollout or not is scored.

    Attributes:
        pseudocount: added to both counts.
        weight: of the event in the meta-metric.
        pooled: one probability for all agents of a scene, instead of one for each.
    """

    pseudocount: float
    weight: float
    pooled: bool = False

    def __post_init__(self) -> None:
        _check_weight(self.weight)
        _check_pseudocount(self.pseudocount)


def _check_weight(weight: float) -> None:
    if not 0 <= weight < math.inf:
        raise ValueError(f"weight must be 0 or more, got {weight}.")


def _check_pseudocount(pseudocount: float) -> None:
    if not 0 <= pseudocount < math.inf:
        raise ValueError(f"pseudocount must be 0 or more, got {pseudocount}.")


@dataclass(frozen=True)
class RealismConfig:
    """Settings of :func:`dpa.realism.realism`; defaults live in the YAML files only.

    Attributes:
        name: of the configuration, for messages.
        differences: ``"central"``, or ``"backward"`` as in 2023.
        corner_rounding: radius of the corners of a box, as a part of half its shorter side.
        height_stretch: how much a metre of height counts when the nearest road edge is chosen.
        ttc_vehicle_only: score the time to collision of vehicles only.
        traffic_lights: score driving through red lights.
        scenario_generation: rollouts are scenes of the Scenario Generation challenge: all 91 steps, every agent scored
            at each of them, and no log to be displaced from.
        quirks: of the official code that are kept.
        continuous: for each name in :data:`CONTINUOUS`.
        indicators: for each name in :data:`INDICATORS`.

    Examples:
        >>> config = RealismConfig.load("2024")
        >>> config.indicators["collision_indication"].weight
        0.25
        >>> config.replace(ttc_vehicle_only=True).ttc_vehicle_only
        True
        >>> Quirk.UNWRAPPED_TURN in config.quirks, config.replace(quirks=frozenset()).quirks
        (True, frozenset())
    """

    name: str
    differences: Differences
    corner_rounding: float
    height_stretch: float
    ttc_vehicle_only: bool
    traffic_lights: bool
    scenario_generation: bool
    quirks: frozenset[Quirk]
    continuous: Mapping[str, Histogram | Kernel]
    indicators: Mapping[str, Indicator]

    @classmethod
    def load(cls, name: str | Path) -> RealismConfig:
        """Read a configuration: one of ours once in a process, a file of a user's anew each time.

        Args:
            name: of a file in :data:`FOLDER` (``"2024"``, ``"2025"``), or a path that ends in ``.yaml``.

        Raises:
            ValueError: no such configuration, or its keys are not the expected ones.
        """
        return _read_file(Path(name)) if str(name).endswith(".yaml") else _read_ours(str(name))

    def __post_init__(self) -> None:
        weight = self.indicators["traffic_light_violation"].weight
        if weight and not self.traffic_lights:
            raise ValueError(
                f"realism configuration {self.name!r} gives traffic_light_violation the weight {weight} but has "
                "traffic_lights: false; set one of them."
            )
        for bucket, names in BUCKETS.items():
            if not sum(self.weights.get(name, 0.0) for name in names):
                raise ValueError(
                    f"realism configuration {self.name!r} weighs nothing of {bucket}, which is told beside the whole; "
                    f"give one of {', '.join(names)} a weight above 0, as little as 1e-6 if it is not to count."
                )

    @property
    def digest(self) -> str:
        """Of all that decides a score: two files of one name need not agree.

        Examples:
            >>> config = RealismConfig.load("2024")
            >>> config.digest == config.replace(name="mine").digest, config.digest == config.replace(quirks=()).digest
            (True, False)
        """
        content = dataclasses.asdict(self) | {"quirks": sorted(self.quirks)}
        del content["name"]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

    def describe(self) -> list[str]:
        """Name and :attr:`digest`: which metric a kept result is of.

        Examples:
            >>> RealismConfig.load("2024").describe()[0]
            '2024'
        """
        return [self.name, self.digest]

    def replace(self, **changes: Any) -> RealismConfig:
        """A copy with some attributes changed."""
        return dataclasses.replace(self, **changes)

    @property
    def weights(self) -> dict[str, float]:
        """Weight of every scored metric, by name."""
        weights = {name: part.weight for name, part in {**self.continuous, **self.indicators}.items()}
        if not self.traffic_lights:
            del weights["traffic_light_violation"]
        return weights


@cache
def _read_ours(name: str) -> RealismConfig:
    return _read_file(FOLDER / f"{name}.yaml")


def _read_file(path: Path) -> RealismConfig:
    if not path.is_file():
        known = sorted(file.stem for file in FOLDER.glob("*.yaml"))
        name = path.stem if path.parent == FOLDER else str(path)
        raise ValueError(f"no realism configuration {name!r}; use one of {known} or the path of a .yaml file.")
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is not YAML: {error}") from None
    _check_keys(data, {field.name for field in dataclasses.fields(RealismConfig)} - {"name"}, path, "the file")
    switches = ("ttc_vehicle_only", "traffic_lights", "scenario_generation")
    plain = {"corner_rounding": float, "height_stretch": float} | dict.fromkeys(switches, bool)
    return RealismConfig(
        name=path.stem,
        differences=_choice(data["differences"], get_args(Differences), path, "differences"),
        quirks=frozenset(
            Quirk(_choice(name, [*Quirk], path, "quirks")) for name in _read(list, data["quirks"], path, "quirks")
        ),
        continuous=_read_group(data["continuous"], CONTINUOUS, path, "continuous"),
        indicators=_read_group(data["indicators"], INDICATORS, path, "indicators"),
        **{name: _read(kind, data[name], path, name) for name, kind in plain.items()},
    )


def _read_group(data: Any, names: tuple[str, ...], path: Path, where: str) -> dict[str, Any]:
    _check_keys(data, set(names), path, where)
    return {name: _read_estimator(data[name], path, f"{where}.{name}") for name in names}


def _read_estimator(data: Any, path: Path, where: str) -> Histogram | Kernel | Indicator:
    """The estimator whose keys the entry has."""
    if where.startswith("indicators."):
        cls: type = Indicator
    else:
        cls = Kernel if isinstance(data, dict) and "bandwidth" in data else Histogram
    fields = {field.name: field for field in dataclasses.fields(cls)}
    optional = {name for name, field in fields.items() if field.default is not dataclasses.MISSING}
    _check_keys(data, set(fields), path, where, optional)
    kinds = {"int": int, "float": float, "bool": bool}
    read = {key: _read(kinds[fields[key].type], value, path, f"{where}.{key}") for key, value in data.items()}
    try:
        return cls(**read)
    except ValueError as error:
        raise ValueError(f"{path}: {where}: {error}") from None


def _choice(value: Any, known: Sequence[str], path: Path, where: str) -> Any:
    if value not in known:
        raise ValueError(f"{path}: {where} must be one of {', '.join(known)}, got {value!r}.")
    return value


def _read(kind: type, value: Any, path: Path, where: str) -> Any:
    number = kind is float and type(value) is int
    if type(value) is not kind and not number:
        raise ValueError(f"{path}: {where} must be of type {kind.__name__}, got {value!r}.")
    return kind(value)


def _check_keys(data: Any, expected: set[str], path: Path, where: str, optional: Set[str] = frozenset()) -> None:
    if not isinstance(data, dict):
        raise ValueError(f"{path}: {where} must map the keys {sorted(expected)} to values, got {data!r}.")
    unknown, missing = sorted(map(str, set(data) - expected)), sorted(expected - optional - set(data))
    if unknown or missing:
        raise ValueError(
            f"{path}: {where} has unknown keys {unknown} and lacks {missing}; it needs {sorted(expected)}."
        )
