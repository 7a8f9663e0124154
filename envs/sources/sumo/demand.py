"""Random traffic demand on a network: who drives or walks where, and when.

Vehicles leave through the dead ends; some are on the road from the start, the others come in through the dead ends. A
network without dead ends (of the user's own) is filled from the streets themselves, and every street is a way out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envs.scene import STEP_SECONDS, SceneError
from envs.sources.sumo.network import NetEdge, Network
from envs.sources.sumo.options import SumoOptions, draw_options, settings

IMPERFECT = ("sigma", "impatience")
"""Attributes of a driver, 0 to 1, that the option ``imperfection`` multiplies."""
SOURCE_SHARE = 4
"""In a network without dead ends, traffic comes in on one of so many streets."""

TypeTable = dict[str, dict[str, object]]
"""Attributes of SUMO's ``vType`` by its id."""


@dataclass(frozen=True)
class _Trip:
    """Somebody's way through the network; ``element`` is its XML, to be completed with an id."""

    depart: float
    type_name: str
    element: str


def traffic_rules(rules: dict[str, object], options: SumoOptions) -> dict[str, object]:
    """The traffic of a preset with what a request replaces.

    Args:
        rules: ``traffic`` of a preset in ``sumo.yaml``.
        options: of the request.

    Examples:
        >>> from envs.sources.sumo.options import make_options
        >>> rules = {"vehicles": [10.0, 20.0], "inflow": 0.1, "trucks": [0.0, 0.1], "cyclists": 1.0, "pedestrians": 2.0}
        >>> traffic_rules(rules, make_options(density=1.5, trucks=0.3))
        {'vehicles': [15.0, 30.0], 'inflow': 0.15, 'trucks': 0.3, 'cyclists': 1.0, 'pedestrians': 2.0}
    """

    def denser(value: float | list[float]) -> float | list[float]:
        factor = options.density
        return [round(v * factor, 9) for v in value] if isinstance(value, list) else round(value * factor, 9)

    shares = {name: getattr(options, name) for name in ("trucks", "cyclists", "pedestrians")}
    given = {name: value for name, value in shares.items() if value is not None}
    return rules | {"vehicles": denser(rules["vehicles"]), "inflow": denser(rules["inflow"])} | given


def draw_types(changes: dict[str, dict], imperfection: float, rng: np.random.Generator) -> TypeTable:
    """Types of all road users, named after them: ``car0``, ``car1``, ...

    Args:
        changes: ``road_users`` of a preset: attributes that it replaces.
        imperfection: factor of :data:`IMPERFECT`.
        rng: of the unit.

    Examples:
        >>> types = draw_types({"truck": {"types": 1, "length": 12.0}}, 0.0, np.random.default_rng(0))
        >>> types["truck0"]["length"], types["car5"]["sigma"], "truck1" in types
        (12.0, 0.0, False)
    """
    table: TypeTable = {}
    for road_user, usual in settings()["road_users"].items():
        ranges = usual | changes.get(road_user, {})
        count = ranges.pop("types")
        for i in range(count):
            drawn = draw_options(ranges, rng)
            errors = {name: min(1.0, drawn[name] * imperfection) for name in IMPERFECT if name in drawn}
            table[f"{road_user}{i}"] = drawn | errors
    return table


def write_demand(
    path: Path, network: Network, types: TypeTable, traffic: dict[str, float], end: float, rng: np.random.Generator
) -> None:
    """Write a route file; a trip's id is its place in it.

    Args:
        path: of the file.
        network: where.
        types: see :func:`draw_types`.
        traffic: see :func:`traffic_rules`, pairs drawn.
        end: of the simulation [s].
        rng: of the unit.

    Raises:
        SceneError: the network has no street for cars.
    """
    trips = sorted(_Demand(network, types, traffic, rng).trips(end), key=lambda trip: trip.depart)
    kinds = [
        f'<vType id="{name}" ' + " ".join(f'{key}="{value}"' for key, value in attributes.items()) + "/>"
        for name, attributes in types.items()
    ]
    told = [
        trip.element.format(f'id="{i}" type="{trip.type_name}" depart="{trip.depart:.1f}"')
        for i, trip in enumerate(trips)
    ]
    path.write_text("\n".join(["<routes>", *kinds, *told, "</routes>"]), encoding="utf-8")


def exits_by_lane(traffic: dict[str, object]) -> bool:
    """A way out is as likely as it has lanes.

    Args:
        traffic: of a preset in ``sumo.yaml``.

    Examples:
        >>> presets = settings()["presets"]
        >>> [exits_by_lane(presets[name]["traffic"]) for name in ("motorway", "grid")]
        [True, False]
    """
    return traffic.get("inflow_per", "street") == "lane"


def targets_of(network: Network, source: str, by_lane: bool) -> list[str]:
    """Where a trip may end, each as likely as the others.

    Args:
        network: where.
        source: street that it begins on.
        by_lane: a way out stands there once for each of its lanes.
    """
    targets = network.ways_out()[source]
    return [t for t in targets for _ in network.edges[t].lanes_for("vehicle")] if by_lane else targets


class _Demand:
    """Draws trips."""

    def __init__(self, network: Network, types: TypeTable, traffic: dict[str, float], rng: np.random.Generator) -> None:
        self.network, self.types, self.traffic, self.rng = network, types, traffic, rng
        self.ways_out = network.ways_out()
        self.roads = [e for e in network.edges.values() if self.ways_out[e.edge_id] and e.lanes_for("vehicle")]
        if not self.roads:
            raise SceneError(f"{network.path}: no street where cars may drive; give a network with roads.")
        self.entries = [e for e in self.roads if e.start in network.dead_ends] or self.roads[::SOURCE_SHARE]
        self.inner = [e for e in self.roads if e.start not in network.dead_ends] or self.roads
        self.by_lane = exits_by_lane(traffic)
        self.counts = {
            user: sum(name.rstrip("0123456789") == user for name in types) for user in settings()["road_users"]
        }

    def trips(self, end: float) -> Iterator[_Trip]:
        """Everybody's trip, in no order."""
        rng, traffic = self.rng, self.traffic
        lane_km = sum(e.length * len(e.lanes_for("vehicle")) for e in self.roads) / 1000
        road_km = sum(e.length for e in self.roads) / 1000
        pavements = [e for e in self.network.edges.values() if e.lanes_for("foot")]
        gates = [e for e in self.entries for _ in range(len(e.lanes_for("vehicle")) if self.by_lane else 1)]
        for _ in range(round(traffic["vehicles"] * lane_km)):
            yield self._drive(self._vehicle(), 0.0, self._anywhere(self.inner))
        for _ in range(round(traffic["inflow"] * end * len(gates))):
            yield self._drive(self._vehicle(), rng.uniform(STEP_SECONDS, end), gates[rng.integers(len(gates))])
        for _ in range(round(traffic["cyclists"] * road_km)):
            yield self._drive("cyclist", 0.0, self._anywhere(self.inner))
        for _ in range(round(traffic["pedestrians"] * road_km) if pavements else 0):
            yield self._walk(self._anywhere(pavements), self._anywhere(pavements))

    def _anywhere(self, edges: list[NetEdge]) -> NetEdge:
        """An edge, the longer the likelier."""
        length = np.cumsum([edge.length for edge in edges])
        return edges[int(np.searchsorted(length, self.rng.uniform(0, length[-1])))]

    def _vehicle(self) -> str:
        return "truck" if self.rng.random() < self.traffic["trucks"] else "car"

    def _type(self, road_user: str) -> str:
        return f"{road_user}{self.rng.integers(self.counts[road_user])}"

    def _drive(self, road_user: str, depart: float, source: NetEdge) -> _Trip:
        name = self._type(road_user)
        targets = targets_of(self.network, source.edge_id, self.by_lane)
        # at the start anywhere; later just inside the dead end, the tail on the map
        position = "random_free" if depart == 0 else f"{self.types[name]['length'] + 0.5:.2f}"
        way = f'from="{source.edge_id}" to="{targets[self.rng.integers(len(targets))]}" departPos="{position}"'
        return _Trip(depart, name, f'<trip {{}} {way} departSpeed="max" departLane="best"/>')

    def _walk(self, source: NetEdge, target: NetEdge) -> _Trip:
        name = self._type("pedestrian")
        way = f'<walk from="{source.edge_id}" to="{target.edge_id}"/>'
        start = self.rng.uniform(0, source.length)
        return _Trip(0.0, name, f'<person {{}} departPos="{start:.2f}">{way}</person>')
