"""Settings of the realism metric; one YAML file for each year of the challenge."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parent / "config"
"""Where the named configurations live."""

BUCKETS: dict[str, tuple[str, ...]] = {
    "kinematic": ("linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration"),
    "interactive": ("distance_to_nearest_object", "collision_indication", "time_to_collision"),
    "map_based": ("distance_to_road_edge", "offroad_indication", "traffic_light_violation"),
}
"""Metrics of each part of the meta-metric (SPEC section 7)."""
HISTOGRAMS = (*BUCKETS["kinematic"], "distance_to_nearest_object", "time_to_collision", "distance_to_road_edge")
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
    """

    low: float
    high: float
    bins: int
    pseudocount: float
    weight: float


@dataclass(frozen=True)
class Indicator:
    """How an event that happens in a rollout or not is scored.

    Attributes:
        pseudocount: added to both counts.
        weight: of the event in the meta-metric.
    """

    pseudocount: float
    weight: float


@dataclass(frozen=True)
class RealismConfig:
    """Settings of :func:`dpa.realism.realism`; defaults live in the YAML files only.

    Attributes:
        name: of the configuration, for messages.
        corner_rounding: radius of the corners of a box, as a part of half its shorter side.
        ttc_vehicle_only: score the time to collision of vehicles only.
        traffic_lights: score driving through red lights.
        histograms: for each name in :data:`HISTOGRAMS`.
        indicators: for each name in :data:`INDICATORS`.

    Examples:
        >>> config = RealismConfig.load("2024")
        >>> config.indicators["collision_indication"].weight
        0.25
        >>> config.replace(ttc_vehicle_only=True).ttc_vehicle_only
        True
    """

    name: str
    corner_rounding: float
    ttc_vehicle_only: bool
    traffic_lights: bool
    histograms: Mapping[str, Histogram]
    indicators: Mapping[str, Indicator]

    @classmethod
    def load(cls, name: str | Path) -> RealismConfig:
        """Read a configuration.

        Args:
            name: of a file in :data:`FOLDER` (``"2024"``, ``"2025"``), or a path that ends in ``.yaml``.

        Raises:
            ValueError: no such configuration, or its keys are not the expected ones.
        """
        path = Path(name) if str(name).endswith(".yaml") else FOLDER / f"{name}.yaml"
        if not path.is_file():
            known = sorted(file.stem for file in FOLDER.glob("*.yaml"))
            raise ValueError(f"no realism configuration {str(name)!r}; use one of {known} or the path of a .yaml file.")
        try:
            data = yaml.safe_load(path.read_text(encoding="utf-8"))
        except yaml.YAMLError as error:
            raise ValueError(f"{path} is not YAML: {error}") from None
        _check_keys(data, {field.name for field in dataclasses.fields(cls)} - {"name"}, path, "the file")
        config = cls(
            name=path.stem,
            corner_rounding=_read(float, data["corner_rounding"], path, "corner_rounding"),
            ttc_vehicle_only=_read(bool, data["ttc_vehicle_only"], path, "ttc_vehicle_only"),
            traffic_lights=_read(bool, data["traffic_lights"], path, "traffic_lights"),
            histograms=_read_group(Histogram, data["histograms"], HISTOGRAMS, path, "histograms"),
            indicators=_read_group(Indicator, data["indicators"], INDICATORS, path, "indicators"),
        )
        return config

    def __post_init__(self) -> None:
        weight = self.indicators["traffic_light_violation"].weight
        if weight and not self.traffic_lights:
            raise ValueError(
                f"realism configuration {self.name!r} gives traffic_light_violation the weight {weight} but has "
                "traffic_lights: false; set one of them."
            )

    def replace(self, **changes: Any) -> RealismConfig:
        """A copy with some attributes changed."""
        return dataclasses.replace(self, **changes)

    @property
    def weights(self) -> dict[str, float]:
        """Weight of every scored metric, by name."""
        weights = {name: part.weight for name, part in {**self.histograms, **self.indicators}.items()}
        if not self.traffic_lights:
            del weights["traffic_light_violation"]
        return weights


def _read_group(cls: type, data: Any, names: tuple[str, ...], path: Path, where: str) -> dict[str, Any]:
    _check_keys(data, set(names), path, where)
    kinds = {field.name: {"int": int, "float": float}[field.type] for field in dataclasses.fields(cls)}
    group = {}
    for name in names:
        _check_keys(data[name], set(kinds), path, f"{where}.{name}")
        values = {key: _read(kind, data[name][key], path, f"{where}.{name}.{key}") for key, kind in kinds.items()}
        group[name] = cls(**values)
    return group


def _read(kind: type, value: Any, path: Path, where: str) -> Any:
    number = kind is float and type(value) is int
    if type(value) is not kind and not number:
        raise ValueError(f"{path}: {where} must be of type {kind.__name__}, got {value!r}.")
    return kind(value)


def _check_keys(data: Any, expected: set[str], path: Path, where: str) -> None:
    if not isinstance(data, dict):
        raise ValueError(f"{path}: {where} must map the keys {sorted(expected)} to values, got {data!r}.")
    unknown, missing = sorted(map(str, set(data) - expected)), sorted(expected - set(data))
    if unknown or missing:
        raise ValueError(
            f"{path}: {where} has unknown keys {unknown} and lacks {missing}; it needs {sorted(expected)}."
        )
