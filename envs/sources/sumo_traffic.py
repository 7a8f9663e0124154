"""Random traffic on a SUMO network: who drives where, the simulation itself, and what it recorded."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envs.scene import STEP_SECONDS, AgentKind
from envs.sources.sumo_network import NetEdge, Network, draw_options, run_sumo

TYPES_EACH = 24
"""Kinds of cars, trucks, cyclists and pedestrians each; a road user is one of them."""

_LATERAL = {
    # no sideways slide of a standing vehicle, and little of a slow one, so that headings stay plausible
    "lcMaxSpeedLatStanding": 0.0,
    "lcMaxSpeedLatFactor": 0.12,
}
ROAD_USERS: dict[str, tuple[AgentKind, dict[str, object]]] = {
    "car": (
        AgentKind.VEHICLE,
        {
            "vClass": "passenger",
            "length": [4.1, 5.2],
            "width": [1.75, 2.05],
            "height": [1.4, 1.9],
            "accel": [1.8, 3.0],
            "decel": [3.5, 4.8],
            "emergencyDecel": 7.0,
            "sigma": [0.1, 0.5],
            "sigmaStep": 1.0,
            "tau": [1.0, 1.8],
            "minGap": [1.5, 3.0],
            "speedFactor": [0.8, 1.2],
            "speedDev": 0.05,
            "maxSpeedLat": [0.7, 1.2],
            "lcSpeedGain": [0.5, 1.5],
            **_LATERAL,
        },
    ),
    "truck": (
        AgentKind.VEHICLE,
        {
            "vClass": "truck",
            "length": [6.5, 9.0],
            "width": [2.3, 2.5],
            "height": [2.8, 3.6],
            "accel": [0.9, 1.4],
            "decel": [3.0, 4.0],
            "emergencyDecel": 6.0,
            "sigma": [0.1, 0.4],
            "sigmaStep": 1.0,
            "tau": [1.2, 2.0],
            "minGap": [2.0, 3.5],
            "speedFactor": [0.75, 1.0],
            "speedDev": 0.05,
            "maxSpeedLat": [0.5, 0.8],
            **_LATERAL,
        },
    ),
    "cyclist": (
        AgentKind.CYCLIST,
        {
            "vClass": "bicycle",
            "length": [1.6, 1.9],
            "width": [0.55, 0.75],
            "height": [1.6, 1.9],
            "accel": [0.8, 1.3],
            "decel": [2.5, 3.5],
            "emergencyDecel": 5.0,
            "sigma": [0.1, 0.4],
            "sigmaStep": 1.0,
            "tau": [0.8, 1.4],
            "minGap": [0.5, 1.0],
            "maxSpeed": [4.0, 7.0],
            "speedFactor": 1.0,
            "maxSpeedLat": [0.4, 0.7],
            **_LATERAL,
        },
    ),
    "pedestrian": (
        AgentKind.PEDESTRIAN,
        {
            "vClass": "pedestrian",
            "length": [0.4, 0.6],
            "width": [0.5, 0.7],
            "height": [1.5, 1.9],
            "maxSpeed": [1.0, 1.9],
            "speedDev": 0.1,
        },
    ),
}
"""Attributes of SUMO's ``vType`` for each road user (metres, seconds); a pair is drawn anew for each of its types."""


@dataclass(frozen=True)
class Recording:
    """What a simulation wrote down, at 10 Hz.

    Attributes:
        kind: ``[V]``, :class:`~envs.scene.AgentKind`.
        is_car: ``[V]`` bool, vehicles that can be an SDC.
        extent: ``[V, 3]``, length, width, height [m].
        front: ``[V, T, 2]``, middle of the front bumper; NaN where the road user is not there [m].
        angle: ``[V, T]``, clockwise from north; NaN likewise [degrees].
        speed: ``[V, T]``, along the lane; NaN likewise [m/s].
        lights: the letters of each traffic light at every step, ``{id: [state, ...]}``.
    """

    kind: np.ndarray
    is_car: np.ndarray
    extent: np.ndarray
    front: np.ndarray
    angle: np.ndarray
    speed: np.ndarray
    lights: dict[str, list[str]]


def simulate_traffic(
    network: Network, traffic: dict[str, object], *, seed: int, warmup: float, duration: float
) -> Recording:
    """Fill a network with random traffic, simulate it, and read what happened after the warm-up.

    Args:
        network: where; the files of the simulation are written next to its own.
        traffic: densities of a preset (see ``sumo.yaml``); pairs are drawn.
        seed: of the demand and of the simulation.
        warmup: simulated but not recorded [s].
        duration: recorded [s].

    Raises:
        RuntimeError: SUMO failed.
    """
    folder = network.path.parent
    rng = np.random.default_rng((seed, 1))  # a stream of its own: the network has (seed)
    types = dict(kind for road_user in ROAD_USERS for kind in draw_types(road_user, rng))
    trips = _trips(network, types, draw_options(traffic, rng), warmup + duration, rng)
    trips = sorted(trips, key=lambda trip: trip.depart)
    _write_inputs(folder, types, trips, network.lights)
    _run(network, warmup, duration, seed)
    first, steps = round(warmup / STEP_SECONDS), round(duration / STEP_SECONDS)
    numbers, values = _read_tracks(folder / "tracks.csv", first, steps)
    names = [trips[number].type_name for number in numbers]
    road_users = [name.rstrip("0123456789") for name in names]
    return Recording(
        kind=np.array([int(ROAD_USERS[road_user][0]) for road_user in road_users]),
        is_car=np.array([road_user == "car" for road_user in road_users]),
        extent=np.array([[types[name][side] for side in ("length", "width", "height")] for name in names]),
        front=values[..., :2],
        angle=values[..., 2],
        speed=values[..., 3],
        lights=_read_lights(folder / "lights.xml", first, steps) if network.lights else {},
    )


def _run(network: Network, warmup: float, duration: float, seed: int) -> None:
    """Simulate the files that lie next to the network, and record tracks and lights there."""
    folder = network.path.parent
    run_sumo(
        "sumo",
        {
            "net-file": network.path,
            "route-files": folder / "demand.rou.xml",
            "additional-files": folder / "events.add.xml",
            "fcd-output": folder / "tracks.csv",
            "fcd-output.attributes": "x,y,angle,speed",
            "device.fcd.begin": warmup,
            "end": warmup + duration,
            "seed": seed,
            "step-length": STEP_SECONDS,
            "lateral-resolution": 0.8,
            "time-to-teleport": -1,  # a gridlock stays one: nobody vanishes and reappears elsewhere
            "collision.action": "none",
            "max-depart-delay": 5,
            "ignore-route-errors": True,
            "precision": 3,
            "xml-validation": "never",
            "no-step-log": True,
            "no-warnings": True,
        },
    )


def draw_types(road_user: str, rng: np.random.Generator) -> list[tuple[str, dict[str, object]]]:
    """Names and attributes of the types of one road user.

    Args:
        road_user: a key of :data:`ROAD_USERS`.
        rng: of the unit.
    """
    ranges = ROAD_USERS[road_user][1]
    return [(f"{road_user}{i}", draw_options(ranges, rng)) for i in range(TYPES_EACH)]


def _write_inputs(folder: Path, types: dict[str, dict[str, object]], trips: list[_Trip], lights: list[str]) -> None:
    """Demand (a trip's id is its place in the list) and the order to record the lights."""

    def write(name: str, root: str, elements: list[str]) -> None:
        (folder / name).write_text("\n".join([f"<{root}>", *elements, f"</{root}>"]), encoding="utf-8")

    kinds = [
        f'<vType id="{name}" ' + " ".join(f'{key}="{value}"' for key, value in attributes.items()) + "/>"
        for name, attributes in types.items()
    ]
    write("demand.rou.xml", "routes", kinds + [_trip_xml(i, trip) for i, trip in enumerate(trips)])
    timed = [f'<timedEvent type="SaveTLSStates" source="{light}" dest="lights.xml"/>' for light in lights]
    write("events.add.xml", "additional", timed)


@dataclass(frozen=True)
class _Trip:
    """Somebody's way through the network; ``element`` is its XML, to be completed with an id."""

    depart: float
    type_name: str
    element: str


def _trips(
    network: Network,
    types: dict[str, dict[str, object]],
    traffic: dict[str, float],
    end: float,
    rng: np.random.Generator,
) -> Iterator[_Trip]:
    """Everybody's trip, in no order.

    Vehicles leave through the dead ends; some are on the road from the start, the others enter through the dead ends.
    """
    ways_out = network.ways_out()
    roads = [edge for edge in network.edges.values() if ways_out[edge.edge_id]]
    entries = [edge for edge in roads if edge.start in network.dead_ends]
    inner = [edge for edge in roads if edge.start not in network.dead_ends]
    pavements = [edge for edge in network.edges.values() if edge.lanes_for("foot")]
    lane_km = sum(edge.length * len(edge.lanes_for("vehicle")) for edge in roads) / 1000
    road_km = sum(edge.length for edge in roads) / 1000

    def anywhere(edges: list[NetEdge]) -> NetEdge:
        length = np.cumsum([edge.length for edge in edges])
        return edges[int(np.searchsorted(length, rng.uniform(0, length[-1])))]

    def drive(road_user: str, depart: float, source: NetEdge) -> _Trip:
        name = f"{road_user}{rng.integers(TYPES_EACH)}"
        targets = ways_out[source.edge_id]
        # at the start anywhere; later just inside the dead end, the tail on the map
        position = "random_free" if depart == 0 else f"{types[name]['length'] + 0.5:.2f}"
        way = f'from="{source.edge_id}" to="{targets[rng.integers(len(targets))]}" departPos="{position}"'
        return _Trip(depart, name, f'<trip {{}} {way} departSpeed="max" departLane="best"/>')

    def walk(source: NetEdge, target: NetEdge) -> _Trip:
        name = f"pedestrian{rng.integers(TYPES_EACH)}"
        way = f'<walk from="{source.edge_id}" to="{target.edge_id}"/>'
        return _Trip(0.0, name, f'<person {{}} departPos="{rng.uniform(0, source.length):.2f}">{way}</person>')

    def vehicle() -> str:
        return "truck" if rng.random() < traffic["trucks"] else "car"

    for _ in range(round(traffic["vehicles"] * lane_km)):
        yield drive(vehicle(), 0.0, anywhere(inner))
    for _ in range(round(traffic["inflow"] * end * len(entries))):
        yield drive(vehicle(), rng.uniform(STEP_SECONDS, end), entries[rng.integers(len(entries))])
    for _ in range(round(traffic["cyclists"] * road_km)):
        yield drive("cyclist", 0.0, anywhere(inner))
    for _ in range(round(traffic["pedestrians"] * road_km) if pavements else 0):
        yield walk(anywhere(pavements), anywhere(pavements))


def _trip_xml(number: int, trip: _Trip) -> str:
    return trip.element.format(f'id="{number}" type="{trip.type_name}" depart="{trip.depart:.1f}"')


_LIGHT_STATE = re.compile(r'<tlsState time="([^"]+)" id="([^"]+)".* state="([^"]+)"')


def _read_lights(path: Path, first: int, steps: int) -> dict[str, list[str]]:
    """States of every light from step ``first`` on."""
    states: dict[str, list[str]] = {}
    for match in _LIGHT_STATE.finditer(path.read_text(encoding="utf-8")):
        step = round(float(match[1]) / STEP_SECONDS) - first
        if 0 <= step < steps:
            states.setdefault(match[2], []).append(match[3])
    return states


def _read_tracks(path: Path, first: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers of the trips that were seen ``[V]``, and their x, y, angle and speed ``[V, T, 4]`` (NaN where absent)."""
    wanted = ("timestep_time", "vehicle_id", "vehicle_x", "vehicle_y", "vehicle_angle", "vehicle_speed")
    with path.open(encoding="utf-8") as file:
        columns = {name: i for i, name in enumerate(file.readline().strip().split(";"))}
        table = np.loadtxt(file, delimiter=";", usecols=[columns[name] for name in wanted], ndmin=2)
    step = np.rint(table[:, 0] / STEP_SECONDS).astype(np.int64) - first
    table, step = (rows[(step >= 0) & (step < steps)] for rows in (table, step))
    numbers, row = np.unique(table[:, 1].astype(np.int64), return_inverse=True)
    values = np.full((len(numbers), steps, 4), np.nan)
    values[row, step] = table[:, 2:]
    return numbers, values
