"""Cutting scenes of 9.1 s out of a simulation: who is the SDC, who and which part of the map belongs to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from envs.geometry.boxes import nearest_box_distance
from envs.scene import (
    CURRENT_STEP,
    EDGE_KINDS,
    LANE_KINDS,
    LOG_STEPS,
    AgentKind,
    Agents,
    Lacks,
    Lights,
    LightState,
    MapKind,
    RoadMap,
    Scene,
)
from envs.sources.sumo.netmap import Feature, NetMap
from envs.sources.sumo.tracks import Tracks

SDC_TRAVEL = 5.0
"""An SDC moves at least this far in its scene [m]."""
MOVING = 1.0
"""A road user that moves this far in a scene is worth predicting [m]."""
SHARE_ON_FOOT_OR_BIKE = 0.5
"""At most this share of the agents to predict are pedestrians and cyclists, as long as there are vehicles."""

LIGHT_LETTERS = {
    "r": LightState.STOP,
    "u": LightState.CAUTION,  # red and yellow: about to turn green
    "y": LightState.CAUTION,
    "Y": LightState.CAUTION,
    "g": LightState.GO,  # green, but others go first
    "G": LightState.GO,
    "s": LightState.FLASHING_STOP,  # stop, then turn right on red
    "o": LightState.FLASHING_CAUTION,
    "O": LightState.UNKNOWN,
}
"""Letters of SUMO's signal states."""


@dataclass(frozen=True)
class Crop:
    """What belongs to a scene (fields of the same names in ``sumo.yaml``)."""

    radius: float
    map_margin: float
    max_agents: int
    min_agents: int
    max_predict: int


def sdc_candidates(tracks: Tracks, start: int, crop: Crop) -> Iterator[int]:
    """Cars that can be the SDC of the window that begins at step ``start``, far apart from each other.

    The first is the one in the densest traffic; each next one is the farthest from all before it.

    Args:
        tracks: of a simulation.
        start: first step of the window.
        crop: of the scenes.
    """
    window = slice(start, start + LOG_STEPS)
    now = start + CURRENT_STEP
    here = np.flatnonzero(tracks.valid[:, now])
    place = tracks.centre[here, now]
    apart = np.linalg.norm(place[:, None] - place[None], axis=-1)
    around = (apart <= crop.radius).sum(1)
    whole = tracks.valid[here, window].all(1)
    travel = _travel(tracks, here, window)
    good = np.flatnonzero(tracks.is_car[here] & whole & (travel >= SDC_TRAVEL) & (around >= crop.min_agents))
    if not len(good):
        return
    gap = np.full(len(good), np.inf)
    choice = int(np.argmax(around[good]))
    for _ in range(len(good)):
        yield int(here[good[choice]])
        gap = np.minimum(gap, apart[good[choice], good])
        gap[choice] = -1.0
        choice = int(np.argmax(gap))


def cut_scene(
    tracks: Tracks, road: NetMap, lights: dict[str, list[str]], sdc: int, start: int, crop: Crop, scene_id: str
) -> Scene | None:
    """The scene around one car, or nothing if a vehicle or cyclist collides with anybody in it.

    Args:
        tracks: of the simulation.
        road: map of its network.
        lights: letters of every light at every step.
        sdc: row of the SDC in ``tracks``.
        start: first step of the window.
        crop: what to keep.
        scene_id: name of the scene.
    """
    window = slice(start, start + LOG_STEPS)
    rows = _nearest_rows(tracks, sdc, start + CURRENT_STEP, crop)
    origin = tracks.centre[sdc, start + CURRENT_STEP]
    agents = _cut_agents(tracks, rows, window, origin, crop.max_predict)
    if _wheels_collide(agents):
        return None
    region = _kept_region(tracks, rows, window, origin, crop)
    road_map, kept = cut_map(road, region, origin)
    return Scene(
        agents=agents,
        road=road_map,
        lights=_cut_lights(road, lights, kept, window, origin),
        origin=torch.tensor([*origin, 0.0], dtype=torch.float64),
        lacks=torch.tensor(Lacks.HEIGHT),
        scene_id=scene_id,
        batch_size=[],
    ).validate()


def _travel(tracks: Tracks, rows: np.ndarray, window: slice) -> np.ndarray:
    """``[rows]``: how far each moves in the window [m]."""
    speed = np.linalg.norm(tracks.velocity[rows, window], axis=-1)
    return speed.sum(1) * 0.1


def _nearest_rows(tracks: Tracks, sdc: int, now: int, crop: Crop) -> np.ndarray:
    """Rows of the scene's agents, the SDC first, then by distance."""
    apart = np.linalg.norm(tracks.centre[:, now] - tracks.centre[sdc, now], axis=-1)
    apart[~tracks.valid[:, now]] = np.inf
    apart[sdc] = -1.0
    order = np.argsort(apart, kind="stable")[: crop.max_agents]
    return order[apart[order] <= crop.radius]


def _cut_agents(tracks: Tracks, rows: np.ndarray, window: slice, origin: np.ndarray, max_predict: int) -> Agents:
    valid = tracks.valid[rows, window]
    flat = (tracks.centre[rows, window] - origin) * valid[..., None]
    height = np.broadcast_to(tracks.extent[rows, None, 2:] / 2, flat[..., :1].shape)  # boxes stand on z = 0
    position = np.concatenate((flat, height * valid[..., None]), -1)
    heading = (tracks.heading[rows, window] + np.pi) % (2 * np.pi) - np.pi
    predict = np.zeros(len(rows), dtype=bool)
    predict[_rows_to_predict(tracks, rows, window, max_predict)] = True
    return Agents(
        position=torch.from_numpy(position).float(),
        heading=torch.from_numpy(heading * valid).float(),
        velocity=torch.from_numpy(tracks.velocity[rows, window] * valid[..., None]).float(),
        valid=torch.from_numpy(valid),
        extent=torch.from_numpy(tracks.extent[rows]).float(),
        kind=torch.from_numpy(tracks.kind[rows]),
        track_id=torch.from_numpy(tracks.track_id[rows]),
        predict=torch.from_numpy(predict),
        sdc=torch.arange(len(rows)) == 0,
        batch_size=[],
    )


def _rows_to_predict(tracks: Tracks, rows: np.ndarray, window: slice, most: int) -> np.ndarray:
    """Places in ``rows`` (nearest first) of moving agents that stay to the end; not all of them on foot or bike."""
    lasting = tracks.valid[rows, window].all(1) & (_travel(tracks, rows, window) >= MOVING)
    lasting[0] = False  # the SDC is evaluated anyway
    vehicle = tracks.kind[rows] == AgentKind.VEHICLE
    vehicles, others = np.flatnonzero(lasting & vehicle), np.flatnonzero(lasting & ~vehicle)
    num_others = max(round(most * SHARE_ON_FOOT_OR_BIKE), most - len(vehicles))
    others = others[:num_others]
    return np.concatenate((vehicles[: most - len(others)], others))


def _wheels_collide(agents: Agents) -> bool:
    """A vehicle or cyclist overlaps anybody at any step (SUMO does not see a truck's corner in a turn)."""
    size = agents.extent[:, None, :2].expand(-1, LOG_STEPS, -1)
    boxes = torch.cat((agents.position[..., :2], agents.heading[..., None], size), -1).transpose(0, 1)
    ego = (agents.kind != AgentKind.PEDESTRIAN).nonzero()[:, 0]
    return bool((nearest_box_distance(boxes, agents.valid.T, ego=ego, rounding=0.0) < 0).any())


def _kept_region(tracks: Tracks, rows: np.ndarray, window: slice, origin: np.ndarray, crop: Crop) -> object:
    """Shapely polygon: a disk around the SDC and a margin around every track."""
    import shapely

    ways = [tracks.centre[row, window][tracks.valid[row, window]][::5] for row in rows]
    lines = [shapely.LineString(way) if len(way) > 1 else shapely.Point(way[0]) for way in ways]
    tubes = shapely.buffer([line.simplify(1.0) for line in lines], crop.map_margin, quad_segs=4)
    region = shapely.union_all([shapely.Point(origin).buffer(crop.radius), *tubes])
    shapely.prepare(region)
    return region


def cut_map(road: NetMap, region: object, origin: np.ndarray) -> tuple[RoadMap, set[int]]:
    """The part of a map inside a region.

    A lane or line keeps its points from the first to the last one inside; a road edge is cut to one polyline for each
    stretch inside; a crosswalk with a point inside is kept whole.

    Args:
        road: map of a network.
        region: shapely polygon.
        origin: ``[2]``, what is subtracted [m].

    Returns:
        The map, and the ``feature_id`` of the kept lanes whose first point is inside.
    """
    import shapely

    counts = np.array([len(feature.points) for feature in road.features])
    points = np.concatenate([feature.points for feature in road.features])
    inside = np.split(shapely.contains_xy(region, points[:, 0], points[:, 1]), np.cumsum(counts)[:-1])
    pieces: list[tuple[Feature, np.ndarray]] = []
    begun = set()
    for feature, mask in zip(road.features, inside, strict=True):
        if not mask.any():
            continue
        pieces += [(feature, piece) for piece in _pieces(feature, mask)]
        if feature.kind in LANE_KINDS and mask[0]:
            begun.add(feature.feature_id)
    return _road_map(pieces, road, origin), begun


def _pieces(feature: Feature, inside: np.ndarray) -> list[np.ndarray]:
    """The kept polylines of one feature with at least one point inside."""
    if feature.kind in EDGE_KINDS:
        return _stretches(feature.points, inside)
    if feature.kind in (MapKind.CROSSWALK, MapKind.STOP_SIGN):
        return [feature.points]
    first, last = np.flatnonzero(inside)[[0, -1]]
    if first == last:  # a polyline needs two points
        first, last = (first, last + 1) if last + 1 < len(inside) else (first - 1, last)
    return [feature.points[first : last + 1]]


def _stretches(ring: np.ndarray, inside: np.ndarray) -> list[np.ndarray]:
    """Runs of two points or more of a closed ring (last point = first point) that lie inside."""
    if inside.all():
        return [ring]
    turn = int(np.flatnonzero(~inside)[0])  # begin outside, so that no run wraps around the end
    ring, inside = np.roll(ring[:-1], -turn, axis=0), np.roll(inside[:-1], -turn)
    change = np.flatnonzero(np.diff(np.concatenate(([False], inside, [False])).astype(np.int8)))
    return [ring[s:e] for s, e in change.reshape(-1, 2) if e - s >= 2]


def _road_map(pieces: list[tuple[Feature, np.ndarray]], road: NetMap, origin: np.ndarray) -> RoadMap:
    """Map of polylines; a piece of an edge that was cut gets an id of its own."""
    last_id = road.features[-1].feature_id
    ids, used = [], set()
    for feature, _ in pieces:
        if feature.feature_id in used:
            last_id += 1
        ids.append(last_id if feature.feature_id in used else feature.feature_id)
        used.add(feature.feature_id)
    counts = torch.tensor([len(points) for _, points in pieces])
    flat = np.concatenate([points for _, points in pieces]) - origin
    known = np.isin(road.links[:, :2], list(used)).all(1)
    return RoadMap(
        points=torch.from_numpy(np.concatenate((flat, np.zeros_like(flat[:, :1])), -1)).float(),
        start=torch.cumsum(counts, 0) - counts,
        count=counts,
        kind=torch.tensor([int(feature.kind) for feature, _ in pieces]),
        feature_id=torch.tensor(ids),
        speed_limit=torch.tensor([feature.speed_limit for feature, _ in pieces]),
        links=torch.from_numpy(road.links[known]),
        batch_size=[],
    )


def _cut_lights(
    road: NetMap, lights: dict[str, list[str]], kept: set[int], window: slice, origin: np.ndarray
) -> Lights:
    signals = [signal for signal in road.signals if signal.lane_id in kept]
    states = [[int(LIGHT_LETTERS[s[signal.index]]) for s in lights[signal.light][window]] for signal in signals]
    stops = np.array([[*(signal.stop_point - origin), 0.0] for signal in signals]).reshape(-1, 1, 3)
    return Lights(
        lane_id=torch.tensor([signal.lane_id for signal in signals], dtype=torch.int64),
        state=torch.tensor(states, dtype=torch.int64).reshape(-1, LOG_STEPS),
        stop_point=torch.from_numpy(stops).float().expand(-1, LOG_STEPS, -1).clone(),
        batch_size=[],
    )
