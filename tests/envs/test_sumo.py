"""Scenes simulated with SUMO: what a map must be, how bodies may move, and that seeds decide everything."""

from __future__ import annotations

import gzip
import importlib.util
import multiprocessing
from collections import Counter
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.geometry.boxes import nearest_box_distance
from envs.geometry.edges import RoadEdges
from envs.scene import (
    CURRENT_STEP,
    EDGE_KINDS,
    LANE_KINDS,
    LOG_STEPS,
    STEP_SECONDS,
    AgentKind,
    LightState,
    LinkKind,
    MapKind,
    Scene,
    SceneError,
    polylines,
)
from envs.sources import sumo
from envs.sources.sumo.classes import CLASSES
from envs.sources.sumo.cut import cut_map
from envs.sources.sumo.demand import draw_types, exits_by_lane
from envs.sources.sumo.futures import futures
from envs.sources.sumo.makers import make_network
from envs.sources.sumo.netmap import GUTTER, NetMap, build_map
from envs.sources.sumo.network import NetConnection, NetEdge, NetLane, Network, read_network, run_sumo, sumo_binary
from envs.sources.sumo.options import settings as sumo_settings
from envs.sources.sumo.tracks import make_tracks, smooth, trail
from envs.sources.sumo.traffic import Recording
from envs.sources.sumo.ways import Driver, can_take, draw_ways, possible_ways

shapely = pytest.importorskip("shapely", reason="needs the extra `sumo`")
pytest.importorskip("sumolib", reason="needs the extra `sumo`")

LANE_WIDTH = 3.2
SMALL = {"windows": 2, "warmup": 15.0, "scenes_per_unit": 4}
KINDS = [name for name in sumo_settings()["presets"] if name != "mixed"]


# --- simulated scenes ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    """Scenes of every kind of network."""
    return [scene for kind in KINDS for scene in sumo.generate(4, seed=11, preset=kind, **SMALL)]


def boxes_of(scene: Scene) -> torch.Tensor:
    """``[L, A, 5]`` boxes of a scene."""
    agents = scene.agents
    size = agents.extent[:, None, :2].expand(-1, LOG_STEPS, -1)
    return torch.cat((agents.position[..., :2], agents.heading[..., None], size), -1).transpose(0, 1)


def motion(scenes: list[Scene], on_foot: bool = False) -> dict[str, torch.Tensor]:
    """What bodies do at all steps: of vehicles and cyclists, or of pedestrians.

    ``slide`` is the centre's velocity across the heading, ``jump`` the part of a step that no speed explains.
    """
    rows: dict[str, list[torch.Tensor]] = {}
    for scene in scenes:
        agents = scene.agents
        chosen = (agents.kind == AgentKind.PEDESTRIAN) == on_foot
        valid, velocity, heading = agents.valid[chosen], agents.velocity[chosen], agents.heading[chosen]
        both = valid[:, 1:] & valid[:, :-1]
        speed, turn = velocity.norm(dim=-1), heading.diff(dim=1)
        slide = velocity[..., 1] * heading.cos() - velocity[..., 0] * heading.sin()
        step = agents.position[chosen].diff(dim=1).norm(dim=-1)
        values = {
            "speed": speed[valid],
            "limit": speed.new_tensor([float(scene.road.speed_limit.max())]).expand(int(valid.sum())),
            "acceleration": (speed.diff(dim=1) / STEP_SECONDS)[both],
            "yaw_rate": (torch.atan2(turn.sin(), turn.cos()) / STEP_SECONDS)[both],
            "slide": slide[valid],
            "slide_rate": (slide.diff(dim=1) / STEP_SECONDS)[both],
            "jump": (step - torch.maximum(speed[:, 1:], speed[:, :-1]) * STEP_SECONDS)[both],
        }
        for name, value in values.items():
            rows.setdefault(name, []).append(value)
    return {name: torch.cat(values) for name, values in rows.items()}


def check_motion(scenes: list[Scene]) -> None:
    """Nobody teleports, and wheels roll forward."""
    wheels, feet = motion(scenes), motion(scenes, on_foot=True)
    for told in (wheels, feet):
        assert told["jump"].numel() == 0 or told["jump"].max() < 0.05
    assert (wheels["speed"] < 1.3 * wheels["limit"]).all()
    assert feet["speed"].numel() == 0 or feet["speed"].max() < 4
    assert wheels["acceleration"].abs().max() < 10 and wheels["acceleration"].abs().quantile(0.999) < 6
    assert wheels["yaw_rate"].abs().max() < 4 and wheels["yaw_rate"].abs().quantile(0.999) < 1.5
    # the centre of a box lies ahead of its rear axle, so in a turn it moves sideways a little
    assert wheels["slide"].abs().max() < 3.5
    assert wheels["slide_rate"].abs().max() < 10 and wheels["slide_rate"].abs().quantile(0.999) < 4


def test_a_scene_is_a_window_around_a_moving_car(scenes: list[Scene]) -> None:
    options = sumo.make_options()
    for scene in scenes:
        agents = scene.validate().agents
        assert agents.position.shape[1:] == (LOG_STEPS, 3)
        assert options.min_agents <= len(agents.kind) <= options.max_agents
        assert agents.present.all() and agents.sdc[0] and agents.kind[0] == AgentKind.VEHICLE
        assert agents.valid[0].all() and agents.position[0, CURRENT_STEP, :2].abs().max() == 0
        assert agents.position[:, CURRENT_STEP].norm(dim=-1).max() <= options.radius + 2
        assert (agents.position[0].diff(dim=0).norm(dim=-1)).sum() > 4
        assert torch.allclose(agents.position[..., 2][agents.valid].amin(), agents.extent[:, 2].amin() / 2)
        assert agents.heading.abs().max() <= torch.pi


def test_agents_to_predict_stay_to_the_end_and_are_of_several_kinds(scenes: list[Scene]) -> None:
    kinds = set()
    for scene in scenes:
        predict = scene.agents.predict
        assert predict.sum() <= sumo.make_options().max_predict and not predict[scene.agents.sdc].any()
        assert scene.agents.valid[predict].all()
        kinds |= set(scene.agents.kind[predict].tolist())
    assert kinds == {AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST}


def test_scene_ids_are_unique(scenes: list[Scene]) -> None:
    assert len({scene.scene_id for scene in scenes}) == len(scenes) == 24


def test_maps_are_small_and_whole(scenes: list[Scene]) -> None:
    for scene in scenes:
        road = scene.road
        assert 100 < len(road.points) < 4000 and int(road.count.sum()) == len(road.points)
        assert road.count[torch.isin(road.kind, torch.tensor(LANE_KINDS + EDGE_KINDS))].min() >= 2
        assert len(road.feature_id.unique()) == len(road.feature_id)
        assert torch.isin(road.links[:, :2], road.feature_id).all()
        assert (road.speed_limit[torch.isin(road.kind, torch.tensor(LANE_KINDS))] > 5).all()
    kinds = {int(kind) for scene in scenes for kind in scene.road.kind}
    assert kinds >= {MapKind.LANE_BIKE, MapKind.CROSSWALK, MapKind.STOP_SIGN, MapKind.LINE_BROKEN_WHITE}


def test_lanes_lie_on_the_drivable_side_of_the_road_edges(scenes: list[Scene]) -> None:
    for scene in scenes:
        edges = RoadEdges.from_polylines(polylines(scene, EDGE_KINDS))
        inside = scene.agents.position[0, CURRENT_STEP].norm() + 60.0  # away from where the map was cut off
        lanes = torch.cat([lane[1:-1] for lane in polylines(scene, LANE_KINDS) if len(lane) > 2])
        lanes = lanes[lanes.norm(dim=-1) < inside]
        assert (edges.signed_distance(lanes) < 0).float().mean() > 0.995


def test_vehicles_stay_on_the_road(scenes: list[Scene]) -> None:
    centre, corner = [], []
    for scene in scenes:
        edges = RoadEdges.from_polylines(polylines(scene, EDGE_KINDS))
        agents = scene.agents
        cars = agents.valid & (agents.kind == AgentKind.VEHICLE)[:, None]
        extent = agents.extent[:, None].expand(-1, LOG_STEPS, -1)[cars]
        ground = agents.position[cars] - extent * torch.tensor([0, 0, 0.5])
        centre.append(edges.signed_distance(ground) > 0)
        corner.append(edges.box_offroad_distance(agents.position[cars], agents.heading[cars], extent) > 0)
    assert torch.cat(centre).float().mean() < 0.001
    assert torch.cat(corner).float().mean() < 0.01


def test_no_vehicle_or_cyclist_collides(scenes: list[Scene]) -> None:
    for scene in scenes:
        wheels = (scene.agents.kind != AgentKind.PEDESTRIAN).nonzero()[:, 0]
        gap = nearest_box_distance(boxes_of(scene), scene.agents.valid.T, ego=wheels, rounding=0.0)
        assert gap.min() >= 0


@pytest.mark.parametrize("kind", KINDS)
def test_bodies_move_without_jumps_and_hardly_sideways(kind: str, scenes: list[Scene]) -> None:
    check_motion([scene for scene in scenes if scene.scene_id.startswith(f"sumo_{kind}_")])


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_bodies_move_so_in_many_networks(kind: str) -> None:
    check_motion(list(sumo.generate(60, seed=12, preset=kind)))


def test_traffic_flows(scenes: list[Scene]) -> None:
    for kind in KINDS:
        speed = motion([scene for scene in scenes if scene.scene_id.startswith(f"sumo_{kind}_")])["speed"]
        assert (speed < 0.1).float().mean() < (0.1 if kind == "motorway" else 0.7)
        assert speed.max() > (20 if kind == "motorway" else 7)


def test_vehicles_face_where_they_go(scenes: list[Scene]) -> None:
    for scene in scenes:
        agents = scene.agents
        moving = agents.valid & (agents.velocity.norm(dim=-1) > 2) & (agents.kind == AgentKind.VEHICLE)[:, None]
        direction = torch.atan2(agents.velocity[..., 1], agents.velocity[..., 0])
        assert (direction - agents.heading)[moving].cos().min() > 0.8


def test_nobody_drives_over_a_line_while_its_light_is_red(scenes: list[Scene]) -> None:
    approaches = 0
    for scene in scenes:
        red = (scene.lights.state == LightState.STOP).all(1)
        lane_of = {int(name): i for i, name in enumerate(scene.road.feature_id)}
        for light in red.nonzero()[:, 0]:
            row = lane_of[int(scene.lights.lane_id[light])]
            lane = scene.road.points[scene.road.start[row] :][: scene.road.count[row], :2]
            stop = scene.lights.stop_point[light, 0, :2]
            assert torch.equal(stop, lane[0])
            along = (lane[1] - lane[0]) / (lane[1] - lane[0]).norm()
            agents = scene.agents
            cars = (agents.kind == AgentKind.VEHICLE) & agents.valid.all(1)
            facing = torch.stack((agents.heading.cos(), agents.heading.sin()), -1)[cars]
            offset = agents.position[cars, :, :2] - stop
            front = (offset * along).sum(-1) + agents.extent[cars, None, 0] / 2
            aside = (offset[..., 0] * along[1] - offset[..., 1] * along[0]).abs()
            near = (aside < 1.0) & ((facing * along).sum(-1) > 0.95)
            over = near[:, 1:] & near[:, :-1] & (front[:, :-1] < 0) & (front[:, 1:] > 0)
            approaches += int((near & (front > -3) & (front < 0)).any(1).sum())
            assert not over.any(), f"{scene.scene_id}: light {int(scene.lights.lane_id[light])}"
    assert approaches > 0


def test_lanes_that_are_linked_meet_or_lie_side_by_side(scenes: list[Scene]) -> None:
    seen = set()
    for scene in scenes:
        road = scene.road
        lines = {
            int(n): road.points[s : s + c, :2] for n, s, c in zip(road.feature_id, road.start, road.count, strict=True)
        }
        for first, second, kind in road.links.tolist():
            one, other = lines[first], lines[second]
            seen.add(kind)
            if kind == LinkKind.EXIT and one[-1].norm() < 60 and other[0].norm() < 60:
                assert (one[-1] - other[0]).norm() < 0.1
            elif kind != LinkKind.EXIT and max(one[0].norm(), other[0].norm()) < 60:
                along, across = one[1] - one[0], other[0] - one[0]
                left = along[0] * across[1] - along[1] * across[0] > 0
                assert bool(left) == (kind == LinkKind.LEFT)
    assert seen == set(LinkKind)


# --- seeds, splits and workers ---------------------------------------------------------------------------------------


def same(one: Scene, other: Scene) -> bool:
    parts = [
        part
        for part in ("agents", "road", "lights", "origin")
        if not (getattr(one, part) == getattr(other, part)).all()
    ]
    return one.scene_id == other.scene_id and not parts


@pytest.mark.slow
def test_a_unit_gives_the_same_scenes_in_any_process() -> None:
    unit = sumo.units(2, seed=4, preset="town", windows=1, warmup=5.0)[0]
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        elsewhere = pool.map(sumo.simulate, [unit])[0]
    here = sumo.simulate(unit)
    assert len(here) == 2 and all(same(a, b) for a, b in zip(here, elsewhere, strict=True))
    other = sumo.simulate(sumo.units(2, seed=5, preset="town", windows=1, warmup=5.0)[0])
    assert not torch.equal(other[0].road.points, here[0].road.points)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(sumo.SPLITS), st.integers(0, 9999)), min_size=2, max_size=4, unique=True))
def test_no_two_splits_or_seeds_share_a_network(runs: list[tuple[str, int]]) -> None:
    numbers = [unit.number for split, seed in runs for unit in sumo.units(100, seed, split=split, scenes_per_unit=10)]
    assert len(set(numbers)) == len(numbers) and max(numbers) < 2**31


@given(st.integers(1, 200), st.integers(1, 30))
def test_units_add_up_to_the_scenes_asked_for(num_scenes: int, per_unit: int) -> None:
    parts = [unit.num_scenes for unit in sumo.units(num_scenes, scenes_per_unit=per_unit)]
    assert sum(parts) == num_scenes and max(parts) <= per_unit


def test_the_source_gives_what_a_unit_gives() -> None:
    request = "num_scenes=2,seed=4,preset=town,windows=1,warmup=5.0"
    (text,) = sumo.SUMO.find([request])
    unit = sumo.units(2, seed=4, preset="town", windows=1, warmup=5.0)[0]
    assert text == unit.text
    assert all(same(a, b) for a, b in zip(sumo.SUMO.scenes(text), sumo.simulate(unit), strict=True))


# --- bad requests ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_words", "message"),
    [
        ({"preset": "village"}, "no preset 'village'.*arterial"),
        ({"split": "eval"}, "no split 'eval'.*test"),
        ({"rdius": 5.0}, "no option 'rdius'.*preset.*radius.*density"),
        ({"density": "dense"}, "density takes a number, got 'dense'"),
        ({"trucks": 2}, "trucks is a share of the vehicles, 0 to 1, got 2"),
        ({"imperfection": -1}, "imperfection must not be negative, got -1"),
        ({"radius": float("nan")}, "radius takes a number, got nan"),
        ({"max_agents": 3.5}, "max_agents takes an integer, got 3.5"),
        ({"seed": "x"}, "seed must lie in 0 ... 9999 .an integer., got 'x'"),
        ({"net": "a.net.xml", "preset": "grid"}, "net=a.net.xml brings a network of its own; leave preset=grid out"),
        ({"routes": "a.rou.xml"}, "routes=a.rou.xml needs the network"),
        ({"net": "a,b.net.xml"}, "'a,b.net.xml' holds a comma"),
        ({"net": "a", "routes": "b", "trucks": 0.1}, "trucks changes random traffic, and routes=b brings its own"),
        ({"radius": -5.0}, "radius must be positive, got -5.0"),
        ({"window_spacing": 3.0}, "window_spacing must be at least 9.1 s, got 3.0"),
        ({"seed": 10_000}, "seed must lie in 0 ... 9999, got 10000"),
        ({"num_scenes": 0}, "num_scenes must lie in 1 ... 120000, got 0"),
    ],
)
def test_a_bad_request_says_what_is_possible(request_words: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sumo.units(**({"num_scenes": 3} | request_words))


def test_a_request_in_words_must_be_complete() -> None:
    with pytest.raises(ValueError, match="num_scenes=160"):
        sumo.SUMO.find(["seed=3"])
    with pytest.raises(ValueError, match="'seed' is not of the form name=value"):
        sumo.SUMO.find(["num_scenes=3,seed"])


def test_too_many_scenes_for_one_simulation_is_an_error() -> None:
    unit = sumo.units(2, preset="town", windows=1, warmup=1.0, min_agents=500)[0]
    with pytest.raises(SceneError, match="holds only 0 of 2 scenes; lower"):
        sumo.simulate(unit)


def test_a_simulation_that_fails_runs_once_for_all_of_its_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    ran = []

    def fail(unit: sumo.SumoUnit) -> list[Scene]:
        ran.append(unit)
        raise SceneError("too few cars")

    monkeypatch.setattr(sumo, "simulate", fail)
    for record in sumo.SUMO.records(sumo.units(3)[0].text):
        with pytest.raises(SceneError, match="too few cars"):
            record.scene(Counter())
    assert len(ran) == 1


def test_other_settings_of_simulations_make_another_input(monkeypatch: pytest.MonkeyPatch) -> None:
    text = sumo.units(3)[0].text
    before = sumo.SUMO.size(text)
    other = sumo_settings() | {"presets": {}}
    monkeypatch.setattr(sumo.options, "settings", lambda: other)
    assert sumo.SUMO.size(text) != before


def test_without_sumo_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"pip install 'dpa-omf\[sumo\]'"):
        next(sumo.generate(1))


def test_a_failure_of_sumo_is_told() -> None:
    with pytest.raises(RuntimeError, match="(?s)netgenerate failed.*No option with the name 'no-such-option'"):
        run_sumo("netgenerate", {"no-such-option": 1})
    assert Path(sumo_binary("sumo")).exists()


# --- traffic that a request changes -----------------------------------------------------------------------------------


def agents_of(**request: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Kinds and lengths of all agents of a small unit."""
    words = {"preset": "town", "windows": 2, "warmup": 10.0, "scenes_per_unit": 4, "min_agents": 1} | request
    scenes = list(sumo.generate(4, seed=6, **words))
    kinds, lengths = (
        torch.cat([get(s.agents) for s in scenes]) for get in (lambda a: a.kind, lambda a: a.extent[:, 0])
    )
    return kinds, lengths


def test_density_changes_how_many_vehicles_there_are() -> None:
    sparse, dense = (int((agents_of(density=d, max_agents=100)[0] == AgentKind.VEHICLE).sum()) for d in (0.3, 1.5))
    assert dense > 2 * sparse > 0


def test_shares_of_trucks_cyclists_and_pedestrians_are_what_was_asked_for() -> None:
    kinds, lengths = agents_of(trucks=0, cyclists=0, pedestrians=0)
    assert (kinds == AgentKind.VEHICLE).all() and lengths.max() < 6
    kinds, lengths = agents_of(trucks=0.5, pedestrians=40)
    vehicle = kinds == AgentKind.VEHICLE
    assert (lengths[vehicle] > 6).float().mean() > 0.25 and (~vehicle).sum() > 10


@pytest.mark.parametrize(("factor", "lowest", "highest"), [(0.0, 0.0, 0.0), (1.0, 0.1, 0.5), (3.0, 0.3, 1.0)])
def test_imperfection_multiplies_the_errors_of_drivers(factor: float, lowest: float, highest: float) -> None:
    types = draw_types({"car": {"impatience": 0.2}}, factor, np.random.default_rng(0))
    sigma = [attributes["sigma"] for attributes in types.values() if "sigma" in attributes]
    assert lowest <= min(sigma) and max(sigma) <= highest and (factor < 2 or max(sigma) == 1)
    assert types["car0"]["impatience"] == pytest.approx(0.2 * factor)


# --- motorways and roundabouts ----------------------------------------------------------------------------------------


def drawn_network(kind: str, seed: int, folder: Path) -> Network:
    preset = sumo_settings()["presets"][kind]
    return make_network(folder, preset["network"], preset["signalled"], seed)


def near_street(network: Network, *edges: str) -> np.ndarray:
    """Points of the left borders of streets."""
    lanes = [network.edges[edge].lanes[-1] for edge in edges]
    return np.concatenate([np.asarray(shapely.LineString(s.shape).offset_curve(s.width / 2).coords) for s in lanes])


@pytest.mark.parametrize("seed", range(4))
def test_a_motorway_has_a_median_and_ramps(seed: int, tmp_path: Path) -> None:
    network = drawn_network("motorway", seed, tmp_path)
    area = build_map(network, 5.0).drivable
    assert len(area.geoms) == 2, "the carriageways do not touch"
    names = sorted(network.edges)
    assert {"east_on", "east_off", "west_on", "west_off"} <= set(names)
    for name in names:
        lanes = network.edges[name].lanes
        assert all(lane.use == "vehicle" for lane in lanes)
        assert 16 <= lanes[0].speed <= 36 and (len(lanes) == 1) == name.endswith(("_on", "_off"))
    exits = network.ways_out()
    assert set(exits["east_on"]) == set(exits["east_0"]) - ({"east_off"} if "east_4" in names else set())
    median = near_street(network, *[n for n in names if n[5:].isdigit()])[10:-10]
    around = shapely.buffer(shapely.points(median), 1.0)
    assert not shapely.contains(area, around).any(), "the median is not drivable"


@pytest.mark.parametrize("seed", range(6))
def test_a_roundabout_has_an_island_and_lets_everybody_out_everywhere(seed: int, tmp_path: Path) -> None:
    network = drawn_network("roundabout", seed, tmp_path)
    area = build_map(network, 5.0).drivable
    assert area.geom_type == "Polygon"
    rings = [e for e in network.edges if e.endswith("_on")]
    circles = {name[0] for name in rings}
    assert len(area.interiors) == len(circles)
    for circle in circles:
        ring = np.concatenate([network.edges[e].lanes[-1].shape for e in rings if e[0] == circle])
        holes = [shapely.Polygon(hole) for hole in area.interiors]
        assert sum(hole.contains(shapely.Point((ring.min(0) + ring.max(0)) / 2)) for hole in holes) == 1
    arms = {edge for edge in network.edges if edge.endswith("_depart")}
    assert all(set(network.ways_out()[e]) == arms for e in rings)
    assert min(hole.area for hole in map(shapely.Polygon, area.interiors)) > 400


# --- networks of one's own --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small network with pavements, whose streets end."""
    path = tmp_path_factory.mktemp("own") / "my town.net.xml"
    options = {"grid": True, "grid.number": 2, "grid.length": 90, "grid.attach-length": 80, "output-file": path}
    run_sumo("netgenerate", options | {"sidewalks.guess": True, "crossings.guess": True, "no-turnarounds": True})
    return path


ROUTES = """<routes>
<vType id="long" vClass="bus" length="14.5"/>
<vTypeDistribution id="two"><vType id="small" vClass="motorcycle" probability="1"/></vTypeDistribution>
<vType id="walker" vClass="pedestrian" width="0.6"/>
<flow id="p" begin="0" end="30" period="2" from="left0A0" to="B1right1"/>
<flow id="q" begin="0" end="30" period="3" from="right1B1" to="A0left0"/>
<vehicle id="late" type="long" depart="0:00:06"><route edges="left1A1 A1B1 B1right1"/></vehicle>
<vehicle id="early" type="two" depart="4"><route edges="left0A0 A0B0 B0right0"/></vehicle>
<trip id="t" type="DEFAULT_BIKETYPE" depart="1" from="left0A0" to="B0right0"/>
<person id="w" type="walker" depart="0"><walk from="left0A0" to="A0B0"/></person>
</routes>"""
OWN = {"windows": 1, "warmup": 12.0, "scenes_per_unit": 2, "min_agents": 2, "radius": 200.0}


@pytest.fixture
def routes(tmp_path: Path) -> Path:
    path = tmp_path / "all.rou.xml"
    path.write_text(ROUTES)
    return path


def test_random_traffic_on_a_network_of_ones_own(town: Path) -> None:
    request = f"net={town},num_scenes=4,seed=2,windows=1,warmup=5,scenes_per_unit=2"
    texts = sumo.SUMO.find([request])
    assert len(texts) == 2
    first, second = ([*sumo.SUMO.scenes(text)] for text in texts)
    assert [s.scene_id.rsplit("_", 2)[0] for s in first + second] == ["sumo_my-town_20000"] * 2 + [
        "sumo_my-town_20001"
    ] * 2
    assert all(same(a, b) for a, b in zip(first, sumo.SUMO.scenes(texts[0]), strict=True))
    assert {int(k) for s in first + second for k in s.agents.kind} >= {AgentKind.VEHICLE, AgentKind.PEDESTRIAN}
    check_motion(first + second)


def test_routes_of_ones_own_say_who_drives(town: Path, routes: Path) -> None:
    scenes = list(sumo.generate(2, net=str(town), routes=str(routes), **OWN))
    agents = scenes[0].agents
    seen = {
        (int(k), round(float(e[0]), 3)) for s in scenes for k, e in zip(s.agents.kind, s.agents.extent, strict=True)
    }
    assert {(AgentKind.VEHICLE, 14.5), (AgentKind.VEHICLE, 5.0)} <= seen
    sizes = {round(CLASSES[name].extent[0], 3) for name in ("passenger", "motorcycle", "bicycle", "pedestrian")} | {
        14.5
    }
    assert {length for _, length in seen} <= sizes and (AgentKind.VEHICLE, 1.6) not in seen
    assert float(agents.extent[0, 0]) == 5.0, "the SDC is a car"


def test_density_scales_routes_of_ones_own(town: Path, routes: Path) -> None:
    words = {"net": str(town), "routes": str(routes), "max_agents": 100} | OWN
    once, twice = (len(next(sumo.generate(1, density=d, **words)).agents.kind) for d in (1.0, 2.0))
    assert twice > 1.3 * once


def test_packed_files_give_the_same_scenes(town: Path, routes: Path, tmp_path: Path) -> None:
    packed = []
    for path in (town, routes):
        packed.append(tmp_path / f"{path.name}.gz")
        packed[-1].write_bytes(gzip.compress(path.read_bytes()))
    plain, unpacked = (
        list(sumo.generate(1, net=str(net), routes=str(way), **OWN)) for net, way in ((town, routes), packed)
    )
    assert all(same(a, b) for a, b in zip(plain, unpacked, strict=True))


def test_a_network_without_dead_ends_is_filled_from_its_streets(tmp_path: Path) -> None:
    path = tmp_path / "ring.net.xml"
    run_sumo("netgenerate", {"grid": True, "grid.number": 3, "grid.length": 90, "output-file": path})
    assert not read_network(path).dead_ends
    assert len(list(sumo.generate(2, net=str(path), windows=1, warmup=5.0))) == 2


def test_lanes_for_rails_are_no_road(town: Path, tmp_path: Path) -> None:
    tree = ElementTree.parse(town)
    lane = tree.getroot().find("edge/lane[@id='A0A1_1']")
    lane.attrib.pop("disallow", None)
    lane.set("allow", "tram rail")
    tree.write(tmp_path / "rails.net.xml")
    network, rails = read_network(town), read_network(tmp_path / "rails.net.xml")
    assert set(network.lanes) - set(rails.lanes) == {"A0A1_1"} and not rails.edges["A0A1"].lanes_for("vehicle")
    build_map(rails, 5.0)


LAUGHS = '<!DOCTYPE net [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]><net>&b;</net>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read as a SUMO network.*No such file"),
        (b"<net><edge", "cannot be read as a SUMO network.*give a file that SUMO wrote"),
        (b"<routes/>", "holds <routes>, not a SUMO network"),
        (b"<net/>", "no street where cars may drive"),
        (b"<net><edge id='a' from='x' to='y'><lane id='a_0' index='0'/></edge></net>", "no complete SUMO network"),
        (LAUGHS.encode(), "has a <!DOCTYPE>"),
        (LAUGHS.encode("utf-16"), "has a <!DOCTYPE>"),
        (b"\x80\x04K\x01.", "cannot be read as a SUMO network"),
    ],
)
def test_a_bad_network_is_named_before_anything_is_simulated(
    content: bytes | None, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "bad.net.xml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SceneError, match=f"(?s)bad.net.xml.*{message}"):
        sumo.SUMO.find([f"net={path},num_scenes=2"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<routes>", LAUGHS[: LAUGHS.index("<net>")] + "<routes>", "has a <!DOCTYPE>"),
        ('length="14.5"', 'length="long"', "type 'long' has a size that is no number"),
        (ROUTES, "<routes/>", "nobody departs"),
        (ROUTES, "no xml", "cannot be read as a route file"),
    ],
)
def test_bad_routes_are_named_before_anything_is_simulated(
    old: str, new: str, message: str, town: Path, routes: Path
) -> None:
    routes.write_text(ROUTES.replace(old, new))
    with pytest.raises(SceneError, match=f"(?s)all.rou.xml.*{message}"):
        sumo.SUMO.find([f"net={town},routes={routes},num_scenes=2"])


def test_what_sumo_says_about_routes_is_told(town: Path, routes: Path) -> None:
    routes.write_text(ROUTES.replace("left1A1", "nowhere"))
    with pytest.raises(SceneError, match="(?s)all.rou.xml: SUMO cannot simulate it.*nowhere"):
        next(sumo.generate(1, net=str(town), routes=str(routes), **OWN))


def test_a_type_from_another_file_must_be_written_down(town: Path, routes: Path) -> None:
    (routes.parent / "types.xml").write_text('<routes><vType id="strange" vClass="taxi"/></routes>')
    routes.write_text(
        ROUTES.replace("<routes>", '<routes><include href="types.xml"/>').replace('"two" depart', '"strange" depart')
    )
    with pytest.raises(SceneError, match="all.rou.xml: somebody is of type 'strange'; write its <vType>"):
        next(sumo.generate(1, net=str(town), routes=str(routes), **OWN))


# --- a map worked out by hand ----------------------------------------------------------------------------------------


def straight_network() -> Network:
    """A street along x of 100 m, two lanes east and one west; then a connector and a street of one lane."""

    def lane(name: str, points: list[tuple[float, float]], role: str = "street") -> NetLane:
        edge, index = name.rsplit("_", 1)
        return NetLane(name, edge, int(index), "vehicle", role, LANE_WIDTH, 13.9, np.array(points))

    east = (lane("east_0", [(0, -4.8), (100, -4.8)]), lane("east_1", [(0, -1.6), (100, -1.6)]))
    west = (lane("west_0", [(100, 1.6), (0, 1.6)]),)
    onward = (lane("onward_0", [(110, -1.6), (200, -1.6)]),)
    connector = lane(":J_0_0", [(100, -1.6), (110, -1.6)], "internal")
    edges = [NetEdge("east", "A", "J", east), NetEdge("west", "J", "A", west), NetEdge("onward", "J", "B", onward)]
    return Network(
        path=Path("net.xml"),
        lanes={item.lane_id: item for item in (*east, *west, *onward, connector)},
        edges={edge.edge_id: edge for edge in edges},
        connections=(NetConnection("east_1", "onward_0", (":J_0_0",), "J", 0, False),),
        dead_ends=frozenset({"A", "B"}),
    )


@pytest.fixture(scope="module")
def straight_map() -> NetMap:
    return build_map(straight_network(), point_spacing=5.0)


def test_the_road_edge_runs_counter_clockwise_around_the_lanes(straight_map: NetMap) -> None:
    (ring,) = [feature.points for feature in straight_map.features if feature.kind in EDGE_KINDS]
    assert np.array_equal(ring[0], ring[-1]) and shapely.LinearRing(ring).is_ccw
    assert np.linalg.norm(np.diff(ring, axis=0), axis=1).max() <= 5.0
    street = ring[(ring[:, 0] > 10) & (ring[:, 0] < 90)]
    borders = [-2 * LANE_WIDTH - GUTTER, LANE_WIDTH + GUTTER]
    assert np.allclose(np.sort(np.unique(street[:, 1].round(2))), borders, atol=0.06)


def test_lines_and_links_of_a_street(straight_map: NetMap) -> None:
    lines = {feature.kind: feature.points for feature in straight_map.features}
    assert np.allclose(lines[MapKind.LINE_BROKEN_WHITE][:, 1], -3.2)
    assert np.allclose(lines[MapKind.LINE_SOLID_DOUBLE_YELLOW][:, 1], 0.0)
    lanes = [feature for feature in straight_map.features if feature.kind in LANE_KINDS]
    names = dict(zip(("right", "left", "west", "onward", "connector"), (f.feature_id for f in lanes), strict=True))
    assert {tuple(row) for row in straight_map.links.tolist()} == {
        (names["left"], names["connector"], LinkKind.EXIT),
        (names["connector"], names["onward"], LinkKind.EXIT),
        (names["right"], names["left"], LinkKind.LEFT),
        (names["left"], names["right"], LinkKind.RIGHT),
    }
    assert straight_map.signals[0].lane_id == names["connector"]
    assert straight_map.signals[0].stop_point.tolist() == [100, -1.6]


def test_ways_out_end_in_dead_ends() -> None:
    assert straight_network().ways_out() == {"east": ["onward"], "west": ["west"], "onward": ["onward"]}


def test_a_cut_map_keeps_stretches_of_the_ring_and_their_side(straight_map: NetMap) -> None:
    region = shapely.box(20, -20, 60, 20)
    road, begun = cut_map(straight_map, region, np.array([40.0, 0.0]))
    edge = torch.isin(road.kind, torch.tensor(EDGE_KINDS))
    assert edge.sum() == 2 and len(set(road.feature_id.tolist())) == len(road.kind)
    assert not begun  # no lane begins in the region
    south, north = (road.points[s : s + n] for s, n in zip(road.start[edge], road.count[edge], strict=True))
    if south[0, 1] > 0:
        south, north = north, south
    assert (south[:, 0].diff() > 0).all() and (north[:, 0].diff() < 0).all()  # the road on the left of both
    assert road.points[:, 0].abs().max() <= 25


def test_a_ring_inside_the_region_stays_closed(straight_map: NetMap) -> None:
    road, begun = cut_map(straight_map, shapely.box(-50, -50, 300, 50), np.zeros(2))
    (row,) = torch.isin(road.kind, torch.tensor(EDGE_KINDS)).nonzero()[:, 0]
    ring = road.points[road.start[row] : road.start[row] + road.count[row]]
    assert torch.equal(ring[0], ring[-1]) and len(begun) == 5


# --- other futures ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def resumed() -> tuple[sumo.SumoUnit, Scene]:
    """A simulation with vehicles, cyclists and pedestrians, and its scene."""
    (unit,) = sumo.units(1, seed=3, preset="grid", windows=1, density=1.5)
    (scene,) = sumo.simulate(unit)
    return unit, scene


def poses_ahead(scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    """Logged places ``[A, 80, 2]`` of the present agents, and whether they are known."""
    agents = scene.agents
    ahead = slice(CURRENT_STEP + 1, LOG_STEPS)
    return agents.position[agents.present, ahead, :2], agents.valid[agents.present, ahead]


def test_with_its_own_random_numbers_a_simulation_goes_on_as_its_log_does(resumed: tuple) -> None:
    unit, scene = resumed
    (again,) = futures(unit.text, scene, [0], keeps="all")
    log, valid = poses_ahead(scene)
    away = ((again[..., :2] - log).norm(dim=-1) * valid).amax(-1)
    assert len(away) >= 12 and away.quantile(0.7) < 0.3  # the others waited, which SUMO does not save
    kinds = scene.agents.kind[scene.agents.present]
    assert {int(kind) for kind in kinds[away < 0.3]} >= {int(AgentKind.VEHICLE), int(AgentKind.PEDESTRIAN)}


def test_a_seed_makes_a_future_and_another_one_another(resumed: tuple) -> None:
    unit, scene = resumed
    some = futures(unit.text, scene, [1, 2, 1])
    assert torch.equal(some[0], some[2]) and not torch.equal(some[0], some[1])
    assert futures(unit.text, scene, [2])[0].equal(some[1])


def test_a_future_begins_where_the_scene_is_and_moves_as_its_log_does(resumed: tuple) -> None:
    unit, scene = resumed
    agents, some = scene.agents, futures(unit.text, scene, [1, 2])
    now = agents.poses[agents.present, CURRENT_STEP]
    path = torch.cat((now.expand(2, -1, -1)[:, :, None], some), 2)
    speed = path[..., :2].diff(dim=2).norm(dim=-1) / STEP_SECONDS
    on_foot = agents.kind[agents.present] == AgentKind.PEDESTRIAN
    assert speed[:, on_foot, 1:].max() < 4.0  # SUMO's saved state lets them run at 10 m/s
    assert (speed[..., 0] - agents.velocity[agents.present, CURRENT_STEP].norm(dim=-1)).abs().max() < 4.0
    assert some[..., 2].abs().max() <= np.pi + 1e-6


def test_who_leaves_the_network_stays_where_it_was_last() -> None:
    (unit,) = sumo.units(1, seed=3, preset="roundabout", windows=1, warmup=15.0, radius=150.0, max_agents=60)
    (scene,) = sumo.simulate(unit)
    (some,) = futures(unit.text, scene, [1])
    _, valid = poses_ahead(scene)
    gone = ~valid[:, -40]  # four seconds before the end
    assert gone.any()
    still = (some[gone, -1, :2] - some[gone, -2, :2]).norm(dim=-1) == 0
    assert still.float().mean() > 0.8 and some.isfinite().all()


def test_ways_that_a_driver_may_be_on_begin_as_its_own_and_go_on_from_its_lane(tmp_path: Path) -> None:
    (unit,) = sumo.units(1, seed=3, preset="grid", windows=1, density=1.5)
    _, run = sumo.prepared(unit, tmp_path)
    saved = {"save-state.times": 31.0, "save-state.files": tmp_path / "state.xml"}
    sumo.recorded(unit, replace(run, options=saved), tmp_path)
    state = ElementTree.parse(tmp_path / "state.xml").getroot()
    routes = {route.get("id"): tuple(route.get("edges").split()) for route in state.iter("route")}
    own = {each.get("id"): routes[each.get("route")] for each in state.iter("vehicle")}
    here = {each.get("id"): int(each.get("state").split()[2]) for each in state.iter("vehicle")}
    possible = possible_ways(state, own, run.network, run.routes, False, tmp_path)
    assert len(possible) > 50 and sum(len(ways) > 1 for ways in possible.values()) > len(possible) / 2
    for name, ways in possible.items():
        assert own[name] in ways and sum(ways.values()) == pytest.approx(1)
        behind = own[name][: here[name] + 1]
        assert all(way[: len(behind)] == behind for way in ways)
    draw_ways(state, possible, np.random.default_rng(0))
    drawn = {route.get("id"): tuple(route.get("edges").split()) for route in state.iter("route")}
    driven = {each.get("id"): drawn[each.get("route")] for each in state.iter("vehicle")}
    assert all(driven[name] in ways for name, ways in possible.items())
    assert 0 < sum(driven[name] == own[name] for name in possible) < len(possible)


def test_a_driver_takes_only_turns_that_its_lane_allows(tmp_path: Path) -> None:
    def lane(name: str, index: int) -> NetLane:
        shape = np.array([[0.0, 0.0], [100.0, 0.0]])
        return NetLane(f"{name}_{index}", name, index, "vehicle", "street", 3.2, 10.0, shape)

    joins = (("in_0", "right_0"), ("in_1", "left_0"))
    leads = {(source, target.rsplit("_", 1)[0]) for source, target in joins}
    for index, allowed in ((0, "right"), (1, "left")):
        driver = Driver("1", ("in", allowed), 0, lane("in", index).lane_id)
        ways = [way for way in (("in", "left"), ("in", "right")) if can_take(driver, way, leads)]
        assert ways == [("in", allowed)]
    about_to_change = Driver("1", ("in", "left"), 0, "in_0")
    assert can_take(about_to_change, ("in", "left"), leads)
    assert not can_take(about_to_change, ("in", "right"), leads)


def test_other_ways_make_other_futures(resumed: tuple) -> None:
    unit, scene = resumed
    same, other = (futures(unit.text, scene, [1, 2], keeps=keeps) for keeps in ("ways", "drivers"))
    assert not torch.equal(same, other)
    assert torch.equal(other[1], futures(unit.text, scene, [2], keeps="drivers")[0])


@pytest.mark.parametrize("warmup", [15.0, 15.05])
def test_a_scene_of_a_later_window_goes_on_from_its_own_step(warmup: float) -> None:
    (unit,) = sumo.units(2, seed=3, preset="roundabout", windows=2, warmup=warmup, scenes_per_unit=2, density=1.5)
    scene = next(scene for scene in sumo.simulate(unit) if "_100_" in scene.scene_id)
    (again,) = futures(unit.text, scene, [0], keeps="all")
    log, valid = poses_ahead(scene)
    first = ((again[:, 0, :2] - log[:, 0]).norm(dim=-1))[valid[:, 0]]
    assert first.quantile(0.8) < 0.1, "a step of a car at 5 m/s is 0.5 m"


def test_on_a_motorway_a_way_out_is_as_likely_as_it_has_lanes() -> None:
    rules = {name: sumo.rules_of(sumo.units(1, preset=name)[0]) for name in ("motorway", "grid")}
    told = {name: exits_by_lane(each["traffic"]) for name, each in rules.items()}
    assert told == {"motorway": True, "grid": False}


def test_in_a_junction_the_next_street_is_settled() -> None:
    assert Driver("1", ("a", "b", "c"), 0, ":j_0_0").settled == ("a", "b")
    assert Driver("1", ("a", "b", "c"), 0, "a_0").settled == ("a",)


def test_what_cannot_go_on_with_traffic_of_ones_own_is_refused() -> None:
    scene, own = next(sumo.generate(1, seed=5, preset="town", windows=1, warmup=10.0)), "net=a.net.xml,routes=a.rou.xml"
    with pytest.raises(ValueError, match="only random traffic says which ways are possible"):
        futures(f"{own},number=0,num_scenes=1", scene, [0], keeps="drivers")
    with pytest.raises(ValueError, match="SUMO cannot go on with routes that density scales"):
        futures(f"{own},number=0,num_scenes=1,density=1.5", scene, [0])


def test_what_a_future_keeps_is_one_of_three(resumed: tuple) -> None:
    unit, scene = resumed
    with pytest.raises(ValueError, match=r"keeps must be one of all, ways, drivers, got 'driver'\."):
        futures(unit.text, scene, [0], keeps="driver")


def test_a_scene_of_another_simulation_has_no_future_in_this_one(resumed: tuple) -> None:
    unit, scene = resumed
    other = replace(unit, number=unit.number + 1)
    with pytest.raises(ValueError, match=rf"{scene.scene_id}: the simulation .*number={other.number}.* other traffic"):
        futures(other.text, scene, [0])


# --- from bumpers to boxes -------------------------------------------------------------------------------------------


def record(front: np.ndarray, angle: float, speed: float, length: float = 4.0) -> Recording:
    """One car."""
    steps = len(front)
    return Recording(
        names=["0"],
        kind=np.array([int(AgentKind.VEHICLE)]),
        is_car=np.array([True]),
        extent=np.array([[length, 1.8, 1.5]]),
        front=front[None],
        angle=np.full((1, steps), angle),
        speed=np.full((1, steps), speed),
        lights={},
    )


@pytest.mark.parametrize(
    ("angle", "heading"), [(0.0, np.pi / 2), (90.0, 0.0), (180.0, -np.pi / 2), (225.0, -3 * np.pi / 4)]
)
def test_front_bumper_and_compass_become_centre_and_heading(angle: float, heading: float) -> None:
    direction = np.array([np.cos(heading), np.sin(heading)])
    front = 10.0 * STEP_SECONDS * np.arange(40)[:, None] * direction
    tracks = make_tracks(record(front, angle, 10.0))
    assert np.allclose(tracks.centre[0], front - 2.0 * direction)
    assert np.allclose(np.cos(tracks.heading[0] - heading), 1.0)
    assert np.allclose(tracks.velocity[0], 10.0 * direction)


def test_what_a_processor_computes_otherwise_in_the_last_bits_makes_no_other_scene() -> None:
    rng = np.random.default_rng(0)
    recording = record(rng.uniform(3.0, 500.0, (40, 1)) * [1.0, 0.5], 53.0, 1e4)
    other = replace(recording, front=recording.front + rng.choice([-1e-13, 0.0, 1e-13], recording.front.shape))
    here, there = make_tracks(recording), make_tracks(other)
    assert not np.array_equal(recording.front, other.front)
    assert np.array_equal(here.centre, there.centre)
    assert np.array_equal(here.velocity, there.velocity)


def test_a_teleport_or_a_hole_parts_a_track() -> None:
    front = np.stack((np.arange(60.0), np.zeros(60)), -1)
    front[20:] += 5.0
    recording = record(front, 90.0, 10.0)
    recording.speed[0, 40:44] = np.nan
    recording.front[0, 40:44] = np.nan
    tracks = make_tracks(recording)
    assert [np.flatnonzero(valid)[[0, -1]].tolist() for valid in tracks.valid] == [[0, 19], [20, 39], [44, 59]]
    assert tracks.track_id.tolist() == [1, 2, 3]
    assert np.allclose(tracks.velocity[tracks.valid], [10.0, 0.0])


@settings(max_examples=20, deadline=None)
@given(st.floats(-20, 20), st.floats(-20, 20), st.integers(8, 40))
def test_smoothing_keeps_uniform_motion(vx: float, vy: float, steps: int) -> None:
    line = np.arange(steps)[:, None] * np.array([vx, vy]) * STEP_SECONDS
    assert np.allclose(smooth(line), line, atol=1e-9)


def test_a_standing_body_never_turns_and_a_pulled_one_keeps_its_distance() -> None:
    rng = np.random.default_rng(0)
    path = np.cumsum(rng.normal(size=(3, 80, 2)) * 0.05 + [0.5, 0.0], axis=1)
    path[:, 50:] = path[:, 49:50]
    distance = np.array([0.5, 1.4, 3.0])
    heading = trail(path, np.zeros((3, 80)), distance)
    assert np.ptp(heading[:, 50:], axis=1).max() == pytest.approx(0, abs=1e-12)
    pulled = path - distance[:, None, None] * np.stack((np.cos(heading), np.sin(heading)), -1)
    step = np.diff(pulled, axis=1)
    sideways = step[..., 0] * np.sin(heading[:, 1:]) - step[..., 1] * np.cos(heading[:, 1:])
    assert np.abs(sideways).max() < 0.03  # the pulled point moves along the body


if __name__ == "__main__":
    pytest.main([__file__])
