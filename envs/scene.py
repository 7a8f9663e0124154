"""A traffic scene: tracks, map and lights of 9.1 s, as one TensorClass.

A :class:`Scene` is ragged: it holds exactly the agents, points, polylines and lights that its recording has.
:func:`collate` pads several scenes to one batch. Sources make scenes (:mod:`envs.sources`), the store keeps them
(:mod:`envs.store`), and everything else reads them through the :class:`SceneSource` protocol, so a list of scenes
and a store of a million are the same thing to the environment.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum, IntFlag
from typing import Protocol, runtime_checkable

import torch
from tensordict import TensorClass
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

STEP_SECONDS = 0.1
"""Time between two logged steps [s] (WOMD: 10 Hz)."""
LOG_STEPS = 91
"""L: logged steps in a scene."""
CURRENT_STEP = 10
"""Index of the current step: ten steps of history lie before it, eighty follow."""
LARGEST_NUMBER = 1e7
"""No coordinate in metres, angle or speed is larger: a quarter of the Earth's meridian, the largest UTM northing."""


class SceneError(ValueError):
    """A scene, or the file that it came from, is not usable; the message names it and says the fix."""


class AgentKind(IntEnum):
    """Class of a road user (numbers of the WOMD ``Track.ObjectType``)."""

    UNSET = 0
    VEHICLE = 1
    PEDESTRIAN = 2
    CYCLIST = 3
    OTHER = 4


class MapKind(IntEnum):
    """Type of a map polyline (numbers of the WOMD ``roadgraph_samples/type``)."""

    LANE_UNDEFINED = 0
    LANE_FREEWAY = 1
    LANE_SURFACE_STREET = 2
    LANE_BIKE = 3
    LINE_UNKNOWN = 5
    LINE_BROKEN_WHITE = 6
    LINE_SOLID_WHITE = 7
    LINE_DOUBLE_WHITE = 8
    LINE_BROKEN_YELLOW = 9
    LINE_BROKEN_DOUBLE_YELLOW = 10
    LINE_SOLID_YELLOW = 11
    LINE_SOLID_DOUBLE_YELLOW = 12
    LINE_PASSING_YELLOW = 13
    EDGE_UNKNOWN = 14
    EDGE_BOUNDARY = 15
    EDGE_MEDIAN = 16
    STOP_SIGN = 17
    CROSSWALK = 18
    SPEED_BUMP = 19
    DRIVEWAY = 20


LANE_KINDS = (MapKind.LANE_UNDEFINED, MapKind.LANE_FREEWAY, MapKind.LANE_SURFACE_STREET, MapKind.LANE_BIKE)
EDGE_KINDS = (MapKind.EDGE_UNKNOWN, MapKind.EDGE_BOUNDARY, MapKind.EDGE_MEDIAN)
NUM_MAP_KINDS = max(MapKind) + 1


class LinkKind(IntEnum):
    """How one lane is tied to another."""

    EXIT = 0
    """The second lane follows the first one."""
    LEFT = 1
    """The second lane lies to the left of the first one, and a vehicle may change to it."""
    RIGHT = 2
    """The second lane lies to the right of the first one, and a vehicle may change to it."""


class LightState(IntEnum):
    """State of a lane's traffic light (numbers of the WOMD ``TrafficSignalLaneState.State``; -1 is ours)."""

    ABSENT = -1
    UNKNOWN = 0
    ARROW_STOP = 1
    ARROW_CAUTION = 2
    ARROW_GO = 3
    STOP = 4
    CAUTION = 5
    GO = 6
    FLASHING_STOP = 7
    FLASHING_CAUTION = 8


RED_STATES = (LightState.ARROW_STOP, LightState.STOP)
"""States at which vehicles may not pass the stop point (realism.md section 4.2)."""


class Lacks(IntFlag):
    """What a recording does not have; a model or a metric that needs it must not take the stand-in for data."""

    NOTHING = 0
    HEIGHT = 1
    """No z of agents: they stand on the map, or on z = 0."""
    SIZES = 2
    """No boxes: agents have the size of their class."""
    LIGHTS = 4
    """No traffic lights, which does not mean that there were none."""
    TOPOLOGY = 8
    """No links between lanes."""
    SPEED_LIMITS = 16
    """No speed limits of lanes."""
    TARGETS = 32
    """No agents marked for prediction."""


class Agents(TensorClass["nocast"]):
    """Tracks of the road users of a scene (``*`` is nothing, or ``S`` once collated).

    Attributes:
        position: ``[*, A, L, 3]`` float32, centre of the box, in the scene's frame [m]; 0 where invalid.
        heading: ``[*, A, L]`` float32 [rad]; 0 where invalid.
        velocity: ``[*, A, L, 2]`` float32 [m/s]; 0 where invalid.
        valid: ``[*, A, L]`` bool.
        extent: ``[*, A, 3]`` float32, length, width, height at the current step (the first valid step for agents
            that are not there at the current step) [m].
        kind: ``[*, A]`` int64, :class:`AgentKind`.
        track_id: ``[*, A]`` int64, the recording's own id; -1 for padding.
        predict: ``[*, A]`` bool, the recording asks for this agent's prediction (WOMD ``tracks_to_predict``).
        sdc: ``[*, A]`` bool, the self-driving car: exactly one agent of a scene.
    """

    position: Tensor
    heading: Tensor
    velocity: Tensor
    valid: Tensor
    extent: Tensor
    kind: Tensor
    track_id: Tensor
    predict: Tensor
    sdc: Tensor

    @property
    def poses(self) -> Tensor:
        """``[*, A, L, 3]``: x, y, heading of every logged step; 0 where invalid."""
        return torch.cat((self.position[..., :2], self.heading[..., None]), -1)

    @property
    def trajectory(self) -> Tensor:
        """``[*, A, L, 4]``: x, y, z, heading of every logged step, as those of rollouts; 0 where invalid."""
        return torch.cat((self.position, self.heading[..., None]), -1)

    def recent(self, steps: int) -> Tensor:
        """Poses of the last logged steps up to the current one, without holes.

        Where the log is invalid, the pose is carried back from the next one at constant velocity and heading.

        Args:
            steps: F, length of a decision [0.1 s].

        Returns:
            ``[*, A, F + 1, 3]``, the current pose last.
        """
        window = slice(CURRENT_STEP - steps, CURRENT_STEP + 1)
        poses, valid = self.poses[..., window, :].clone(), self.valid[..., window]
        back = torch.cat((self.velocity[..., CURRENT_STEP, :] * STEP_SECONDS, torch.zeros_like(poses[..., 0, :1])), -1)
        for step in reversed(range(steps)):
            held = poses[..., step + 1, :] - back
            poses[..., step, :] = torch.where(valid[..., step, None], poses[..., step, :], held)
        return poses

    @property
    def present(self) -> Tensor:
        """``[*, A]`` bool: valid at the current step; the agents of a simulation (realism.md section 1.2)."""
        return self.valid[..., CURRENT_STEP]

    @property
    def evaluated(self) -> Tensor:
        """``[*, A]`` bool: the SDC and the tracks to predict (realism.md section 1.3)."""
        return self.sdc | self.predict


class RoadMap(TensorClass["nocast"]):
    """Polylines of a map, all points in one flat row.

    Polyline ``p`` owns the points ``start[p] : start[p] + count[p]``. Polygons (crosswalk, speed bump, driveway) are
    not closed; a stop sign is a polyline of one point. Road edges have the drivable side on their left.

    Attributes:
        points: ``[*, N, 3]`` float32, in the scene's frame [m].
        start: ``[*, P]`` int64, first point.
        count: ``[*, P]`` int64, number of points; 0 for padding.
        kind: ``[*, P]`` int64, :class:`MapKind`.
        feature_id: ``[*, P]`` int64, the recording's own id; -1 for padding.
        speed_limit: ``[*, P]`` float32 [m/s]; 0 where the source has none.
        links: ``[*, E, 3]`` int64, rows ``(feature_id, feature_id, LinkKind)``; -1 for padding.
    """

    points: Tensor
    start: Tensor
    count: Tensor
    kind: Tensor
    feature_id: Tensor
    speed_limit: Tensor
    links: Tensor


class Lights(TensorClass["nocast"]):
    """Traffic lights, by the lane that they rule.

    Attributes:
        lane_id: ``[*, G]`` int64, ``feature_id`` of the lane; -1 for padding.
        state: ``[*, G, L]`` int64, :class:`LightState`; ``ABSENT`` where the step does not list the lane.
        stop_point: ``[*, G, L, 3]`` float32, where vehicles stop, in the scene's frame [m]; 0 where absent.
    """

    lane_id: Tensor
    state: Tensor
    stop_point: Tensor


class Scene(TensorClass["nocast"]):
    """One recorded (or generated) traffic scene of 9.1 s, or a padded batch of them.

    Attributes:
        agents: :class:`Agents`.
        road: :class:`RoadMap`.
        lights: :class:`Lights`.
        origin: ``[*, 3]`` float64, what was subtracted from the source's coordinates [m].
        lacks: ``[*]`` int64, flags of :class:`Lacks`.
        scene_id: the recording's id (a list of them once collated).

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(num_vehicles=2)
        >>> scene.agents.position.shape
        torch.Size([2, 91, 3])
        >>> collate([scene, straight_road(num_vehicles=3)]).agents.position.shape
        torch.Size([2, 3, 91, 3])
    """

    agents: Agents
    road: RoadMap
    lights: Lights
    origin: Tensor
    lacks: Tensor
    scene_id: str

    def __deepcopy__(self, memo: dict) -> Scene:
        return self.clone()  # Gymnasium copies the arguments of an environment; tensordict's own way warns

    def validate(self, name: str | None = None) -> Scene:
        """Check one uncollated scene and return it.

        Args:
            name: what to call the scene in an error (a file and record); its ``scene_id`` by default.

        Raises:
            SceneError: no SDC, no agent at the current step, no road edge, a value that is not finite or beyond
                :data:`LARGEST_NUMBER`, a number that stands for nothing, or fields whose sizes disagree. The message
                names the scene, the field and the fix.
        """
        from envs.validation import check_scene

        check_scene(self, name)
        return self


@runtime_checkable
class SceneSource(Protocol):
    """Anything that gives scenes by index: a list, a :class:`~envs.store.SceneStore`, a subset of one."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Scene: ...


def check_episode(decision_steps: int, horizon: int) -> None:
    """Refuse episodes that a log cannot begin or does not reach the end of.

    Args:
        decision_steps: of 0.1 s, between two decisions.
        horizon: decisions.

    Raises:
        ValueError: naming both numbers.
    """
    if decision_steps > CURRENT_STEP:
        raise ValueError(
            f"decision_steps must be at most the {CURRENT_STEP} steps of 0.1 s of the history, got {decision_steps}."
        )
    if CURRENT_STEP + decision_steps * horizon >= LOG_STEPS:
        raise ValueError(
            f"horizon * decision_steps must be at most {LOG_STEPS - 1 - CURRENT_STEP} steps of 0.1 s, got "
            f"{horizon} * {decision_steps}."
        )


def select_agents(scene: Scene, index: Tensor) -> Scene:
    """Keep some agents of one uncollated scene, in the order given.

    Args:
        scene: a scene of A agents.
        index: ``[A']`` int64 or ``[A]`` bool.
    """
    scene = scene.clone(recurse=False)
    agents = scene.agents
    scene.agents = Agents(
        **{field: getattr(agents, field)[index] for field in agents.__dataclass_fields__}, batch_size=[]
    )
    return scene


def collate(scenes: Sequence[Scene]) -> Scene:
    """Pad scenes to one batch of batch size ``[S]``.

    Padding agents and polylines are invalid in every mask: ``valid`` false, ``count`` 0, ids and kinds -1 where a field
    documents it, 0 otherwise.

    Args:
        scenes: S uncollated scenes.
    """
    size = [len(scenes)]

    def pad(part: str, cls: type, fill: dict[str, float]) -> TensorClass:
        parts = [getattr(scene, part) for scene in scenes]
        fields = cls.__dataclass_fields__
        return cls(
            **{
                name: pad_sequence([getattr(p, name) for p in parts], batch_first=True, padding_value=fill.get(name, 0))
                for name in fields
            },
            batch_size=size,
        )

    return Scene(
        agents=pad("agents", Agents, {"track_id": -1}),
        road=pad("road", RoadMap, {"feature_id": -1, "links": -1}),
        lights=pad("lights", Lights, {"lane_id": -1, "state": LightState.ABSENT}),
        origin=torch.stack([scene.origin for scene in scenes]),
        lacks=torch.stack([scene.lacks for scene in scenes]),
        scene_id=[scene.scene_id for scene in scenes],
        batch_size=size,
    )


def polylines(scene: Scene, kinds: Sequence[int]) -> list[Tensor]:
    """The polylines of some kinds of one uncollated scene, each ``[n, 3]``, in map order."""
    road = scene.road
    keep = torch.isin(road.kind, torch.as_tensor(tuple(kinds), device=road.kind.device))
    return [road.points[s : s + n] for s, n in zip(road.start[keep].tolist(), road.count[keep].tolist(), strict=True)]


def surface_streets(road: RoadMap) -> tuple[list[Tensor], Tensor]:
    """The lanes of one uncollated map that lights rule, in map order; a lane of a single point is left out.

    Returns:
        Their points, each ``[n, 2]``, and their ``feature_id`` ``[lanes]``.
    """
    index = ((road.kind == MapKind.LANE_SURFACE_STREET) & (road.count >= 2)).nonzero()[:, 0]
    ends = zip(road.start[index].tolist(), road.count[index].tolist(), strict=True)
    return [road.points[start : start + count, :2] for start, count in ends], road.feature_id[index]
