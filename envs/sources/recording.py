"""A recording as its source gives it, in world coordinates, and the way from there to a :class:`~envs.scene.Scene`.

Every reader of real data ends here, so that origin, rounding, masking and light tables are decided once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from envs.scene import (
    CURRENT_STEP,
    LARGEST_NUMBER,
    LOG_STEPS,
    AgentKind,
    Agents,
    Lacks,
    Lights,
    LightState,
    MapKind,
    RoadMap,
    Scene,
    SceneError,
)
from envs.sources.source import Notes
from envs.validation import check_scene_id

KIND_OF_FEATURE = {
    "lane": MapKind.LANE_UNDEFINED,
    "road_line": MapKind.LINE_UNKNOWN,
    "road_edge": MapKind.EDGE_UNKNOWN,
    "stop_sign": MapKind.STOP_SIGN,
    "crosswalk": MapKind.CROSSWALK,
    "speed_bump": MapKind.SPEED_BUMP,
    "driveway": MapKind.DRIVEWAY,
}
"""WOMD's map features by name; the types of lanes, lines and edges count from these kinds on."""
_MAP_KINDS, _AGENT_KINDS = frozenset(MapKind), frozenset(AgentKind)
_LIGHT_STATES = frozenset(LightState) - {LightState.ABSENT}
MOST = {
    "track": 10_000,
    "map feature": 100_000,
    "point of the map": 1_000_000,
    "light listing": 100_000,
    "link": 500_000,
    "track to predict": 10_000,
}
"""Of one scene; a file of a megabyte can claim far more, and usual are 100, 500, 20,000, 2,000, 1,000 and 8."""
_LAST_KIND = {
    "lane": MapKind.LANE_BIKE,
    "road_line": MapKind.LINE_PASSING_YELLOW,
    "road_edge": MapKind.EDGE_MEDIAN,
}


def map_kind(feature: str, number: int, notes: Notes) -> MapKind:
    """Kind of a lane, line or edge from WOMD's number of its type.

    Args:
        feature: ``"lane"``, ``"road_line"`` or ``"road_edge"``.
        number: of the type, counted from 0.
        notes: counts a number that is not known; the feature is then of the unknown type.

    Examples:
        >>> from collections import Counter
        >>> map_kind("lane", 2, notes := Counter()).name, map_kind("lane", 9, notes).name
        ('LANE_SURFACE_STREET', 'LANE_UNDEFINED')
        >>> notes
        Counter({'lane of unknown type 9, taken as LANE_UNDEFINED': 1})
    """
    first, last = KIND_OF_FEATURE[feature], _LAST_KIND[feature]
    if 0 <= number <= last - first and first + number in _MAP_KINDS:
        return MapKind(first + number)
    notes[f"{feature} of unknown type {number}, taken as {first.name}"] += 1
    return first


def agent_kind(number: int, notes: Notes) -> AgentKind:
    """Class of a road user from WOMD's number; an unknown one is noted and taken as OTHER."""
    if number in _AGENT_KINDS:
        return AgentKind(number)
    notes[f"track of unknown object type {number}, taken as OTHER"] += 1
    return AgentKind.OTHER


def light_state(number: int, notes: Notes) -> LightState:
    """State of a light from WOMD's number; an unknown one is noted and taken as UNKNOWN."""
    if number in _LIGHT_STATES:
        return LightState(number)
    notes[f"light of unknown state {number}, taken as UNKNOWN"] += 1
    return LightState.UNKNOWN


def check_count(what: str, count: int, name: str) -> None:
    """Refuse a scene that has more of something than any has; a reader asks before it builds them.

    Args:
        what: a key of :data:`MOST`.
        count: how many there are.
        name: what errors call the recording.
    """
    if count > MOST[what]:
        raise SceneError(f"{name}: it has {count} times a {what}; at most {MOST[what]} are read.")


@dataclass(frozen=True)
class Polyline:
    """One map feature in world coordinates.

    Attributes:
        feature_id: the recording's id.
        kind: :class:`~envs.scene.MapKind`.
        points: ``n`` rows x, y, z [m].
        speed_limit: [m/s]; 0 where there is none.
    """

    feature_id: int
    kind: int
    points: Sequence[Sequence[float]]
    speed_limit: float = 0.0


@dataclass(frozen=True)
class LightListing:
    """One lane's traffic light at one step.

    Attributes:
        step: logged step.
        lane_id: ``feature_id`` of the lane.
        state: :class:`~envs.scene.LightState`.
        stop_point: x, y, z in world coordinates [m].
    """

    step: int
    lane_id: int
    state: int
    stop_point: tuple[float, float, float]


@dataclass(frozen=True)
class Recording:
    """Tracks, map and lights in world coordinates; values at invalid steps may be anything.

    Attributes:
        scene_id: the recording's id.
        position: ``[A, L, 3]`` float64 [m].
        heading: ``[A, L]`` [rad].
        velocity: ``[A, L, 2]`` [m/s].
        extent: ``[A, L, 3]`` length, width, height at each step [m].
        valid: ``[A, L]`` bool.
        kind: A numbers of :class:`~envs.scene.AgentKind`.
        track_id: A ids.
        sdc: index of the self-driving car.
        predict: indices of the tracks to predict.
        polylines: the map.
        links: rows ``(feature_id, feature_id, LinkKind)``, in any order, repeated or not.
        lights: listings in recorded order; of several for one lane and step the later one counts (realism.md 4.2).
        lacks: what the recording does not have.
    """

    scene_id: str
    position: np.ndarray
    heading: np.ndarray
    velocity: np.ndarray
    extent: np.ndarray
    valid: np.ndarray
    kind: Sequence[int]
    track_id: Sequence[int]
    sdc: int
    predict: Sequence[int]
    polylines: Sequence[Polyline]
    links: Sequence[tuple[int, int, int]] = ()
    lights: Sequence[LightListing] = field(default=())
    lacks: Lacks = Lacks.NOTHING

    def to_scene(self, name: str) -> Scene:
        """Move the recording to its own origin and round it to float32.

        The origin is the SDC's position at the current step in whole metres: source values that are float32 already
        are then moved without rounding error wherever float32 can hold the result.

        Args:
            name: what errors call the recording (a file and record).

        Raises:
            SceneError: an index out of its range, a repeated track id, a number that does not fit, an origin or light
                that is not finite. :meth:`~envs.scene.Scene.validate` checks the rest.
        """
        self._check(name)
        origin = self._origin(name)
        return Scene(
            agents=self._agents(origin),
            road=self._road(origin),
            lights=self._lights(origin, name),
            origin=torch.from_numpy(origin),
            lacks=torch.tensor(int(self.lacks)),
            scene_id=self.scene_id,
            batch_size=[],
        )

    def _check(self, name: str) -> None:
        num = len(self.track_id)
        check_scene_id(self.scene_id, name)
        check_count("track", num, name)
        check_count("map feature", len(self.polylines), name)
        check_count("point of the map", sum(len(line.points) for line in self.polylines), name)
        check_count("light listing", len(self.lights), name)
        check_count("link", len(self.links), name)
        check_count("track to predict", len(self.predict), name)
        for role, index in (("SDC", self.sdc), *(("track to predict", i) for i in self.predict)):
            if not 0 <= index < num:
                raise SceneError(f"{name}: the {role} is track {index} of {num}; give the index of a track.")
        seen: set[int] = set()
        for index, number in enumerate(self.track_id):
            if number in seen:
                raise SceneError(f"{name}: two tracks share an id: {number}, of track {index}; give each its own.")
            seen.add(number)
        ids = {
            "track": self.track_id,
            "map feature": [line.feature_id for line in self.polylines],
            "light of lane": [listing.lane_id for listing in self.lights],
            "link of lane": [lane for link in self.links for lane in link[:2]],
        }
        for what, numbers in ids.items():
            for number in numbers:
                if not -(2**63) <= number < 2**63:
                    raise SceneError(f"{name}: {what} {number} has an id of more than 64 bits; give a smaller one.")

    def _origin(self, name: str) -> np.ndarray:
        if not self.valid[self.sdc, CURRENT_STEP]:
            raise SceneError(f"{name}: the SDC is not valid at the current step {CURRENT_STEP}; leave the scene out.")
        here = self.position[self.sdc, CURRENT_STEP]
        if not (np.abs(here) <= LARGEST_NUMBER).all():
            raise SceneError(f"{name}: the SDC's position at the current step is {here.tolist()}; leave the scene out.")
        return np.round(here) + 0.0  # no -0.0

    def _agents(self, origin: np.ndarray) -> Agents:
        valid, num = self.valid, len(self.track_id)
        size_step = np.where(valid[:, CURRENT_STEP], CURRENT_STEP, valid.argmax(1))

        def masked(values: np.ndarray) -> Tensor:
            mask = valid.reshape(valid.shape + (1,) * (values.ndim - 2))
            return _float32(np.where(mask, values, 0.0))

        return Agents(
            position=masked(self.position - origin),
            heading=masked(self.heading),
            velocity=masked(self.velocity),
            valid=torch.from_numpy(valid.copy()),
            extent=_float32(self.extent[np.arange(num), size_step]),
            kind=torch.tensor(self.kind, dtype=torch.int64),
            track_id=torch.tensor(self.track_id, dtype=torch.int64),
            predict=_marked(self.predict, num),
            sdc=_marked([self.sdc], num),
            batch_size=[],
        )

    def _road(self, origin: np.ndarray) -> RoadMap:
        lines = self.polylines
        count = torch.tensor([len(line.points) for line in lines], dtype=torch.int64)
        points = np.concatenate([np.reshape(line.points, (-1, 3)) for line in lines] or [np.zeros((0, 3))])
        # Only lanes of this map: WOMD also names neighbours beyond the map's edge, which nobody could look up.
        known = {line.feature_id for line in lines}
        links = sorted({link for link in self.links if link[0] in known and link[1] in known})
        return RoadMap(
            points=_float32(points - origin),
            start=torch.cumsum(count, 0) - count,
            count=count,
            kind=torch.tensor([line.kind for line in lines], dtype=torch.int64),
            feature_id=torch.tensor([line.feature_id for line in lines], dtype=torch.int64),
            speed_limit=torch.tensor([line.speed_limit for line in lines], dtype=torch.float32),
            links=torch.tensor(links, dtype=torch.int64).reshape(-1, 3),
            batch_size=[],
        )

    def _lights(self, origin: np.ndarray, name: str) -> Lights:
        lanes = sorted({row.lane_id for row in self.lights})
        index = {lane: g for g, lane in enumerate(lanes)}
        state = np.full((len(lanes), LOG_STEPS), LightState.ABSENT, dtype=np.int64)
        stop = np.zeros((len(lanes), LOG_STEPS, 3))
        for row in self.lights:
            if not all(abs(value) <= LARGEST_NUMBER for value in row.stop_point):
                raise SceneError(
                    f"{name}: the light of lane {row.lane_id} has the stop point {row.stop_point} at step {row.step}; "
                    "remove the listing."
                )
            state[index[row.lane_id], row.step] = row.state
            stop[index[row.lane_id], row.step] = np.asarray(row.stop_point) - origin
        return Lights(
            lane_id=torch.tensor(lanes, dtype=torch.int64),
            state=torch.from_numpy(state),
            stop_point=_float32(stop),
            batch_size=[],
        )


def _float32(values: np.ndarray) -> Tensor:
    """Rounded; what is too large becomes infinite, which the scene's validation then names."""
    with np.errstate(over="ignore"):
        return torch.from_numpy(values.astype(np.float32))


def _marked(indices: Sequence[int], num: int) -> Tensor:
    """``[num]`` bool, true at the indices."""
    mask = torch.zeros(num, dtype=torch.bool)
    mask[list(indices)] = True
    return mask
