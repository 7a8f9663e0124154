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
    LOG_STEPS,
    AgentKind,
    Agents,
    Lights,
    LightState,
    MapKind,
    RoadMap,
    Scene,
    SceneError,
)

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
        lights: listings in recorded order; of several for one lane and step the later one counts (SPEC section 4.2).
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

    def to_scene(self, name: str) -> Scene:
        """Move the recording to its own origin and round it to float32.

        The origin is the SDC's position at the current step in whole metres: source values that are float32 already
        are then moved without rounding error wherever float32 can hold the result.

        Args:
            name: what errors call the recording (a file and record).

        Raises:
            SceneError: an index, kind or state out of its range, a repeated track id, an origin or light that is not
                finite. :meth:`~envs.scene.Scene.validate` checks the rest.
        """
        self._check(name)
        origin = self._origin(name)
        return Scene(
            agents=self._agents(origin),
            road=self._road(origin),
            lights=self._lights(origin, name),
            origin=torch.from_numpy(origin),
            scene_id=self.scene_id,
            batch_size=[],
        )

    def _check(self, name: str) -> None:
        num = len(self.track_id)
        for role, index in (("SDC", self.sdc), *(("track to predict", i) for i in self.predict)):
            if not 0 <= index < num:
                raise SceneError(f"{name}: the {role} is track {index} of {num}; give the index of a track.")
        if len(set(self.track_id)) != num:
            raise SceneError(f"{name}: two tracks share an id; give every track its own.")
        _check_enum(name, "track", AgentKind, self.kind, self.track_id)
        _check_enum(
            name, "map feature", MapKind, [p.kind for p in self.polylines], [p.feature_id for p in self.polylines]
        )
        _check_enum(name, "light of lane", LightState, [r.state for r in self.lights], [r.lane_id for r in self.lights])

    def _origin(self, name: str) -> np.ndarray:
        if not self.valid[self.sdc, CURRENT_STEP]:
            raise SceneError(f"{name}: the SDC is not valid at the current step {CURRENT_STEP}; leave the scene out.")
        here = self.position[self.sdc, CURRENT_STEP]
        if not np.isfinite(here).all():
            raise SceneError(f"{name}: the SDC's position at the current step is {here.tolist()}; leave the scene out.")
        return np.round(here) + 0.0  # no -0.0

    def _agents(self, origin: np.ndarray) -> Agents:
        valid, num = self.valid, len(self.track_id)
        size_step = np.where(valid[:, CURRENT_STEP], CURRENT_STEP, valid.argmax(1))

        def masked(values: np.ndarray) -> Tensor:
            mask = valid.reshape(valid.shape + (1,) * (values.ndim - 2))
            return torch.from_numpy(np.where(mask, values, 0.0).astype(np.float32))

        return Agents(
            position=masked(self.position - origin),
            heading=masked(self.heading),
            velocity=masked(self.velocity),
            valid=torch.from_numpy(valid.copy()),
            extent=torch.from_numpy(self.extent[np.arange(num), size_step].astype(np.float32)),
            kind=torch.tensor(self.kind, dtype=torch.int64),
            track_id=torch.tensor(self.track_id, dtype=torch.int64),
            predict=_marked(self.predict, num),
            sdc=_marked([self.sdc], num),
            batch_size=[],
        )

    def _road(self, origin: np.ndarray) -> RoadMap:
        lines = self.polylines
        count = torch.tensor([len(line.points) for line in lines], dtype=torch.int64)
        points = np.array([point for line in lines for point in line.points], dtype=np.float64).reshape(-1, 3)
        # Only lanes of this map: WOMD also names neighbours beyond the map's edge, which nobody could look up.
        known = {line.feature_id for line in lines}
        links = sorted({link for link in self.links if link[0] in known and link[1] in known})
        return RoadMap(
            points=torch.from_numpy((points - origin).astype(np.float32)),
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
        stop = np.zeros((len(lanes), LOG_STEPS, 3), dtype=np.float32)
        for row in self.lights:
            point = np.asarray(row.stop_point) - origin
            if not np.isfinite(point).all():
                raise SceneError(
                    f"{name}: the light of lane {row.lane_id} has the stop point {row.stop_point} at step {row.step}; "
                    "remove the listing."
                )
            state[index[row.lane_id], row.step] = row.state
            stop[index[row.lane_id], row.step] = point
        return Lights(
            lane_id=torch.tensor(lanes, dtype=torch.int64),
            state=torch.from_numpy(state),
            stop_point=torch.from_numpy(stop),
            batch_size=[],
        )


def _check_enum(name: str, what: str, enum: type, values: Sequence[int], ids: Sequence[int]) -> None:
    known = {int(member) for member in enum}
    for value, number in zip(values, ids, strict=True):
        if value not in known:
            raise SceneError(
                f"{name}: {what} {number} has the unknown {enum.__name__} {value}; known: {sorted(known)}."
            )


def _marked(indices: Sequence[int], num: int) -> Tensor:
    """``[num]`` bool, true at the indices."""
    mask = torch.zeros(num, dtype=torch.bool)
    mask[list(indices)] = True
    return mask
