"""The ways that somebody in random traffic may be on, for all that one sees: where it came from, and its lane."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from envs.sources.sumo.demand import targets_of
from envs.sources.sumo.network import Network, run_sumo
from envs.sources.sumo.xml import read_xml

Way = tuple[str, ...]
"""Streets from the first to the last."""


@dataclass(frozen=True)
class Driver:
    """Where somebody is on its way, in a saved state.

    Attributes:
        name: SUMO's id.
        way: that it is on.
        here: place in it of the street that it is on, or of that behind it where it is in a junction.
        lane: that it is on.
    """

    name: str
    way: Way
    here: int
    lane: str

    @property
    def settled(self) -> Way:
        """The streets that it has driven, is on, or cannot help taking next."""
        return self.way[: self.here + (2 if self.lane.startswith(":") else 1)]


def possible_ways(
    state: ElementTree.Element, names: Collection[str], network: Network, demand: Path, by_lane: bool, folder: Path
) -> dict[str, dict[Way, float]]:
    """The ways that some drivers may be on, and how likely each is.

    Random traffic draws a trip's end among the ways out, alike, and takes the fastest way there. So those are possible
    that begin as the driver's own way has and that go on from its lane; where its own way asks for another lane, it is
    about to change to it, and the next street is known. Only the next street is held against the lane, and other ends
    have the fastest way of an empty road.

    Args:
        state: saved by SUMO.
        names: SUMO's ids of the drivers.
        network: where.
        demand: the random traffic, see :func:`~envs.sources.sumo.demand.write_demand`.
        by_lane: a way out is as likely as it has lanes.
        folder: where SUMO writes.

    Returns:
        For each driver its possible ways, the probabilities of which sum to 1; drivers without a trip are left out.
    """
    traffic = read_xml(demand, "random traffic")
    trips = {trip.get("id"): trip for trip in traffic.iter("trip")}
    drivers = [driver for driver in _drivers(state) if driver.name in trips and driver.name in names]
    ends = {each.name: Counter(targets_of(network, trips[each.name].get("from"), by_lane)) for each in drivers}
    fastest = _fastest(
        traffic, [(trips[each.name], end) for each in drivers for end in ends[each.name]], network, folder
    )
    leads = {(each.source, network.lanes[each.target].edge_id) for each in network.connections}
    possible = {}
    for driver in drivers:
        found: Counter[Way] = Counter()
        for end, share in ends[driver.name].items():
            own = end == trips[driver.name].get("to")  # the fastest, when it set out
            way = driver.way if own else fastest.get((driver.name, end), ())
            if way[: len(driver.settled)] == driver.settled and can_take(driver, way, leads):
                found[way] += share
        possible[driver.name] = {way: share / found.total() for way, share in found.items()}
    return possible


def draw_ways(state: ElementTree.Element, possible: dict[str, dict[Way, float]], rng: np.random.Generator) -> None:
    """Give drivers of a saved state ways that they may be on.

    Args:
        state: is changed.
        possible: see :func:`possible_ways`.
        rng: that they are drawn from.
    """
    routes = {route.get("id"): route for route in state.iter("route")}
    for vehicle in state.iter("vehicle"):
        if ways := possible.get(vehicle.get("id")):
            drawn = list(ways)[rng.choice(len(ways), p=list(ways.values()))]
            routes[vehicle.get("route")].set("edges", " ".join(drawn))


def _drivers(state: ElementTree.Element) -> Iterator[Driver]:
    """Whoever drives in a saved state."""
    lanes = {
        name: lane.get("id")
        for lane in state.iter("lane")
        for vehicles in lane.iter("vehicles")
        for name in vehicles.get("value").split()
    }
    ways = {route.get("id"): tuple(route.get("edges").split()) for route in state.iter("route")}
    for vehicle in state.iter("vehicle"):
        if (name := vehicle.get("id")) in lanes:  # the others wait to come in
            here = int(vehicle.get("state").split()[2])
            yield Driver(name, ways[vehicle.get("route")], here, lanes[name])


def can_take(driver: Driver, way: Way, leads: Collection[tuple[str, str]]) -> bool:
    """A way goes on from the driver's lane, or at least as its own way does.

    Args:
        driver: somewhere.
        way: that begins as the driver's own.
        leads: pairs of a lane and a street that it leads to.
    """
    ahead = len(driver.settled)
    if driver.lane.startswith(":") or way[ahead : ahead + 1] == driver.way[ahead : ahead + 1]:
        return True
    return all(not each[ahead:] or (driver.lane, each[ahead]) in leads for each in (way, driver.way))


def _fastest(
    traffic: ElementTree.Element, wanted: list[tuple[ElementTree.Element, str]], network: Network, folder: Path
) -> dict[tuple[str, str], Way]:
    """Fastest ways of trips to other ends, by trip and end, as SUMO finds them; some may have none."""
    root = ElementTree.Element("routes")
    root.extend(traffic.iter("vType"))
    for number, (trip, end) in enumerate(wanted):
        told = {"id": str(number), "type": trip.get("type"), "depart": "0", "from": trip.get("from"), "to": end}
        ElementTree.SubElement(root, "trip", told)
    ElementTree.ElementTree(root).write(folder / "trips.xml", encoding="utf-8")
    options = {"net-file": network.path.resolve(), "route-files": folder / "trips.xml"}
    quiet = {"ignore-errors": True, "no-warnings": True, "xml-validation": "never"}
    run_sumo("duarouter", options | {"output-file": folder / "ways.xml"} | quiet)
    found = {}
    for vehicle in read_xml(folder / "ways.xml", "routes").iter("vehicle"):
        trip, end = wanted[int(vehicle.get("id"))]
        found[trip.get("id"), end] = tuple(vehicle.find("route").get("edges").split())
    return found
