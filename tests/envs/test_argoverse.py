"""Argoverse 2 scenarios -> scenes: a street made by hand, what breaks it, and real files."""

from __future__ import annotations

import copy
import json
import math
import random
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from envs.geometry.edges import RoadEdges
from envs.scene import CURRENT_STEP, EDGE_KINDS, LANE_KINDS, AgentKind, LinkKind, MapKind, Scene, SceneError, polylines
from envs.sources import argoverse, argoverse_map
from envs.sources.argoverse import ARGOVERSE, SIZES
from envs.sources.argoverse_map import HAIRLINE, POINT_SPACING
from envs.sources.fields import Field
from tests.envs import made
from tests.envs.made import ground, lane, line, rectangle

pytest.importorskip("shapely", reason="needs the extra argoverse")

# --- a street that runs east from (1000, 200) and climbs by 2 % -----------------------------------------------------


def read_argoverse(path: str | Path, notes: Counter[str] | None = None) -> Scene:
    (scene,) = ARGOVERSE.scenes(str(path), notes)
    return scene


def scene_from_tables(columns: dict, map_data: Any, name: str, notes: Counter[str] | None = None) -> Scene:
    return argoverse.scene_from_tables(columns, Field(map_data, name), name, notes)


@pytest.fixture
def map_data() -> dict[str, Any]:
    return made.argoverse_map()


@pytest.fixture
def columns() -> dict[str, list]:
    return made.argoverse_columns()


def test_the_last_91_steps_are_taken(columns, map_data) -> None:
    scene = scene_from_tables(columns, map_data, "made")
    (car,) = scene.agents.sdc.nonzero()[:, 0].tolist()
    assert scene.agents.position[car, :, 0].add(scene.origin[0]).tolist() == [1005 + 0.5 * t for t in range(19, 110)]
    assert scene.agents.velocity[car, 0].tolist() == [5.0, 0.5]
    assert scene.agents.heading[car, 0].item() == 0.25
    assert scene.scene_id == "made"
    scene.validate()


def test_ragged_tracks_are_masked_and_those_that_are_gone_left_out(columns, map_data) -> None:
    agents = scene_from_tables(columns, map_data, "made").agents
    steps = [track.nonzero()[:, 0].tolist() for track in agents.valid]
    assert agents.track_id.tolist() == [7, 8, 9, 4]  # "9" is left out, so "AV" has its number
    assert steps == [[*range(91)], [*range(6, 21)], [*range(91)], [*range(11, 91)]]


def test_track_ids_that_are_no_numbers_get_the_next_free_ones(columns, map_data) -> None:
    columns["track_id"] = [{"8": "007", "4": "x" * 50}.get(track, track) for track in columns["track_id"]]
    agents = scene_from_tables(columns, map_data, "made").agents
    assert agents.track_id.tolist() == [7, 8, 9, 10]  # "7", "007", "AV", "xx..x"
    assert agents.sdc.tolist() == [False, False, True, False]


def test_scored_and_focal_tracks_are_predicted_if_they_are_there(columns, map_data) -> None:
    agents = scene_from_tables(columns, map_data, "made").agents
    assert agents.track_id[agents.predict].tolist() == [7, 8]


@pytest.mark.parametrize(
    ("name", "kind", "size"),
    [
        ("vehicle", AgentKind.VEHICLE, SIZES["vehicle"]),
        ("bus", AgentKind.VEHICLE, (12.0, 2.5, 3.2)),
        ("pedestrian", AgentKind.PEDESTRIAN, SIZES["pedestrian"]),
        ("cyclist", AgentKind.CYCLIST, SIZES["cyclist"]),
        ("motorcyclist", AgentKind.CYCLIST, SIZES["motorcyclist"]),
        ("riderless_bicycle", AgentKind.OTHER, SIZES["riderless_bicycle"]),
        ("static", AgentKind.OTHER, (1.0, 1.0, 1.0)),
        ("background", AgentKind.OTHER, (1.0, 1.0, 1.0)),
        ("construction", AgentKind.OTHER, (1.0, 1.0, 1.0)),
        ("unknown", AgentKind.OTHER, (1.0, 1.0, 1.0)),
    ],
)
def test_each_object_type_has_a_kind_and_a_size(columns, map_data, name: str, kind: AgentKind, size: tuple) -> None:
    columns["object_type"][:110] = [name] * 110  # track 7
    notes: Counter[str] = Counter()
    agents = scene_from_tables(columns, map_data, "made", notes).agents
    assert agents.kind[0] == kind
    assert agents.extent[0].tolist() == pytest.approx(size)
    assert not notes


def test_what_is_not_understood_is_counted(columns, map_data) -> None:
    columns["object_type"] = ["tram" if k == "vehicle" else k for k in columns["object_type"]]
    map_data["lane_segments"]["14"].update(lane_type="RAIL", left_lane_mark_type="ZEBRA")
    notes: Counter[str] = Counter()
    scene = scene_from_tables(columns, map_data, "made", notes)
    assert notes == {
        "object type 'tram' unknown, taken as OTHER": 2,
        "lane type 'RAIL' unknown, taken as LANE_UNDEFINED": 1,
        "lane mark type 'ZEBRA' unknown, taken as LINE_UNKNOWN": 1,
    }
    assert scene.agents.kind[0] == AgentKind.OTHER
    assert scene.road.kind[scene.road.feature_id == 14].item() == MapKind.LANE_UNDEFINED


def test_boxes_stand_on_the_map_and_do_not_hop(columns, map_data) -> None:
    scene = scene_from_tables(columns, map_data, "made")
    agents = scene.agents
    x, z = (agents.position[..., axis].double() + scene.origin[axis] for axis in (0, 2))
    over = z - agents.extent[:, None, 2] / 2 - (50 + 0.02 * (x - 1000))
    assert over[agents.valid].abs().max() < 0.02 * POINT_SPACING
    rise = (z[:, 1:] - z[:, :-1])[agents.valid[:, 1:] & agents.valid[:, :-1]]
    assert rise.abs().max() < 0.02  # 0.01 m on a step of 0.5 m, were the ground read exactly


def features(scene: Scene, *kinds: int) -> list[tuple[int, int, torch.Tensor]]:
    """Number, kind, world points of the features of some kinds."""
    road = scene.road
    table = torch.stack((road.feature_id, road.kind, road.start, road.count), -1).tolist()
    return [
        (number, kind, road.points[start : start + count].double() + scene.origin)
        for number, kind, start, count in table
        if kind in kinds
    ]


def test_lanes_keep_their_ids_and_lie_between_their_borders(columns, map_data) -> None:
    scene = scene_from_tables(columns, map_data, "made")
    found = features(scene, *LANE_KINDS)
    street, bike = MapKind.LANE_SURFACE_STREET, MapKind.LANE_BIKE
    assert [item[:2] for item in found] == [(10, street), (11, street), (12, street), (13, bike), (14, street)]
    for (_, _, points), y in zip(found, (201.75, 205.25, 208.75, 199.25, 201.75), strict=True):
        assert points[:, 1].tolist() == pytest.approx([y] * len(points))
        assert points[:, 2].tolist() == pytest.approx([ground(x) for x in points[:, 0].tolist()], abs=1e-4)
        assert 0 < points.diff(dim=0).norm(dim=-1).max() <= POINT_SPACING + 1e-3
    assert found[2][2][[0, -1], 0].tolist() == [1060, 1000]
    assert scene.road.feature_id.unique().numel() == len(scene.road.feature_id)
    assert scene.road.feature_id.tolist()[5:] == [*range(15, 15 + len(scene.road.feature_id) - 5)]
    assert not scene.road.speed_limit.any() and not len(scene.lights.lane_id)


def test_the_middle_of_borders_of_different_shape(columns, map_data) -> None:
    # A bend whose outer border has a point more than the inner one: the middle has them all.
    bent = map_data["lane_segments"]["14"]
    bent["left_lane_boundary"] = line((1060, 204), (1090, 204))
    bent["right_lane_boundary"] = line((1060, 200), (1070, 198), (1090, 200))
    (points,) = (p for n, _, p in features(scene_from_tables(columns, map_data, "made"), *LANE_KINDS) if n == 14)
    assert points[0, :2].tolist() == [1060, 202] and points[-1, :2].tolist() == [1090, 202]
    fraction = math.hypot(10, 2) / (math.hypot(10, 2) + math.hypot(20, 2))
    corner = torch.tensor([(1060 + 30 * fraction + 1070) / 2, 201.0], dtype=torch.float64)
    assert (points[:, :2] - corner).norm(dim=-1).min() < 1e-3


def test_a_centreline_of_the_file_is_taken_with_the_height_of_the_borders(columns, map_data) -> None:
    centre = [{"x": x, "y": 202.5, "z": 0.0} for x in (1060.0, 1075.0, 1090.0)]
    map_data["lane_segments"]["14"]["centerline"] = centre
    (points,) = (p for n, _, p in features(scene_from_tables(columns, map_data, "made"), *LANE_KINDS) if n == 14)
    assert points[:, 1].tolist() == [202.5] * len(points)
    assert points[:, 2].tolist() == pytest.approx([ground(x) for x in points[:, 0].tolist()], abs=1e-4)


def test_painted_borders_are_lines_and_shared_ones_are_drawn_once(columns, map_data) -> None:
    lines = features(scene_from_tables(columns, map_data, "made"), *range(MapKind.LINE_UNKNOWN, MapKind.EDGE_UNKNOWN))
    assert [(kind, points[0, 1].item()) for _, kind, points in lines] == [
        (MapKind.LINE_BROKEN_WHITE, 203.5),
        (MapKind.LINE_SOLID_WHITE, 200.0),
        (MapKind.LINE_SOLID_DOUBLE_YELLOW, 207.0),
    ]


@pytest.mark.parametrize(
    ("mark", "kind"),
    [
        ("DASHED_WHITE", MapKind.LINE_BROKEN_WHITE),
        ("DOUBLE_DASH_WHITE", MapKind.LINE_BROKEN_WHITE),
        ("SOLID_WHITE", MapKind.LINE_SOLID_WHITE),
        ("DOUBLE_SOLID_WHITE", MapKind.LINE_DOUBLE_WHITE),
        ("DASHED_YELLOW", MapKind.LINE_BROKEN_YELLOW),
        ("DOUBLE_DASH_YELLOW", MapKind.LINE_BROKEN_DOUBLE_YELLOW),
        ("SOLID_YELLOW", MapKind.LINE_SOLID_YELLOW),
        ("DOUBLE_SOLID_YELLOW", MapKind.LINE_SOLID_DOUBLE_YELLOW),
        ("SOLID_DASH_YELLOW", MapKind.LINE_PASSING_YELLOW),
        ("DASH_SOLID_YELLOW", MapKind.LINE_PASSING_YELLOW),
        ("SOLID_DASH_WHITE", MapKind.LINE_UNKNOWN),
        ("DASH_SOLID_WHITE", MapKind.LINE_UNKNOWN),
        ("SOLID_BLUE", MapKind.LINE_UNKNOWN),
        ("NONE", None),
        ("UNKNOWN", None),
    ],
)
def test_marks_have_the_kind_that_womd_gives_them(columns, map_data, mark: str, kind: MapKind | None) -> None:
    notes: Counter[str] = Counter()
    map_data["lane_segments"]["14"]["left_lane_mark_type"] = mark
    every = range(MapKind.LINE_UNKNOWN, MapKind.EDGE_UNKNOWN)
    lines = features(scene_from_tables(columns, map_data, "made", notes), *every)
    new = [kind for _, kind, points in lines if points[:, 0].max() > 1061]
    assert new == ([] if kind is None else [kind])
    assert not notes


def test_links_are_exits_and_neighbours_that_go_the_same_way(columns, map_data) -> None:
    links = scene_from_tables(columns, map_data, "made").road.links.tolist()
    # Not 11-12, which is oncoming; not 10-13, a lane for bicycles; not 10-15: the map has no such lane, but a line
    # got that number.
    assert links == [[10, 11, LinkKind.LEFT], [10, 14, LinkKind.EXIT], [11, 10, LinkKind.RIGHT]]


def test_neighbours_in_a_roundabout_go_the_same_way(columns, map_data) -> None:
    def circle(radius: float, turns: float = 1.0) -> list[dict[str, float]]:
        angles = np.linspace(0, 2 * math.pi * turns, 40)
        return line(*((1040 + radius * math.cos(a), 300 + radius * math.sin(a)) for a in angles))

    lanes = map_data["lane_segments"]
    lanes["20"] = lane(20, circle(10), circle(14), right_neighbor_id=21)
    lanes["21"] = lane(21, circle(14), circle(18), left_neighbor_id=20, right_neighbor_id=22)
    lanes["22"] = lane(22, circle(22, -1), circle(18, -1), right_neighbor_id=21)
    links = scene_from_tables(columns, map_data, "made").road.links.tolist()
    assert [link for link in links if link[0] >= 20] == [[20, 21, LinkKind.RIGHT], [21, 20, LinkKind.LEFT]]


@pytest.mark.parametrize("turned", [False, True])
def test_a_crosswalk_is_a_polygon_around_its_edges(columns, map_data, turned: bool) -> None:
    if turned:
        map_data["pedestrian_crossings"]["5"]["edge2"].reverse()
    ((_, _, points),) = features(scene_from_tables(columns, map_data, "made"), MapKind.CROSSWALK)
    assert points[:, :2].tolist() == [[1030, 198], [1030, 211], [1033, 211], [1033, 198]]


def doubled_area(ring: torch.Tensor) -> float:
    x, y = ring[:, 0], ring[:, 1]
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def test_road_edges_go_round_the_union_of_the_areas_with_the_road_on_the_left(columns, map_data) -> None:
    around = line((1070, 200), (1070, 205), (1080, 205), (1080, 200))
    bridge = [*line((1060.02, 197), (1100, 197), (1100, 212), (1060.02, 212), (1060.02, 202)), *around[:1]]
    # The second tile with an island: a ring that goes in and comes back on the same way touches itself.
    map_data["drivable_areas"]["2"]["area_boundary"] = [*bridge, *around[1:], *around[:1], *line((1060.02, 202))]
    scene = scene_from_tables(columns, map_data, "made")
    edges = features(scene, *EDGE_KINDS)
    assert [kind for _, kind, _ in edges] == [MapKind.EDGE_BOUNDARY] * 2
    outer, island = (points - scene.origin for _, _, points in edges)
    assert (outer[0] == outer[-1]).all() and (island[0] == island[-1]).all()
    assert doubled_area(outer) / 2 == pytest.approx(100 * 15, rel=1e-3)  # the hairline is closed
    assert doubled_area(island) / 2 == pytest.approx(-10 * 5, rel=1e-2)
    for _, _, points in edges:
        assert points[:, 2].tolist() == pytest.approx([ground(x) for x in points[:, 0].tolist()], abs=0.02)
    signed = RoadEdges.from_polylines(polylines(scene, EDGE_KINDS), every_ring=True).signed_distance
    places = torch.tensor([[1060, 204.0, 51], [1075, 202.5, 51], [1075, 196, 51], [1101, 204, 52]]) - scene.origin
    assert signed(places.float()).tolist() == pytest.approx([-7.0, 2.5, 1.0, 1.0], abs=0.01)


def test_a_gap_wider_than_a_hairline_stays(columns, map_data) -> None:
    map_data["drivable_areas"]["2"].update(rectangle(1059.98 + 2 * HAIRLINE + 0.02, 197, 1100, 212))
    assert len(features(scene_from_tables(columns, map_data, "made"), *EDGE_KINDS)) == 2


# --- what breaks it ---------------------------------------------------------------------------------------------------


def in_map(*path: Any, to: Any) -> Callable:
    """Sets one value of the map."""

    def change(columns: dict, map_data: dict) -> None:
        place = map_data
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = to

    return change


def in_row(field: str, row: int, to: Any) -> Callable:
    def change(columns: dict, map_data: dict) -> None:
        columns[field][row] = to

    return change


def in_column(field: str, to: Any) -> Callable:
    return lambda columns, map_data: columns.update({field: to})


def without(field: str) -> Callable:
    return lambda columns, map_data: columns.pop(field)


def remove(*path: Any) -> Callable:
    def change(columns: dict, map_data: dict) -> None:
        place = map_data
        for key in path[:-1]:
            place = place[key]
        del place[path[-1]]

    return change


LANE_10 = ("lane_segments", "10")
BOW_TIE = line((1000, 197), (1050, 212), (1050, 197), (1000, 212))
DEEP: list = []
for _ in range(10_000):
    DEEP = [DEEP]

FAULTS = [
    (without("heading"), "the column heading is missing"),
    (without("scenario_id"), "the column scenario_id is missing"),
    (in_column("timestep", [1, 2, 3]), "the columns have .* rows; each must have the same"),
    (in_column("heading", [[1.0, 2.0], [3.0]]), "column heading is .*; must have one value in each row"),
    (in_column("heading", "abc"), "column heading is 'abc'; must have one value in each row"),
    (in_column("track_id", None), "column track_id is None; must have one value in each row"),
    (in_row("position_x", 3, "abc"), "column position_x holds .*; must hold numbers"),
    (in_row("position_x", 3, math.nan), r"position_x\[3\] is nan; must be a finite number"),
    (in_row("velocity_y", 3, math.inf), r"velocity_y\[3\] is inf; must be a finite number"),
    (in_row("position_y", 3, 1e30), r"position_y\[3\] is 1e\+30; must be a finite number"),
    (in_row("position_y", 3, 10**400), "column position_y holds object; must hold numbers"),
    (in_row("track_id", 3, 7), r"track_id\[3\] is 7; must be text"),
    (in_row("object_type", 3, None), r"object_type\[3\] is None; must be text"),
    (in_row("object_type", 3, "bus"), r"object_type\[3\] is 'bus' where earlier rows have 'vehicle'"),
    (in_row("object_category", 3, 1), r"object_category\[3\] is 1 where earlier rows have 3"),
    (in_row("scenario_id", 3, "other"), r"scenario_id\[3\] is 'other' where earlier rows have 'made'"),
    (in_row("timestep", 3, 3.5), "column timestep holds float64; must hold whole numbers"),
    (in_row("timestep", 3, -1), r"timestep\[3\] is -1; must be from 0 to 109"),
    (in_row("timestep", 3, 110), r"timestep\[3\] is 110; must be from 0 to 109"),
    (in_row("timestep", 3, 2**70), "column timestep holds object"),
    (in_row("timestep", 3, 2), "row 3 repeats track_id '7' at timestep 2"),
    (lambda c, m: c.update({k: v[:50] for k, v in c.items()}), "last timestep is 49 .* The test split"),
    (lambda c, m: [values.clear() for values in c.values()], "0 rows|holds float64"),
    (lambda c, m: c.update(track_id=["5" if t == "AV" else t for t in c["track_id"]]), "track_id has no 'AV'"),
    (lambda c, m: [v.__delitem__(c["track_id"].index("AV") + 29) for v in (*c.values(),)], "SDC is not valid"),
    (in_map("lane_segments", to=[]), r"lane_segments is \[\]; must be an object"),
    (remove("drivable_areas"), "drivable_areas is missing"),
    (in_map(*LANE_10, to=7), r"lane_segments\[10\] is 7; must be an object"),
    (remove(*LANE_10, "left_lane_mark_type"), r"lane_segments\[10\].left_lane_mark_type is missing"),
    (in_map(*LANE_10, "lane_type", to=None), r"lane_segments\[10\].lane_type is None; must be text"),
    (in_map(*LANE_10, "id", to="10"), r"lane_segments\[10\].id is '10'; must be a whole number"),
    (in_map(*LANE_10, "id", to=2**63), r"lane_segments\[10\].id is 9223372036854775808; must be a whole number from"),
    (in_map(*LANE_10, "id", to=-1), r"lane_segments\[10\].id is -1; must be a whole number from"),
    (in_map(*LANE_10, "id", to=11), "two lane_segments have the id 11"),
    (
        in_map(*LANE_10, "successors", to=[14, 1.5]),
        r"lane_segments\[10\].successors\[1\] is 1.5; must be a whole number",
    ),
    (in_map(*LANE_10, "successors", to=[2**64]), r"lane_segments\[10\].successors\[0\] is 18446744073709551616; must"),
    (in_map(*LANE_10, "left_neighbor_id", to="11"), r"lane_segments\[10\].left_neighbor_id is '11'; must"),
    (
        in_map(*LANE_10, "left_lane_boundary", 1, "x", to="abc"),
        r"lane_segments\[10\].left_lane_boundary\[1\].x is 'abc'; must be a number",
    ),
    (
        in_map(*LANE_10, "left_lane_boundary", 1, "z", to=math.nan),
        r"lane_segments\[10\].left_lane_boundary\[1\].z is nan; must be a finite number",
    ),
    (
        in_map(*LANE_10, "left_lane_boundary", 1, "y", to=10**400),
        r"left_lane_boundary\[1\].y is 1000.*; must be a finite",
    ),
    (in_map(*LANE_10, "left_lane_boundary", to=[]), r"left_lane_boundary has 0 items; must have 2 or more"),
    (in_map(*LANE_10, "left_lane_boundary", to=[DEEP, DEEP]), r"left_lane_boundary\[0\] is .*; must be an object"),
    (in_map(*LANE_10, "left_lane_boundary", 1, "x", to=9e6), "the lines of the map are .* km long together"),
    (in_map(*LANE_10, "centerline", to=5), r"lane_segments\[10\].centerline is 5; must be a list"),
    (in_map("pedestrian_crossings", "5", "edge2", to=[]), r"pedestrian_crossings\[5\].edge2 has 0 items"),
    (in_map("drivable_areas", to={}), "the map has no road edge"),
    (in_map("drivable_areas", "1", "area_boundary", to=[]), r"drivable_areas\[1\].area_boundary has 0 items"),
    (
        in_map("drivable_areas", "1", "area_boundary", to=line((1000, 197), (1010, 197), (1020, 197))),
        r"drivable_areas\[1\].area_boundary (is no polygon|encloses nothing)",
    ),
    (
        in_map("drivable_areas", "1", "area_boundary", to=line(*[(1000, 197)] * 4)),
        r"drivable_areas\[1\].area_boundary (is no polygon|encloses nothing)",
    ),
    (
        in_map("drivable_areas", "1", "area_boundary", to=BOW_TIE),
        r"drivable_areas\[1\].area_boundary is no polygon \(Self-intersection",
    ),
]


@pytest.mark.parametrize(("change", "message"), FAULTS)
def test_a_fault_is_named(columns, map_data, change: Callable, message: str) -> None:
    change(columns, map_data)
    with pytest.raises(SceneError, match=rf"^here/x\.parquet, record 0.*{message}"):
        scene_from_tables(columns, map_data, "here/x.parquet, record 0").validate("here/x.parquet, record 0")


@pytest.mark.parametrize("top", [None, [], 3, "text"])
def test_a_map_that_is_no_object_is_named(columns, top: Any) -> None:
    with pytest.raises(SceneError, match="made: the top level is .*; must be an object"):
        scene_from_tables(columns, top, "made")


def test_any_value_of_a_map_may_be_anything(columns, map_data) -> None:
    """Each value is replaced in turn: a scene comes out or one SceneError."""

    def places(value: Any, path: tuple = ()) -> list[tuple]:
        below = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        return [path, *(place for key, item in below for place in places(item, (*path, key)))]

    bad = (None, True, -1, 2**64, 1e300, math.nan, "", "x", [], {}, [[]], {"x": 1})
    for path in places(map_data)[1:]:
        for value in random.Random(str(path)).sample(bad, 3):
            broken = copy.deepcopy(map_data)
            in_map(*path, to=value)(columns, broken)
            with suppress(SceneError):
                scene_from_tables(columns, broken, "made").validate()


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def save(columns, map_data, tmp_path: Path) -> Callable[..., Path]:
    """Writes the scenario as its publisher does; columns may be replaced."""
    pyarrow = pytest.importorskip("pyarrow", reason="needs the extra argoverse")
    from pyarrow import parquet

    def write(**replace: Any) -> Path:
        path = tmp_path / "scenario_made.parquet"
        parquet.write_table(pyarrow.table(columns | replace), path)
        (tmp_path / "log_map_archive_made.json").write_text(json.dumps(map_data))
        return path

    return write


def test_a_file_gives_the_scene_of_its_tables(save, columns, map_data) -> None:
    scene = read_argoverse(save())
    expected = scene_from_tables(columns, map_data, "made")
    for part in ("agents", "road", "lights"):
        assert (getattr(scene, part) == getattr(expected, part)).all()
    assert scene.scene_id == expected.scene_id and (scene.origin == expected.origin).all()


def test_it_is_a_source_with_one_scene_for_each_parquet_file(save) -> None:
    path = save()
    assert ARGOVERSE.find([str(path.parent)]) == [str(path)]
    assert [scene.scene_id for scene in ARGOVERSE.scenes(str(path))] == ["made"]


def test_a_map_that_is_not_there_is_named(save) -> None:
    path = save()
    (path.parent / "log_map_archive_made.json").unlink()
    with pytest.raises(SceneError, match=r"log_map_archive_made\.json: cannot be read .*No such file"):
        read_argoverse(path)


@pytest.mark.parametrize(
    "text", [b"", b"{", b"\xff\xfe\x00", b"[" * 100_000, b'{"x": ' * 100_000, b"9" * 10_000, b"nonsense"]
)
def test_a_map_that_is_not_json_is_named(save, text: bytes) -> None:
    path = save()
    (path.parent / "log_map_archive_made.json").write_bytes(text)
    with pytest.raises(SceneError, match=r"scenario_made\.parquet, record 0, map log_map_archive_made\.json: is no J"):
        read_argoverse(path)


def test_missing_values_and_wrong_types_of_a_column_are_named(save, columns) -> None:
    def holed(field: str) -> list:
        return [None if row == 5 else value for row, value in enumerate(columns[field])]

    for field, message in (
        ("track_id", r"track_id\[5\] is None; must be text"),
        ("timestep", "column timestep holds float64; must hold whole numbers"),
        ("position_x", r"position_x\[5\] is nan; must be a finite number"),
    ):
        with pytest.raises(SceneError, match=rf"scenario_made\.parquet, record 0: {message}"):
            read_argoverse(save(**{field: holed(field)}))
    for field in columns:
        for value in ("text", True, [1.0], {"x": 1}, b"\xff", None):
            if not (isinstance(value, str) and isinstance(columns[field][0], str)):
                with pytest.raises(SceneError, match=rf"scenario_made\.parquet, record 0: .*{field}"):
                    read_argoverse(save(**{field: [value] * len(columns[field])}))


def test_a_damaged_parquet_file_gives_a_scene_error_or_a_scene(save) -> None:
    path = save()
    data = path.read_bytes()
    for size in (0, 3, 100, len(data) // 2, len(data) - 5):
        path.write_bytes(data[:size])
        with pytest.raises(SceneError, match=r"scenario_made\.parquet, record 0: not a parquet file"):
            read_argoverse(path)
    generator = random.Random(0)
    for _ in range(200):
        broken = bytearray(data)
        broken[generator.randrange(len(data))] ^= 1 << generator.randrange(8)
        path.write_bytes(broken)
        with suppress(SceneError):
            read_argoverse(path)


@pytest.mark.parametrize(
    ("limit", "message"),
    [
        ("LARGEST_PARQUET", "has more than 10 bytes"),
        ("LARGEST_MAP", "log_map_archive_made.json: has more than 10 bytes"),
        ("LARGEST_DATA", r"record 0: it has \d+ bytes once unpacked; at most 10"),
        ("MOST_ROWS", r"record 0: it has \d+ rows; at most 10"),
    ],
)
def test_files_that_are_too_large_are_refused(save, monkeypatch, limit: str, message: str) -> None:
    monkeypatch.setattr(argoverse, limit, 10)
    with pytest.raises(SceneError, match=message):
        read_argoverse(save())


def test_too_many_rows_are_refused_before_they_are_unpacked(tmp_path: Path, monkeypatch) -> None:
    pyarrow = pytest.importorskip("pyarrow", reason="needs the extra argoverse")
    from pyarrow import parquet

    path = tmp_path / "scenario_made.parquet"
    parquet.write_table(pyarrow.table({"track_id": pyarrow.array(["AV"] * 1_000_001).dictionary_encode()}), path)
    monkeypatch.setattr(parquet.ParquetFile, "read", lambda *_, **__: pytest.fail("it was read"))
    with pytest.raises(SceneError, match="record 0: it has 1000001 rows; at most 1000000"):
        read_argoverse(path)


def padded(value: int, size: int) -> bytes:
    """A number as Thrift writes it, in more bytes than it needs."""
    return bytes(value >> 7 * place & 127 | (128 if place < size - 1 else 0) for place in range(size))


def test_pages_that_are_larger_than_the_file_says_are_refused_before_they_are_unpacked(
    save, columns, monkeypatch
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra argoverse")
    path = save()
    parquet.write_table(
        parquet.read_table(path).set_column(2, "object_type", [[*columns["object_type"][:-1], "x" * 1_000_000]]),
        path,
        compression="zstd",
        use_dictionary=False,
    )
    group = parquet.read_metadata(path).row_group(0)
    data = path.read_bytes()
    for size in (group.total_byte_size, group.column(2).total_uncompressed_size):
        honest = padded(2 * size, 3)
        assert honest in data
        data = data.replace(honest, padded(2 * 1000, 3))
    path.write_bytes(data)
    monkeypatch.setattr(argoverse, "LARGEST_DATA", 500_000)
    monkeypatch.setattr(parquet.ParquetFile, "read", lambda *_, **__: pytest.fail("it was read"))
    with pytest.raises(SceneError, match=r"record 0: its pages have 1\d{6} bytes once unpacked; at most 500000"):
        read_argoverse(path)


def test_encodings_that_copy_texts_are_refused(save) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra argoverse")
    path = save()
    delta = {"object_type": "DELTA_BYTE_ARRAY"}
    parquet.write_table(parquet.read_table(path), path, use_dictionary=False, column_encoding=delta)
    with pytest.raises(SceneError, match="record 0: column object_type has the encoding 7; only PLAIN, "):
        read_argoverse(path)


def test_what_the_decoder_says_of_a_damaged_file_is_told_in_one_line(save) -> None:
    path = save()
    data = bytearray(path.read_bytes())
    data[-60:-8] = b"\xff" * 52
    path.write_bytes(data)
    with pytest.raises(SceneError, match="not a parquet file that can be read") as caught:
        read_argoverse(path)
    assert str(caught.value).isprintable()


def test_areas_of_more_corners_than_a_map_has_are_refused(columns, map_data, monkeypatch) -> None:
    monkeypatch.setattr(argoverse_map, "MOST_CORNERS", 7)
    with pytest.raises(SceneError, match="made: drivable_areas has 8 corners; at most 7"):
        scene_from_tables(columns, map_data, "made")


@pytest.mark.parametrize("package", ["pyarrow", "shapely"])
def test_a_missing_package_says_how_to_get_it(save, monkeypatch, package: str) -> None:
    path = save()
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=r"pip install 'dpa-omf\[argoverse\]'"):
        read_argoverse(path)


# --- real scenes ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(shared: Path) -> list[tuple[Path, Scene]]:
    pytest.importorskip("pyarrow", reason="needs the extra argoverse")
    paths = sorted((shared / "scenes/argoverse2").glob("*/scenario_*.parquet"))
    if not paths:
        pytest.skip(f"no Argoverse 2 scenarios in {shared}")
    return [(path, read_argoverse(path)) for path in paths]


def test_real_scenes_equal_an_independent_decoding(real) -> None:
    from pyarrow import parquet

    for path, scene in real:
        agents = scene.agents
        number = {str(number): index for index, number in enumerate(agents.track_id.tolist())}
        number["AV"] = agents.sdc.nonzero().item()
        valid = np.zeros(agents.valid.shape, dtype=bool)
        for row in parquet.read_table(path).to_pylist():
            step = row["timestep"] - 19
            if step < 0:
                continue
            agent = number[row["track_id"]]
            valid[agent, step] = True
            here = agents.position[agent, step, :2].double() + scene.origin[:2]
            assert here.tolist() == pytest.approx([row["position_x"], row["position_y"]], abs=1e-4)
            assert agents.heading[agent, step].item() == pytest.approx(row["heading"], abs=1e-6)
            velocity = [row["velocity_x"], row["velocity_y"]]
            assert agents.velocity[agent, step].tolist() == pytest.approx(velocity, abs=1e-5)
            assert agents.predict[agent] == (row["object_category"] >= 2 and agents.present[agent])
        np.testing.assert_array_equal(agents.valid, valid)


def test_real_scenes_are_understood_in_full(real) -> None:
    for path, _ in real:
        notes: Counter[str] = Counter()
        read_argoverse(path, notes)
        assert not notes


def test_real_vehicles_drive_on_the_road_and_head_where_they_travel(real) -> None:
    for _, scene in real:
        agents = scene.agents
        signed = RoadEdges.from_polylines(polylines(scene, EDGE_KINDS)).signed_distance
        assert (signed(agents.position[agents.sdc]) < 0).all()
        vehicles = agents.valid & (agents.kind == AgentKind.VEHICLE)[:, None]
        assert (signed(agents.position[vehicles]) < 0).float().mean() > 0.8  # the others are beyond the map's cut
        fast = vehicles & (agents.velocity.norm(dim=-1) > 4)
        travel, heading = agents.velocity[fast], agents.heading[fast]
        ahead = travel[:, 0] * heading.cos() + travel[:, 1] * heading.sin()
        assert (ahead / travel.norm(dim=-1)).median() > 0.999


def test_real_lanes_lie_on_the_drivable_area_and_lead_into_each_other(real) -> None:
    for _, scene in real:
        signed = RoadEdges.from_polylines(polylines(scene, EDGE_KINDS)).signed_distance
        lanes = torch.cat(polylines(scene, [MapKind.LANE_SURFACE_STREET]))
        assert (signed(lanes) < 0.1).float().mean() > 0.95
        ends = {number: points[[0, -1]] for number, _, points in features(scene, *LANE_KINDS)}
        exits = scene.road.links[scene.road.links[:, 2] == LinkKind.EXIT][:, :2].tolist()
        gaps = torch.stack([(ends[before][1] - ends[after][0]).norm() for before, after in exits])
        assert len(exits) > 10 and gaps.median() < 0.1
        height = agents_height(scene)
        assert height.abs().max() < 10


def agents_height(scene: Scene) -> torch.Tensor:
    """Heights of the boxes' bottoms over that of the ego car at the current step."""
    agents = scene.agents
    bottom = agents.position[..., 2] - agents.extent[:, None, 2] / 2
    return (bottom - bottom[agents.sdc, CURRENT_STEP])[agents.valid]


if __name__ == "__main__":
    pytest.main([__file__])
