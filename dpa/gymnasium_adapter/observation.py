"""What an agent sees, as arrays of fixed size between -1 and 1 that an off-the-shelf network can read."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from envs import keys
from envs.geometry.frames import rotate, to_local, wrap_angle
from envs.geometry.paths import distance_along, point_along
from envs.scene import (
    CURRENT_STEP,
    EDGE_KINDS,
    LANE_KINDS,
    RED_STATES,
    STEP_SECONDS,
    AgentKind,
    LightState,
    Scene,
    polylines,
)

SPEED_SCALE, TURN_SCALE, SIZE_SCALE = 30.0, 2.0, 20.0
"""What counts as one: speed [m/s], speed of turning [rad/s], sides of a box [m]."""
POINT_GAP = 3.0
"""Distance between the map points of a line [m]."""
NOWHERE = 1e9
"""Coordinate of a place that nobody sees [m]."""
CAUTION_STATES = (LightState.ARROW_CAUTION, LightState.CAUTION, LightState.FLASHING_CAUTION, LightState.FLASHING_STOP)
GO_STATES = (LightState.ARROW_GO, LightState.GO)


@dataclass(frozen=True)
class Sight:
    """How much an agent sees.

    Attributes:
        agents: nearest other agents.
        points: nearest points of lanes and road edges.
        lights: nearest stop points.
        path: points ahead on the agent's own logged path, which is its route.
        path_gap: distance between those [m].
        reach: nothing farther away is seen; what counts as one in a position [m].

    Raises:
        ValueError: a number that is not positive.
    """

    agents: int = 8
    points: int = 48
    lights: int = 4
    path: int = 8
    path_gap: float = 5.0
    reach: float = 60.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if getattr(self, field.name) <= 0:
                raise ValueError(f"{field.name} of the sight must be positive, got {getattr(self, field.name)}.")

    def space(self, num_agents: int | None) -> spaces.Dict:
        """The space of :meth:`Observer.observe`: of one agent (None), or of several, one row for each.

        ======== ================== ==============================================================================
        entry    shape of one agent features
        ======== ================== ==============================================================================
        ego      ``[11]``           speed ahead, to the left and of turning; length, width; one-hot
                                    :class:`~envs.scene.AgentKind` (5); share of the episode that is over
        path     ``[path, 2]``      x, y
        agents   ``[agents, 9]``    x, y, cos and sin of the heading, velocity x, y, length, width, 1
        points   ``[points, 6]``    x, y, cos and sin of the direction, 1 for a lane, 1 for a road edge
        lights   ``[lights, 6]``    x, y, 1 for red, 1 for caution, 1 for go, 1
        ======== ================== ==============================================================================

        In the agent's own frame, nearest first; 0 where there is nothing.
        """
        rows = () if num_agents is None else (num_agents,)
        shapes = {
            "ego": (6 + len(AgentKind),),
            "path": (self.path, 2),
            "agents": (self.agents, 9),
            "points": (self.points, 6),
            "lights": (self.lights, 6),
        }
        return spaces.Dict({name: spaces.Box(-1, 1, (*rows, *shape), np.float32) for name, shape in shapes.items()})


class Observer:
    """Observations of the agents of one scene.

    Args:
        scene: uncollated; its present agents are the environment's.
        sight: how much they see.
        horizon: T.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> from envs.traffic import TrafficEnv
        >>> scene = straight_road(3)
        >>> seen = Observer(scene, Sight(), horizon=16).observe(TrafficEnv([scene]).reset()[0], torch.tensor([0, 2]))
        >>> {name: value.shape for name, value in seen.items()}
        {'ego': (2, 11), 'path': (2, 8, 2), 'agents': (2, 8, 9), 'points': (2, 48, 6), 'lights': (2, 4, 6)}
    """

    def __init__(self, scene: Scene, sight: Sight, horizon: int) -> None:
        present = scene.agents.present
        self.sight, self._horizon = sight, horizon
        self._extent = scene.agents.extent[present, :2]
        self._path, self._path_valid = scene.agents.position[present, :, :2], scene.agents.valid[present]
        # One light that is never listed and one point out of reach, so that there always is a nearest one.
        self._light_state = torch.nn.functional.pad(scene.lights.state, (0, 0, 0, 1), value=int(LightState.ABSENT))
        self._stop_point = torch.nn.functional.pad(scene.lights.stop_point[..., :2], (0, 0, 0, 0, 0, 1))
        kinds = enumerate((LANE_KINDS, EDGE_KINDS))
        self._points = torch.cat(
            (torch.full((1, 4), NOWHERE), *(_map_points(scene, each, flag) for flag, each in kinds))
        )

    def observe(self, state: TensorDictBase, egos: Tensor) -> dict[str, NDArray[np.float32]]:
        """What some agents see.

        Args:
            state: one row of the environment.
            egos: ``[E]`` int64.

        Returns:
            The entries of :meth:`Sight.space`, one row for each of the E agents.
        """
        num = len(self._extent)
        recent, valid = state[keys.RECENT][:num], state[keys.VALID][:num]
        decision = int(state[keys.STEP])
        seconds = STEP_SECONDS * (recent.shape[1] - 1)
        pose = recent[:, -1]
        velocity = (pose[:, :2] - recent[:, 0, :2]) / seconds
        turn = wrap_angle(pose[:, 2] - recent[:, 0, 2]) / seconds
        step = CURRENT_STEP + decision * (recent.shape[1] - 1)
        seen = {
            "ego": self._ego(state[keys.KIND], pose, velocity, turn, decision)[egos],
            "path": self._route(pose, egos),
            "agents": self._others(pose, velocity, valid, egos),
            "points": self._map(pose[egos]),
            "lights": self._signals(pose[egos], step),
        }
        return {name: value.clamp(-1, 1).numpy().astype(np.float32) for name, value in seen.items()}

    def _ego(self, kind: Tensor, pose: Tensor, velocity: Tensor, turn: Tensor, decision: int) -> Tensor:
        own = rotate(velocity, -pose[:, 2]) / SPEED_SCALE
        one_hot = torch.nn.functional.one_hot(kind[: len(pose)], len(AgentKind))
        elapsed = torch.full_like(turn, decision / self._horizon)
        return torch.cat((own, turn[:, None] / TURN_SCALE, self._extent / SIZE_SCALE, one_hot, elapsed[:, None]), -1)

    def _route(self, pose: Tensor, egos: Tensor) -> Tensor:
        path, valid = self._path[egos], self._path_valid[egos]
        ahead = (1 + torch.arange(self.sight.path)) * self.sight.path_gap
        places = point_along(path, valid, distance_along(path, valid, pose[egos, :2])[:, None] + ahead)
        return rotate(places - pose[egos, None, :2], -pose[egos, None, 2]) / self.sight.reach

    def _others(self, pose: Tensor, velocity: Tensor, valid: Tensor, egos: Tensor) -> Tensor:
        itself = egos[:, None] == torch.arange(len(pose))
        index, there = self._nearest(pose[egos, :2], pose[:, :2], valid & ~itself, self.sight.agents)
        frame = pose[egos, None]
        local = to_local(pose[index], frame)
        features = (
            local[..., :2] / self.sight.reach,
            local[..., 2:].cos(),
            local[..., 2:].sin(),
            rotate(velocity[index], -frame[..., 2]) / SPEED_SCALE,
            self._extent[index] / SIZE_SCALE,
            torch.ones_like(local[..., :1]),
        )
        return torch.cat(features, -1) * there[..., None]

    def _map(self, frame: Tensor) -> Tensor:
        points = self._points
        everywhere = torch.ones(len(frame), len(points), dtype=torch.bool)
        index, there = self._nearest(frame[:, :2], points[:, :2], everywhere, self.sight.points)
        local = to_local(points[index, :3], frame[:, None])
        direction = torch.stack((local[..., 2].cos(), local[..., 2].sin()), -1)
        edge = points[index, 3:]
        return torch.cat((local[..., :2] / self.sight.reach, direction, 1 - edge, edge), -1) * there[..., None]

    def _signals(self, frame: Tensor, step: int) -> Tensor:
        state, stop = self._light_state[:, step], self._stop_point[:, step]
        listed = (state != LightState.ABSENT).expand(len(frame), -1)
        index, there = self._nearest(frame[:, :2], stop, listed, self.sight.lights)
        local = rotate(stop[index] - frame[:, None, :2], -frame[:, None, 2]) / self.sight.reach
        flags = [torch.isin(state, torch.tensor(group))[index] for group in (RED_STATES, CAUTION_STATES, GO_STATES)]
        return torch.cat((local, torch.stack((*flags, there), -1)), -1) * there[..., None]

    def _nearest(self, centre: Tensor, places: Tensor, seen: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Indices ``[E, count]`` of the nearest places, and whether there is one within reach."""
        distance = torch.cdist(centre, places).masked_fill(~seen, torch.inf)
        missing = max(0, count - distance.shape[1])
        distance = torch.nn.functional.pad(distance, (0, missing), value=torch.inf)
        near, index = distance.topk(count, largest=False)
        return index.clamp(max=len(places) - 1), near <= self.sight.reach


def _map_points(scene: Scene, kinds: tuple[int, ...], flag: int) -> Tensor:
    """``[n, 4]``: x, y, direction and a flag of points of lines, :data:`POINT_GAP` apart."""
    found = [torch.zeros(0, 4)]
    for line in polylines(scene, kinds):
        line = line[:, :2]
        delta = line[1:] - line[:-1]
        if len(delta):
            arc = delta.norm(dim=-1).cumsum(0)
            cell = (arc / POINT_GAP).floor()
            keep = torch.cat((torch.ones(1, dtype=torch.bool), cell[1:] > cell[:-1]))
            heading = torch.atan2(delta[:, 1], delta[:, 0])[keep, None]
            found.append(torch.cat((line[:-1][keep], heading, torch.full_like(heading, flag)), -1))
    return torch.cat(found)
