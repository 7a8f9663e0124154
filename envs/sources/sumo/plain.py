"""Road networks drawn by hand: nodes, edges and connections that ``netconvert`` turns into a network.

``netgenerate`` knows grids, spiders and trees only. Everything else is drawn here: a maker
(:mod:`~envs.sources.sumo.motorway`, :mod:`~envs.sources.sumo.roundabout`) fills :class:`PlainRoads`, and
:func:`convert_roads` writes it down.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from envs.sources.sumo.network import Network, read_network, run_sumo

NETCONVERT_RULES = {
    "no-turnarounds": True,
    "no-turnarounds.except-deadend": False,
    "junctions.internal-link-detail": 8,
    "precision": 3,
    "xml-validation": "never",
    # the ground under a scene is flat and where it was drawn
    "offset.disable-normalization": True,
    # neighbours that are drawn side by side stay there
    "geometry.avoid-overlap": False,
}
"""What every network that is drawn by hand has in common."""


@dataclass(frozen=True)
class PlainEdge:
    """One direction of a street.

    Attributes:
        edge_id: unique.
        start: node where it begins.
        end: node where it ends.
        shape: ``[n, 2]``, in its direction: its left border, or its centre line if ``centred`` [m].
        lanes: for vehicles and bicycles.
        speed: limit [m/s].
        lane_width: [m].
        priority: the street of the higher one goes first where they meet.
        pavement: width of the pavement on its right; 0 for none [m].
        centred: what ``shape`` is.
        motorway: neither cyclists nor pedestrians may be there.
    """

    edge_id: str
    start: str
    end: str
    shape: np.ndarray
    lanes: int
    speed: float
    lane_width: float
    priority: int = 1
    pavement: float = 0.0
    centred: bool = False
    motorway: bool = False


@dataclass
class PlainRoads:
    """What ``netconvert`` is told.

    Attributes:
        nodes: places [m] by name; their order is that of the file.
        edges: streets.
        connections: ``(edge, lane, edge, lane)``, lanes for vehicles counted from the right; for a pair of edges
            without one, ``netconvert`` chooses.
        crossings: ``(node, edges)`` that pedestrians cross at once, with priority.
        roundabouts: ``(nodes, edges)`` of each circle.
        node_radius: turning radius at a node [m].
    """

    nodes: dict[str, np.ndarray] = field(default_factory=dict)
    edges: list[PlainEdge] = field(default_factory=list)
    connections: list[tuple[str, int, str, int]] = field(default_factory=list)
    crossings: list[tuple[str, list[str]]] = field(default_factory=list)
    roundabouts: list[tuple[list[str], list[str]]] = field(default_factory=list)
    node_radius: float = 6.0


def convert_roads(roads: PlainRoads, folder: Path, seed: int) -> Network:
    """Write roads down, run ``netconvert`` and read the network.

    Args:
        roads: of a maker.
        folder: where the files and ``net.xml`` are written.
        seed: of ``netconvert``.

    Raises:
        ImportError: SUMO is not installed.
        RuntimeError: ``netconvert`` refused the roads.
    """
    roots = {"node": _nodes_xml(roads), "edge": _edges_xml(roads), "connection": _connections_xml(roads)}
    for name, root in roots.items():
        ElementTree.ElementTree(root).write(folder / f"{name}s.xml", encoding="utf-8")
    inputs = {f"{name}-files": folder / f"{name}s.xml" for name in roots}
    run_sumo("netconvert", NETCONVERT_RULES | inputs | {"seed": seed, "output-file": folder / "net.xml"})
    return read_network(folder / "net.xml")


def _numbers(points: np.ndarray) -> str:
    return " ".join(f"{x:.3f},{y:.3f}" for x, y in points)


def _nodes_xml(roads: PlainRoads) -> ElementTree.Element:
    root = ElementTree.Element("nodes")
    for name, (x, y) in roads.nodes.items():
        place = {"x": f"{x:.3f}", "y": f"{y:.3f}", "radius": f"{roads.node_radius}"}
        ElementTree.SubElement(root, "node", id=name, type="priority", **place)
    return root


def _edges_xml(roads: PlainRoads) -> ElementTree.Element:
    root = ElementTree.Element("edges")
    for edge in roads.edges:
        told = {
            "id": edge.edge_id,
            "from": edge.start,
            "to": edge.end,
            "shape": _numbers(edge.shape),
            "numLanes": str(edge.lanes),
            "speed": f"{edge.speed:.2f}",
            "width": f"{edge.lane_width:.2f}",
            "priority": str(edge.priority),
            "spreadType": "center" if edge.centred else "right",
        }
        if edge.pavement:
            told["sidewalkWidth"] = f"{edge.pavement:.2f}"
        told["disallow"] = "pedestrian bicycle moped tram rail" if edge.motorway else "pedestrian tram rail"
        ElementTree.SubElement(root, "edge", told)
    for nodes, edges in roads.roundabouts:
        ElementTree.SubElement(root, "roundabout", nodes=" ".join(nodes), edges=" ".join(edges))
    return root


def _connections_xml(roads: PlainRoads) -> ElementTree.Element:
    root = ElementTree.Element("connections")
    first = {edge.edge_id: int(edge.pavement > 0) for edge in roads.edges}  # a pavement is lane 0
    for source, source_lane, target, target_lane in roads.connections:
        lanes = {"fromLane": str(source_lane + first[source]), "toLane": str(target_lane + first[target])}
        ElementTree.SubElement(root, "connection", {"from": source, "to": target} | lanes)
    for node, edges in roads.crossings:
        ElementTree.SubElement(root, "crossing", node=node, edges=" ".join(edges), priority="true", width="3.0")
    return root
