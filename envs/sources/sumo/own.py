"""A network of the user's own, with random traffic or with the user's own routes."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from envs.scene import SceneError
from envs.sources.sumo.classes import DEFAULT_TYPES, Body, make_body
from envs.sources.sumo.netmap import NetMap, build_map
from envs.sources.sumo.network import Network, read_network
from envs.sources.sumo.xml import Listener, scan_xml

TRAVELLERS = ("vehicle", "trip", "flow", "person", "personFlow")
"""Elements of a route file that put somebody on the road."""


@dataclass
class Routes(Listener):
    """What has to be known of a route file before it is simulated.

    Attributes:
        path: of the file.
        bodies: what a road user of each type looks like; nothing for those that are not on the road.
        first: when the first one departs [s].
        last: when the last one departs [s].
    """

    path: Path
    bodies: dict[str, Body | None] = field(default_factory=dict)
    first: float = math.inf
    last: float = -math.inf

    def __post_init__(self) -> None:
        for name, vehicle_class in DEFAULT_TYPES.items():
            self.bodies[name] = make_body({"vClass": vehicle_class})

    def start(self, tag: str, attributes: dict[str, str]) -> None:
        """Learn a type or a departure."""
        if tag == "vType":
            self._learn(attributes)
        elif tag in TRAVELLERS:
            for name in ("depart", "begin", "end"):
                with suppress(KeyError, ValueError):  # a departure may be an event: "triggered"
                    time = read_time(attributes[name])
                    self.first, self.last = min(self.first, time), max(self.last, time)

    def _learn(self, attributes: dict[str, str]) -> None:
        name = attributes.get("id", "")
        known = {"vClass": DEFAULT_TYPES[name]} if name in DEFAULT_TYPES else {}
        try:
            self.bodies[name] = make_body(known | attributes)
        except ValueError as error:
            raise SceneError(
                f"{self.path}: type {name!r} has a size that is no number ({error}); correct it."
            ) from error

    def stretch(self, number: int, duration: float) -> float:
        """When the simulation of a unit begins: units take turns over the time in which somebody departs [s].

        Args:
            number: of the unit.
            duration: recorded in one simulation [s].

        Examples:
            >>> hour = Routes(Path("a.rou.xml"), first=0.0, last=100.0)
            >>> [hour.stretch(number, 40.0) for number in range(4)]
            [0.0, 40.0, 0.0, 40.0]
        """
        count = max(1, int((self.last - self.first) // duration))
        return self.first + number % count * duration


def read_time(text: str) -> float:
    """Seconds, or SUMO's ``h:m:s`` and ``d:h:m:s``, in seconds.

    Examples:
        >>> read_time("90.5"), read_time("1:01:30")
        (90.5, 3690.0)
    """
    seconds = 0.0
    for part, size in zip(reversed(text.split(":")), (1, 60, 3600, 86400), strict=False):
        seconds += float(part) * size
    return seconds


def read_routes(path: Path) -> Routes:
    """Scan a route file.

    Args:
        path: ``.rou.xml``, trips too, plain or ``.gz``.

    Raises:
        SceneError: the file is missing, unreadable, or nobody departs in it.
    """
    routes = Routes(path)
    scan_xml(path, routes, "a route file (.rou.xml)")
    if not math.isfinite(routes.first):
        raise SceneError(f"{path}: nobody departs in it; give a route file with vehicles, trips, flows or persons.")
    return routes


def check_network(network: Network) -> Network:
    """The network, if scenes can be made of it.

    Raises:
        SceneError: it has no streets, or no lanes inside junctions.
    """
    if not any(edge.lanes_for("vehicle") for edge in network.edges.values()):
        raise SceneError(f"{network.path}: no street where cars may drive; give a network (.net.xml) with roads.")
    if not network.connections:
        raise SceneError(
            f"{network.path}: no lanes lead through its junctions; build it again with netconvert, without "
            "--no-internal-links."
        )
    return network


def own_network(path: Path, point_spacing: float) -> tuple[Network, NetMap]:
    """A network of the user's own and its map; the last one is kept, for all units simulate on it.

    Args:
        path: ``.net.xml``, plain or ``.gz``.
        point_spacing: largest gap between two points of a line [m].

    Raises:
        SceneError: the file is missing, no network, or has no streets.
    """
    try:
        changed = path.stat().st_mtime_ns
    except OSError as error:
        raise SceneError(f"{path}: cannot be read as a SUMO network ({error}); give a .net.xml.") from error
    return _read_once(path, changed, point_spacing)


@lru_cache(maxsize=1)
def _read_once(path: Path, changed: int, point_spacing: float) -> tuple[Network, NetMap]:
    network = check_network(read_network(path))
    return network, build_map(network, point_spacing)


def stem(path: str) -> str:
    """The name of a network file without its endings, for the names of units and scenes.

    Examples:
        >>> stem("maps/Old Town.net.xml.gz")
        'Old-Town'
    """
    return re.sub(r"[^\w-]+", "-", Path(path).name.split(".")[0]).strip("-") or "own"
