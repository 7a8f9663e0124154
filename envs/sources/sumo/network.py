"""Road networks of SUMO, read as plain records.

Only the facts that a map and its traffic need are read: streets, lanes and connections.
"""

from __future__ import annotations

import importlib.util
import subprocess
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import numpy as np

from envs.scene import SceneError
from envs.sources.sumo.xml import read_xml

LaneUse = Literal["vehicle", "bike", "foot"]
LaneRole = Literal["street", "internal", "crossing", "walkingarea"]

MOTOR_CLASSES = ("passenger", "taxi", "bus", "coach", "delivery", "truck", "trailer", "emergency", "motorcycle")
"""Who makes a lane one for vehicles, if admitted."""


@dataclass(frozen=True)
class NetLane:
    """One lane of a SUMO network.

    Attributes:
        lane_id: SUMO's id.
        edge_id: the edge that the lane belongs to; lanes of an edge count from the right.
        index: its place in the edge.
        use: who may be on it.
        role: a street, a connector inside a junction, a pedestrian crossing, or a place to walk.
        width: [m].
        speed: limit [m/s].
        shape: ``[n, 2]`` centre line; the outline for a walking area [m].
    """

    lane_id: str
    edge_id: str
    index: int
    use: LaneUse
    role: LaneRole
    width: float
    speed: float
    shape: np.ndarray


@dataclass(frozen=True)
class NetEdge:
    """One direction of a street: the junctions that it joins, and its lanes from right to left."""

    edge_id: str
    start: str
    end: str
    lanes: tuple[NetLane, ...]

    @cached_property
    def length(self) -> float:
        """Of the centre line of the first lane [m]."""
        return float(np.linalg.norm(np.diff(self.lanes[0].shape, axis=0), axis=1).sum())

    def lanes_for(self, use: LaneUse) -> tuple[NetLane, ...]:
        """Its lanes of one use, from right to left."""
        return tuple(lane for lane in self.lanes if lane.use == use)


@dataclass(frozen=True)
class NetConnection:
    """The way from one street lane to the next, through a connector.

    Attributes:
        source: lane that ends at the junction.
        target: lane that begins behind it.
        via: the connector's parts, in order (SUMO splits a connector where vehicles wait inside a junction).
        light: id of the traffic light that rules it; empty where there is none.
        light_index: its place in the state of the light.
        stop_sign: a vehicle must stop before it enters.
    """

    source: str
    target: str
    via: tuple[str, ...]
    light: str
    light_index: int
    stop_sign: bool


@dataclass(frozen=True)
class Network:
    """Records of one SUMO network (coordinates in metres, x east, y north).

    Attributes:
        path: the network file that SUMO simulates.
        lanes: every lane by its id.
        edges: streets by their id; connectors and crossings are not among them.
        connections: for vehicles and bicycles.
        dead_ends: ids of the junctions where a street ends; traffic enters and leaves there.
    """

    path: Path
    lanes: dict[str, NetLane]
    edges: dict[str, NetEdge]
    connections: tuple[NetConnection, ...]
    dead_ends: frozenset[str]

    @property
    def lights(self) -> list[str]:
        """Ids of the traffic lights, sorted."""
        return sorted({c.light for c in self.connections if c.light})

    def ways_out(self) -> dict[str, list[str]]:
        """For each street, those that end in a dead end and can be driven to from it (it may be one itself).

        In a network without dead ends, all that can be driven to.
        """
        return self._ways_out

    @cached_property
    def _ways_out(self) -> dict[str, list[str]]:
        onward: dict[str, set[str]] = {edge: set() for edge in self.edges}
        for connection in self.connections:
            if self.lanes[connection.source].use == "vehicle":
                onward[self.lanes[connection.source].edge_id].add(self.lanes[connection.target].edge_id)
        return {edge: self._exits_behind(edge, onward) for edge in self.edges}

    def _exits_behind(self, edge: str, onward: dict[str, set[str]]) -> list[str]:
        reached, waiting = {edge}, [edge]
        while waiting:
            new = onward[waiting.pop()] - reached
            reached |= new
            waiting += sorted(new)
        return sorted(name for name in reached if self.edges[name].end in self.dead_ends or not self.dead_ends)


def sumo_binary(name: str) -> str:
    """Path of a SUMO program.

    Args:
        name: ``"sumo"``, ``"duarouter"``, ``"netgenerate"`` or ``"netconvert"``.

    Raises:
        ImportError: SUMO is not installed; the message names the extra.
    """
    if any(importlib.util.find_spec(module) is None for module in ("sumo", "sumolib", "shapely")):
        raise ImportError("Scenes from SUMO need the extra `sumo`: pip install 'dpa-omf[sumo]'")
    from sumolib import checkBinary

    return checkBinary(name)


def run_sumo(name: str, options: dict[str, object]) -> None:
    """Run a SUMO program with long options; ``True`` and ``False`` become ``true`` and ``false``.

    Raises:
        RuntimeError: the program failed; the message holds the end of what it said.
    """
    command = [sumo_binary(name)]
    for option, value in options.items():
        command += [f"--{option}", str(value).lower() if isinstance(value, bool) else str(value)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{name} failed with status {done.returncode}: {done.stderr.strip()[-800:]}")


def read_network(path: Path) -> Network:
    """Read a SUMO network file (``.net.xml``, also ``.gz``); lanes for neither wheels nor feet (rails) are left out.

    Raises:
        SceneError: no such file, or no network in it.
    """
    root = read_xml(path, "a SUMO network (.net.xml)")
    if root.tag != "net":
        raise SceneError(f"{path}: holds <{root.tag}>, not a SUMO network; give the .net.xml that netconvert writes.")
    try:
        return _read_records(path, root)
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{path}: is no complete SUMO network ({error!r}); build it again with netconvert.") from error


def _read_records(path: Path, root: ElementTree.Element) -> Network:
    lanes: dict[str, NetLane] = {}
    edges: dict[str, NetEdge] = {}
    for element in root.iterfind("edge"):
        role = element.get("function", "street")
        read = (_read_lane(lane, element.get("id"), role) for lane in element.iterfind("lane"))
        own = tuple(lane for lane in read if lane is not None)
        lanes |= {lane.lane_id: lane for lane in own}
        if role == "street" and own:
            edges[element.get("id")] = NetEdge(element.get("id"), element.get("from"), element.get("to"), own)
    return Network(
        path=path,
        lanes=lanes,
        edges=edges,
        connections=tuple(_read_connections(root, lanes)),
        dead_ends=frozenset(node.get("id") for node in root.iterfind("junction") if node.get("type") == "dead_end"),
    )


def _read_shape(text: str) -> np.ndarray:
    """``"x,y x,y"`` -> ``[n, 2]``; a height is left out."""
    return np.array([[float(v) for v in point.split(",")[:2]] for point in text.split()])


def _read_use(element: ElementTree.Element) -> LaneUse | None:
    """Who may be on a lane; nothing for rails, ships and the like."""
    allow, disallow = element.get("allow"), element.get("disallow", "").split()

    def admits(vehicle_class: str) -> bool:
        if allow is not None:
            return vehicle_class in allow.split() or allow == "all"
        return vehicle_class not in disallow and disallow != ["all"]

    if any(map(admits, MOTOR_CLASSES)):
        return "vehicle"
    return "bike" if admits("bicycle") else "foot" if admits("pedestrian") else None


def _read_lane(element: ElementTree.Element, edge_id: str, role: LaneRole) -> NetLane | None:
    use = _read_use(element)
    if use is None:
        return None
    return NetLane(
        lane_id=element.get("id"),
        edge_id=edge_id,
        index=int(element.get("index")),
        use=use,
        role=role,
        width=float(element.get("width", 3.2)),  # SUMO leaves its default width out of the file
        speed=float(element.get("speed")),
        shape=_read_shape(element.get("shape")),
    )


def _is_drivable(source: NetLane | None, target: NetLane | None, via: NetLane | None) -> bool:
    """A connection between two lanes on which one can drive, through a lane inside the junction."""
    if source is None or target is None or via is None:
        return False
    return source.role == target.role == "street" and "foot" not in (source.use, target.use)


def _read_connections(root: ElementTree.Element, lanes: dict[str, NetLane]) -> list[NetConnection]:
    elements = list(root.iterfind("connection"))
    onward = {f"{e.get('from')}_{e.get('fromLane')}": e.get("via") for e in elements if e.get("from").startswith(":")}
    connections = []
    for e in elements:
        source, target = f"{e.get('from')}_{e.get('fromLane')}", f"{e.get('to')}_{e.get('toLane')}"
        if not _is_drivable(lanes.get(source), lanes.get(target), lanes.get(e.get("via"))):
            continue
        via = [e.get("via")]
        while onward.get(via[-1]) is not None:
            via.append(onward[via[-1]])
        connections.append(
            NetConnection(
                source=source,
                target=target,
                via=tuple(via),
                light=e.get("tl", ""),
                light_index=int(e.get("linkIndex", -1)),
                stop_sign=e.get("state") in ("s", "w"),
            )
        )
    return connections
