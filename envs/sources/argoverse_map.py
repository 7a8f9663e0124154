"""Map of an Argoverse 2 scenario: ``log_map_archive_<id>.json`` -> polylines and links.

What the file has and what becomes of it (formats: ``av2.map`` of the Argoverse 2 API):

==========================  ========================================================================================
lane segments               lane centrelines; successors and predecessors are exits, neighbours of the same direction
                            and kind are lanes to change to (theirs may be oncoming)
marks of lane boundaries    lines; a boundary that two lanes share is drawn once, one without paint not at all
pedestrian crossings        crosswalk polygons
drivable areas              road edges: the outline of their union, drivable side on the left
==========================  ========================================================================================

There are no speed limits, lights, stop signs, medians or driveways. **The map is cut out** of the city around the log
(in the files seen, along lines of a 30 m grid), and the outline of the drivable area follows the cut: there a road edge
lies across the street that the world does not have, and whoever drives on is off the road.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from envs.scene import LinkKind, MapKind, SceneError
from envs.sources.fields import Field, shown
from envs.sources.recording import Polyline

POINT_SPACING = 2.0
"""Largest gap between two points of a line [m]: that of the centrelines in the files."""
LONGEST_MAP = 1_000_000.0
"""Length of all lines together beyond which a map is refused [m]; a scenario has about 10 km."""
MOST_CORNERS = 50_000
"""Of all drivable areas together; a scenario has some thousands, and their union takes seconds for this many."""
HAIRLINE = 0.05
"""Half the width of gaps between drivable areas that abut; they are closed [m]."""
_DIRECTION_SAMPLES = 9

LANE_KIND = {
    "VEHICLE": MapKind.LANE_SURFACE_STREET,
    "BUS": MapKind.LANE_SURFACE_STREET,
    "BIKE": MapKind.LANE_BIKE,
}
LINE_KIND = {
    "DASHED_WHITE": MapKind.LINE_BROKEN_WHITE,
    "DOUBLE_DASH_WHITE": MapKind.LINE_BROKEN_WHITE,  # WOMD has no double one
    "SOLID_WHITE": MapKind.LINE_SOLID_WHITE,
    "DOUBLE_SOLID_WHITE": MapKind.LINE_DOUBLE_WHITE,
    "DASHED_YELLOW": MapKind.LINE_BROKEN_YELLOW,
    "DOUBLE_DASH_YELLOW": MapKind.LINE_BROKEN_DOUBLE_YELLOW,
    "SOLID_YELLOW": MapKind.LINE_SOLID_YELLOW,
    "DOUBLE_SOLID_YELLOW": MapKind.LINE_SOLID_DOUBLE_YELLOW,
    # One side may cross: WOMD's "passing double yellow"; in white it has no such kind.
    "SOLID_DASH_YELLOW": MapKind.LINE_PASSING_YELLOW,
    "DASH_SOLID_YELLOW": MapKind.LINE_PASSING_YELLOW,
    "SOLID_DASH_WHITE": MapKind.LINE_UNKNOWN,
    "DASH_SOLID_WHITE": MapKind.LINE_UNKNOWN,
    "SOLID_BLUE": MapKind.LINE_UNKNOWN,
}
"""Mark types of ``av2.map.lane_segment.LaneMarkType`` that are painted lines."""
UNPAINTED = ("NONE", "UNKNOWN")
"""Mark types that give no line."""

_Draft = tuple[MapKind, np.ndarray]
"""Kind and points ``[n, 3]`` of a feature that has no number yet."""


@dataclass(frozen=True)
class _Lane:
    """One lane segment; lines are ``[n, 3]`` in the lane's direction [m]."""

    lane_id: int
    kind: MapKind
    centreline: np.ndarray
    borders: tuple[np.ndarray, np.ndarray]
    marks: tuple[str, str]
    before: list[int]
    after: list[int]
    beside: tuple[int | None, int | None]


def read_map(top: Field, notes: Counter[str]) -> tuple[list[Polyline], list[tuple[int, int, int]]]:
    """Polylines in city coordinates and links between lanes.

    Lanes keep their ids; lines, crosswalks and road edges are numbered after the largest of them. Points of lanes,
    lines and edges are at most :data:`POINT_SPACING` apart, so that the nearest point tells the height of the ground;
    polygons keep their corners.

    Args:
        top: the decoded JSON.
        notes: what was not understood is counted here.

    Returns:
        Polylines, lanes first; and rows ``(feature_id, feature_id, LinkKind)``.

    Raises:
        SceneError: naming the field: missing or of the wrong type, a lane id that comes twice, an area that encloses
            nothing or crosses itself, more than :data:`LONGEST_MAP` of lines.
    """
    lanes = [_read_lane(segment, notes) for segment in top["lane_segments"].entries()]
    by_id: dict[int, _Lane] = {}
    for lane in lanes:
        if by_id.setdefault(lane.lane_id, lane) is not lane:
            raise SceneError(f"{top.name}: two lane_segments have the id {lane.lane_id}; give each its own.")
    drafts = [*_lines(lanes, notes), *_crosswalks(top["pedestrian_crossings"]), *_road_edges(top["drivable_areas"])]
    first = max(by_id, default=0) + 1
    features = [(lane.lane_id, lane.kind, lane.centreline) for lane in lanes]
    features += [(first + index, kind, points) for index, (kind, points) in enumerate(drafts)]
    _check_length([points for *_, points in features], top.name)
    polylines = [
        Polyline(number, kind, points if kind == MapKind.CROSSWALK else _spaced(points))
        for number, kind, points in features
    ]
    return polylines, [link for lane in lanes for link in _links(lane, by_id)]


def _read_lane(segment: Field, notes: Counter[str]) -> _Lane:
    borders = tuple(segment[f"{side}_lane_boundary"].table("x", "y", "z", at_least=2) for side in ("left", "right"))
    kind = segment["lane_type"].text()
    if kind not in LANE_KIND:
        notes[f"lane type {shown(kind)} unknown, taken as LANE_UNDEFINED"] += 1
    neighbours = (segment[f"{side}_neighbor_id"] for side in ("left", "right"))
    return _Lane(
        lane_id=segment["id"].integer(),
        kind=LANE_KIND.get(kind, MapKind.LANE_UNDEFINED),
        centreline=_centreline(segment, *borders),
        borders=borders,
        marks=tuple(segment[f"{side}_lane_mark_type"].text() for side in ("left", "right")),
        before=[lane.integer() for lane in segment["predecessors"].items()],
        after=[lane.integer() for lane in segment["successors"].items()],
        beside=tuple(None if lane.value is None else lane.integer() for lane in neighbours),
    )


def _centreline(segment: Field, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``[n, 3]``: the file's own centreline, else the middle of the borders.

    Heights always come from the borders: those of the centrelines in the files are all 0.
    """
    places = np.unique(np.concatenate((_fractions(left), _fractions(right))))
    middle = (_at(left, places) + _at(right, places)) / 2
    given = segment.get("centerline")
    if given is None:
        return middle
    centreline = given.table("x", "y", at_least=2)
    height = np.interp(_fractions(centreline), places, middle[:, 2])
    return np.column_stack((centreline, height))


def _lines(lanes: Sequence[_Lane], notes: Counter[str]) -> list[_Draft]:
    """Painted borders of lanes, each once: two lanes side by side name the same points, oncoming ones in reverse."""
    lines: dict[bytes, _Draft] = {}
    for lane in lanes:
        for points, mark in zip(lane.borders, lane.marks, strict=True):
            if mark in UNPAINTED:
                continue
            if mark not in LINE_KIND:
                notes[f"lane mark type {shown(mark)} unknown, taken as LINE_UNKNOWN"] += 1
            kind = LINE_KIND.get(mark, MapKind.LINE_UNKNOWN)
            plane = points[:, :2]
            known = lines.setdefault(min(plane.tobytes(), plane[::-1].tobytes()), (kind, points))
            if known[0] != kind:
                notes["lane boundary with two mark types, the first taken"] += 1
    return list(lines.values())


def _links(lane: _Lane, by_id: dict[int, _Lane]) -> Iterator[tuple[int, int, int]]:
    # Lanes beyond the cut are named too; a line of ours may have the number of one.
    yield from ((lane.lane_id, after, LinkKind.EXIT) for after in lane.after if after in by_id)
    yield from ((before, lane.lane_id, LinkKind.EXIT) for before in lane.before if before in by_id)
    for other, side in zip(lane.beside, (LinkKind.LEFT, LinkKind.RIGHT), strict=True):
        neighbour = by_id.get(other)
        if neighbour and neighbour.kind == lane.kind and _same_way(lane.centreline, neighbour.centreline):
            yield lane.lane_id, other, side


def _same_way(first: np.ndarray, second: np.ndarray) -> bool:
    """Do two lines that lie side by side run in the same direction?

    Pairs of points are nearer in that order than in reverse, however the lines bend.
    """
    places = np.linspace(0, 1, _DIRECTION_SAMPLES)
    first, second = _at(first, places)[:, :2], _at(second, places)[:, :2]
    return bool(np.linalg.norm(first - second, axis=1).sum() <= np.linalg.norm(first - second[::-1], axis=1).sum())


def _crosswalks(crossings: Field) -> list[_Draft]:
    """Outlines: along one edge and back along the other."""
    outlines = []
    for crossing in crossings.entries():
        there, back = (crossing[edge].table("x", "y", "z", at_least=2) for edge in ("edge1", "edge2"))
        if _same_way(there, back):  # as it should be; the other way round the outline would cross itself
            back = back[::-1]
        outlines.append((MapKind.CROSSWALK, np.concatenate((there, back))))
    return outlines


def _road_edges(areas: Field) -> list[_Draft]:
    """Closed rings around the union of the drivable areas, heights from the nearest corner of an area."""
    corners = [area["area_boundary"].table("x", "y", "z", at_least=3) for area in areas.entries()]
    if not corners:
        return []  # Scene.validate says that there is no road edge
    if sum(map(len, corners)) > MOST_CORNERS:
        raise SceneError(f"{areas.name}: {areas.path} has {sum(map(len, corners))} corners; at most {MOST_CORNERS}.")
    polygons = [_polygon(points[:, :2], area) for points, area in zip(corners, areas.entries(), strict=True)]
    points = np.concatenate(corners)
    tree = cKDTree(points[:, :2])
    return [
        (MapKind.EDGE_BOUNDARY, np.column_stack((ring, points[tree.query(ring)[1], 2])))
        for ring in _outline(polygons, areas)
    ]


def _polygon(corners: np.ndarray, area: Field) -> Any:
    """Shapely polygon of ``[n, 2]`` corners.

    A ring that touches itself in a corner still says what is inside, and cuts along tiles make such rings; it is split.
    """
    shapely = _import_shapely()
    polygon = shapely.Polygon(corners)
    reason = shapely.is_valid_reason(polygon)
    if reason.startswith("Ring Self-intersection"):
        polygon = shapely.make_valid(polygon).buffer(0)  # without the lines and points that may come with the parts
    elif reason != "Valid Geometry":
        raise SceneError(f"{area.name}: {area.path}.area_boundary is no polygon ({reason}); mend or remove it.")
    if not polygon.area > 0:
        raise SceneError(f"{area.name}: {area.path}.area_boundary encloses nothing; mend or remove it.")
    return polygon


def _outline(polygons: Sequence[Any], areas: Field) -> list[np.ndarray]:
    """Closed rings ``[n, 2]`` around the union: outer ones counter-clockwise, holes clockwise."""
    shapely = _import_shapely()
    from shapely.geometry.polygon import orient

    try:
        union = shapely.union_all(polygons)
        closed = union.buffer(HAIRLINE, join_style="mitre").buffer(-HAIRLINE, join_style="mitre")
    except shapely.errors.GEOSException as error:
        raise SceneError(f"{areas.name}: {areas.path} has no union ({error}); mend the areas.") from error
    parts = [orient(part, sign=1.0) for part in getattr(closed, "geoms", [closed]) if not part.is_empty]
    return [np.asarray(ring.coords)[:, :2] for part in parts for ring in (part.exterior, *part.interiors)]


def _fractions(points: np.ndarray) -> np.ndarray:
    """``[n]``: how much of a line's length in the plane lies before each of its points, from 0 to 1."""
    length = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))))
    return length / length[-1] if length[-1] > 0 else np.linspace(0, 1, len(points))


def _at(points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Points of a line ``[n, d]`` at ``[m]`` fractions of its length: ``[m, d]``."""
    own = _fractions(points)
    return np.column_stack([np.interp(places, own, column) for column in points.T])


def _spaced(points: np.ndarray) -> np.ndarray:
    """The line ``[n, 3]`` with points put in where two are more than the spacing apart."""
    gaps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
    pieces = np.maximum(np.ceil(gaps / POINT_SPACING), 1).astype(np.int64)
    first = np.cumsum(pieces) - pieces
    within = (np.arange(pieces.sum()) - np.repeat(first, pieces)) / np.repeat(pieces, pieces)
    places = np.append(np.repeat(np.arange(len(gaps)), pieces) + within, len(gaps))
    return np.column_stack([np.interp(places, np.arange(len(points)), column) for column in points.T])


def _check_length(lines: Sequence[np.ndarray], name: str) -> None:
    # Before any point is put in: two points of a broken file can lie 10,000 km apart.
    total = sum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum() for line in lines)
    if total > LONGEST_MAP:
        raise SceneError(
            f"{name}: the lines of the map are {total / 1000:.0f} km long together; at most "
            f"{LONGEST_MAP / 1000:.0f} km are read."
        )


def _import_shapely() -> Any:
    """The optional package, or an ImportError that says how to get it."""
    try:
        import shapely
    except ImportError as error:
        raise ImportError("drivable areas need shapely: pip install 'dpa-omf[argoverse]'") from error
    return shapely
