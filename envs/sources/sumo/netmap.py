"""Map of a SUMO network: lanes, lines, crosswalks, stop signs, lights, and the edge of the drivable area.

The drivable area is the union of all lanes for vehicles and bicycles, those inside junctions too, its kerbs rounded and
small holes filled. Road edges are its outline, drivable side on the left: outer rings run counter-clockwise, inner ones
clockwise. Pavements lie outside, so a pedestrian on one is off-road in the log, as in WOMD.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from envs.scene import LinkKind, MapKind
from envs.sources.sumo.network import NetConnection, NetLane, Network

FREEWAY_SPEED = 22.0
"""A lane with at least this limit is a freeway lane [m/s] (about 80 km/h)."""
KERB_RADIUS = 6.0
"""The drivable area's inward corners are rounded with this radius [m], as kerbs are."""
GUTTER = 0.3
"""Paved strip between a lane's border and the kerb [m]."""
SIMPLIFY = 0.05
"""How far a simplified line may lie from the exact one [m]."""
MEDIAN_LENGTH = 30.0
"""What rounding fills between lanes is a median or the gore of a ramp, no kerb, if it is longer than this [m]."""
PAINTED_GAP = 2.6
"""A gap between lanes narrower than this is paint on one road (a turning strip, the tip of a gore), no median [m]."""
ISLAND_AREA = 150.0
"""A hole of the drivable area below this size is the middle of a junction that no lane crosses, or a splitter island,
not a block, a median or the middle of a roundabout [m^2]."""

SAME_LINE = 0.5
"""Two border lines closer than this are one painted line [m]."""


@dataclass(frozen=True)
class Feature:
    """One polyline of the map.

    Attributes:
        kind: type of the polyline.
        points: ``[n, 2]`` [m]; a road edge is a closed ring whose last point repeats the first.
        feature_id: unique in the network.
        speed_limit: of a lane [m/s]; 0 otherwise.
    """

    kind: MapKind
    points: np.ndarray
    feature_id: int
    speed_limit: float = 0.0


@dataclass(frozen=True)
class Signal:
    """A lane inside a junction that a traffic light rules; vehicles stop where it begins (as in WOMD).

    Attributes:
        lane_id: its ``feature_id``.
        light: id of SUMO's traffic light.
        index: place of the lane's letter in the state of the light.
        stop_point: ``[2]`` [m].
    """

    lane_id: int
    light: str
    index: int
    stop_point: np.ndarray


@dataclass(frozen=True)
class NetMap:
    """Everything static of a network, in SUMO's coordinates.

    Attributes:
        features: polylines, road edges last.
        links: ``[E, 3]`` int64, rows ``(feature_id, feature_id, LinkKind)``.
        signals: lanes with a light.
        drivable: shapely (multi)polygon that road edges enclose.
    """

    features: tuple[Feature, ...]
    links: np.ndarray
    signals: tuple[Signal, ...]
    drivable: object


def build_map(network: Network, point_spacing: float) -> NetMap:
    """Map of a network.

    Args:
        network: records of the network.
        point_spacing: largest gap between two points of a line [m].
    """
    drivable = drivable_area(network)
    lines = _line_drafts(network, drivable)
    drafts = [*_lane_drafts(network), *lines, *_crosswalk_drafts(network), *_stop_sign_drafts(network)]
    number = {name: i + 1 for i, (name, *_) in enumerate(drafts)}
    drafts += [("", MapKind.EDGE_BOUNDARY, ring, 0.0) for ring in _rings(drivable)]
    features = tuple(
        Feature(kind, _resample(points, kind, point_spacing), i + 1, speed)
        for i, (_, kind, points, speed) in enumerate(drafts)
    )
    return NetMap(
        features=features,
        links=np.array(_links(network, number), dtype=np.int64).reshape(-1, 3),
        signals=tuple(
            Signal(number[c.via[0]], c.light, c.light_index, network.lanes[c.via[0]].shape[0])
            for c in network.connections
            if c.light
        ),
        drivable=drivable,
    )


def drivable_area(network: Network) -> object:
    """Shapely (multi)polygon where vehicles and cyclists may be."""
    import shapely

    lanes = [lane for lane in network.lanes.values() if lane.use != "foot"]
    # square ends reach past a dead end, where bumpers arrive, and into the junction elsewhere
    strips = [shapely.LineString(lane.shape).buffer(lane.width / 2 + GUTTER, cap_style="square") for lane in lanes]
    # Closing (grow, then shrink) rounds the kerbs and heals gaps between lanes; opening by a little cuts off spikes.
    paved = shapely.union_all(strips)
    area = _keep_medians(paved.buffer(KERB_RADIUS).buffer(-KERB_RADIUS - 0.2).buffer(0.2), paved)
    parts = [part for part in getattr(area, "geoms", [area]) if part.area > ISLAND_AREA]
    solid = [
        shapely.Polygon(part.exterior, [hole for hole in part.interiors if shapely.Polygon(hole).area > ISLAND_AREA])
        for part in parts
    ]
    return shapely.union_all(solid).simplify(SIMPLIFY)


def _keep_medians(rounded: object, paved: object) -> object:
    """Take back what rounding filled between two carriageways, or between a motorway and its ramp.

    Args:
        rounded: the drivable area with rounded kerbs.
        paved: the union of the lanes.
    """
    import shapely

    painted = paved.buffer(PAINTED_GAP / 2).buffer(-PAINTED_GAP / 2)
    filled = rounded.difference(painted).buffer(-0.2)  # without the slivers along every border
    medians = [p for p in shapely.get_parts(filled) if p.length / 2 > MEDIAN_LENGTH]
    if not medians:
        return rounded
    taken = shapely.buffer(shapely.union_all(medians), 0.3).difference(painted)
    return rounded.difference(taken).buffer(-0.2).buffer(0.2)


def _rings(drivable: object) -> list[np.ndarray]:
    """Closed rings with the drivable side on the left."""
    from shapely.geometry.polygon import orient

    parts = [orient(part, sign=1.0) for part in getattr(drivable, "geoms", [drivable])]
    return [np.asarray(ring.coords)[:, :2] for part in parts for ring in (part.exterior, *part.interiors)]


def _resample(points: np.ndarray, kind: MapKind, spacing: float) -> np.ndarray:
    """Few points on straights, at most ``spacing`` apart; polygons and single points stay as they are."""
    import shapely

    if kind in (MapKind.CROSSWALK, MapKind.STOP_SIGN):
        return points
    line = shapely.LineString(points).simplify(SIMPLIFY)
    return np.asarray(shapely.segmentize(line, spacing).coords)


def connector_shape(connection: NetConnection, lanes: dict[str, NetLane]) -> np.ndarray:
    """``[n, 2]`` centre line of a connector whose parts are joined, without repeated points."""
    points = np.concatenate([lanes[part].shape for part in connection.via])
    moved = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-3
    return points[np.concatenate(([True], moved))]


def _lane_kind(lane: NetLane) -> MapKind:
    if lane.use == "bike":
        return MapKind.LANE_BIKE
    return MapKind.LANE_FREEWAY if lane.speed >= FREEWAY_SPEED else MapKind.LANE_SURFACE_STREET


Draft = tuple[str, MapKind, np.ndarray, float]
"""Name, kind, points and speed limit of a feature that has no number yet."""


def _lane_drafts(network: Network) -> list[Draft]:
    streets = [lane for lane in network.lanes.values() if lane.role == "street" and lane.use != "foot"]
    drafts = [(lane.lane_id, _lane_kind(lane), lane.shape, lane.speed) for lane in streets]
    for connection in network.connections:
        source = network.lanes[connection.source]  # the limit inside a junction is that of the street before it
        shape = connector_shape(connection, network.lanes)
        drafts.append((connection.via[0], _lane_kind(source), shape, source.speed))
    return drafts


def _line_drafts(network: Network, drivable: object) -> list[Draft]:
    """Lines between the lanes of a street, and to the left of each of its two directions (once where they coincide)."""
    drafts = []
    driven = {edge.edge_id: [lane for lane in edge.lanes if lane.use != "foot"] for edge in network.edges.values()}
    driven = {edge_id: lanes for edge_id, lanes in driven.items() if lanes}
    middle = _middle_lines({edge_id: _left_side(lanes[-1]) for edge_id, lanes in driven.items()}, drivable)
    for edge_id, lanes in driven.items():
        for right, left in pairwise(lanes):
            kind = MapKind.LINE_BROKEN_WHITE if right.use == left.use else MapKind.LINE_SOLID_WHITE
            drafts.append((f"{right.lane_id}|", kind, _left_side(right), 0.0))
        if edge_id in middle:
            wide = len(network.edges[edge_id].lanes_for("vehicle")) > 1
            kind = MapKind.LINE_SOLID_DOUBLE_YELLOW if wide else MapKind.LINE_BROKEN_YELLOW
            drafts.append((f"{edge_id}||", kind, middle[edge_id], 0.0))
    return drafts


def _middle_lines(borders: dict[str, np.ndarray], drivable: object) -> dict[str, np.ndarray]:
    """The left borders of streets that are painted: not those at a road edge, and only one where two coincide."""
    import shapely

    lines = [shapely.LineString(border) for border in borders.values()]
    centres = shapely.line_interpolate_point(lines, 0.5, normalized=True)
    shapely.prepare(drivable)
    inside = shapely.contains(drivable, shapely.buffer(centres, SAME_LINE))  # a one-way street has its road edge there
    tree, painted = shapely.STRtree(lines), set()
    for i in np.flatnonzero(inside).tolist():
        if painted.isdisjoint(tree.query(centres[i], predicate="dwithin", distance=SAME_LINE).tolist()):
            painted.add(i)
    return {edge_id: border for i, (edge_id, border) in enumerate(borders.items()) if i in painted}


def _left_side(lane: NetLane) -> np.ndarray:
    """``[n, 2]``: the lane's left border, in its direction."""
    import shapely

    return np.asarray(shapely.LineString(lane.shape).offset_curve(lane.width / 2).coords)


def _crosswalk_drafts(network: Network) -> list[Draft]:
    import shapely

    crossings = [lane for lane in network.lanes.values() if lane.role == "crossing"]
    outlines = [
        shapely.LineString(c.shape).buffer(c.width / 2, cap_style="flat", join_style="mitre") for c in crossings
    ]
    return [
        (crossing.lane_id, MapKind.CROSSWALK, np.asarray(outline.exterior.coords)[:-1], 0.0)
        for crossing, outline in zip(crossings, outlines, strict=True)
    ]


def _stop_sign_drafts(network: Network) -> list[Draft]:
    lanes = {c.source: network.lanes[c.source] for c in network.connections if c.stop_sign}
    return [
        (f"{name}!", MapKind.STOP_SIGN, lane.shape[-1:], 0.0) for name, lane in lanes.items() if lane.use == "vehicle"
    ]


def _links(network: Network, number: dict[str, int]) -> list[tuple[int, int, int]]:
    links = []
    for c in network.connections:
        connector = number[c.via[0]]
        links.append((number[c.source], connector, LinkKind.EXIT))
        links.append((connector, number[c.target], LinkKind.EXIT))
    for edge in network.edges.values():
        for use in ("vehicle", "bike"):
            lanes = [number[lane.lane_id] for lane in edge.lanes_for(use)]
            for right, left in pairwise(lanes):
                links += [(right, left, LinkKind.LEFT), (left, right, LinkKind.RIGHT)]
    return links
