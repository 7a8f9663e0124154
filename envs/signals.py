"""What happened in a decision, agent by agent: collisions, leaving the road, progress, red lights.

A signal is a function of a :class:`Decision`, registered under a name; :class:`~envs.traffic.TrafficEnv` computes
those that it is asked for and no other. Geometry and rules are those of the realism metric (realism.md 3 and 4),
without the accidents of its code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor
from torchrl.data import Categorical, TensorSpec, Unbounded

from envs import keys
from envs.devices import of_rows
from envs.geometry.boxes import nearest_box_distance
from envs.geometry.edges import RoadEdges
from envs.geometry.ground import Ground, climb
from envs.geometry.lights import Lanes, crosses_red
from envs.geometry.paths import distance_along
from envs.scene import CURRENT_STEP, EDGE_KINDS, RED_STATES, Agents, LightState, Scene, polylines, surface_streets


class SignalMap:
    """Map and lights of one uncollated scene as signals need them, each part made on first use.

    Args:
        scene: the scene.
        device: where the parts live.
    """

    def __init__(self, scene: Scene, device: torch.device) -> None:
        self._scene, self._device = scene, device

    @cached_property
    def edges(self) -> RoadEdges:
        """Road edges; every ring is closed."""
        try:
            return RoadEdges.from_polylines(polylines(self._scene, EDGE_KINDS), every_ring=True).to(self._device)
        except ValueError as error:
            raise ValueError(f"scene {self._scene.scene_id}: {error}") from error

    @cached_property
    def ground(self) -> Ground:
        """Heights of the map."""
        return Ground(self._scene.road.points.to(self._device))

    @cached_property
    def lanes(self) -> Lanes | None:
        """Surface streets; None if there is none."""
        lines, owner = surface_streets(self._scene.road)
        return Lanes.from_polylines([line.to(self._device) for line in lines], owner.to(self._device))

    @cached_property
    def lights(self) -> tuple[Tensor, Tensor, Tensor]:
        """Lanes ``[G]``, whether a stop point may not be passed ``[G, L - 1]``, stop points ``[G, L, 2]``."""
        lights = self._scene.lights.to(self._device)
        red = torch.isin(lights.state, torch.tensor(RED_STATES, device=self._device))[:, 1:]
        listed = (lights.state != LightState.ABSENT)[:, :-1]
        return lights.lane_id, red & listed, lights.stop_point[..., :2]


@dataclass(frozen=True)
class Decision:
    """F poses of K rollouts of S scenes, and the pose before them.

    Attributes:
        poses: ``[S, K, A, F + 1, 3]``.
        valid: ``[S, K, A, F + 1]`` bool, the agent is there.
        height: ``[S, K, A, F + 1]``, z of the agents' centres [m]; only if a requested signal is ``lifted``.
        step: ``[S, K]`` int64, logged step of the pose before.
        agents: the S scenes' agents; their boxes and their logs.
        maps: of the S scenes.
    """

    poses: Tensor
    valid: Tensor
    height: Tensor | None
    step: Tensor
    agents: Agents
    maps: Sequence[SignalMap]


class Signal(NamedTuple):
    """A registered signal.

    Attributes:
        measure: :class:`Decision` -> ``[S, K, A]``.
        dtype: of what it gives; an agent that is not there has 0.
        lifted: it reads heights.
    """

    measure: Callable[[Decision], Tensor]
    dtype: torch.dtype
    lifted: bool


SIGNALS: dict[str, Signal] = {}
"""Signals by name."""
_OTHERS = (keys.RECENT, keys.VALID, keys.KIND, keys.CONTROLLED, keys.ACTION, keys.TOKEN, keys.REWARD)
_OTHERS += (keys.LOG_PROB, keys.SAMPLING_LOG_PROB)
_TAKEN = frozenset(key[-1] for key in _OTHERS)


def signal(name: str, *, dtype: torch.dtype, lifted: bool = False) -> Callable[[Callable], Callable]:
    """Register a function as a signal; it is found under ``("agents", name)``.

    Args:
        name: of the signal.

    Keyword Args:
        dtype: bool or a floating type.
        lifted: the function reads :attr:`Decision.height`.

    Raises:
        ValueError: a name that is taken.

    Examples:
        >>> @signal("moved", dtype=torch.float32)
        ... def moved(decision):
        ...     return (decision.poses[..., -1, :2] - decision.poses[..., 0, :2]).norm(dim=-1)
        >>> from envs.sources.synthetic import straight_road
        >>> from envs.traffic import TrafficEnv
        >>> TrafficEnv([straight_road(1)], signals=("moved",)).rollout(3)["next", "agents", "moved"].shape
        torch.Size([1, 3, 1])
        >>> del SIGNALS["moved"]
    """
    if name in SIGNALS or name in _TAKEN:
        raise ValueError(
            f"the name {name!r} of a signal is taken; choose another one than {sorted(_TAKEN | {*SIGNALS})}."
        )

    def register(measure: Callable[[Decision], Tensor]) -> Callable[[Decision], Tensor]:
        SIGNALS[name] = Signal(measure, dtype, lifted)
        return measure

    return register


@signal("collision", dtype=torch.bool)
def collision(decision: Decision) -> Tensor:
    """The agent's box overlaps the box of another agent in some pose (realism.md section 3.1)."""
    size = decision.agents.extent[:, None, :, None, :2].expand(*decision.poses.shape[:-1], 2)
    boxes = torch.cat((decision.poses, size), -1)[..., 1:, :].transpose(2, 3)
    nearest = nearest_box_distance(boxes, decision.valid[..., 1:].transpose(2, 3))
    return (nearest < 0).any(2)


@signal("offroad", dtype=torch.bool, lifted=True)
def offroad(decision: Decision) -> Tensor:
    """A corner of the agent's box is off the road in some pose (realism.md section 4.1)."""
    off = []
    position = torch.cat((decision.poses[..., :2], decision.height[..., None]), -1)[..., 1:, :]
    heading = decision.poses[..., 1:, 2]
    for scene, road in enumerate(decision.maps):
        extent = decision.agents.extent[scene, None, :, None].expand(position[scene].shape)
        boxes = (position[scene], heading[scene], extent)
        distance = of_rows(decision.valid[scene, ..., 1:], road.edges.box_offroad_distance, *boxes)
        off.append(distance > 0)
    return torch.stack(off).any(-1)


@signal("progress", dtype=torch.float32)
def progress(decision: Decision) -> Tensor:
    """Metres that the agent advanced along its own logged path, from the nearest place on it to the next one."""
    path, valid = decision.agents.position[:, None, :, :, :2], decision.agents.valid[:, None]
    # A dim for the two places between that of the agents and that of the path.
    poses, here = decision.poses[..., :2], decision.valid
    places = torch.stack((poses[..., 0, :], poses[..., -1, :]), -2)
    shape = (*places.shape[:-1], path.shape[-2])
    path, valid = path[..., None, :, :].expand(*shape, 2), valid[..., None, :].expand(shape)
    before, after = distance_along(path, valid, places).unbind(-1)
    return torch.where(here[..., 0] & here[..., -1], after - before, 0)


@signal("red_light", dtype=torch.bool)
def red_light(decision: Decision) -> Tensor:
    """The agent passes the stop point of the lane that it is on while the light is red (realism.md section 4.2)."""
    crossed = torch.zeros_like(decision.valid[..., 1:])
    steps = crossed.shape[-1]
    for scene, road in enumerate(decision.maps):
        if road.lanes is None:
            continue
        lane_id, red, stop = road.lights
        for first in decision.step[scene].unique().tolist():
            rows = decision.step[scene] == first
            position, valid = decision.poses[scene, rows, ..., :2], decision.valid[scene, rows]
            at = (red[:, first : first + steps], stop[:, first : first + steps + 1])
            crossed[scene, rows] = crosses_red(road.lanes, lane_id, *at, position, valid) & valid[..., :-1]
    return crossed.any(-1)


class Signals:
    """The signals that an environment is asked for: their specs, and what they need of its scenes.

    Args:
        names: of :data:`SIGNALS`.
        num_rollouts: K.
        device: where states live.

    Raises:
        ValueError: a name that is not registered, or one named twice.
    """

    def __init__(self, names: Sequence[str], num_rollouts: int, device: torch.device) -> None:
        names = [names] if isinstance(names, str) else names
        unknown = [name for name in names if name not in SIGNALS]
        if unknown or len(set(names)) < len(names):
            raise ValueError(f"signals must be different names of {sorted(SIGNALS)}, got {list(names)}.")
        self._signals = {name: SIGNALS[name] for name in names}
        self._lifted = any(each.lifted for each in self._signals.values())
        self._num_rollouts, self._device = num_rollouts, device
        self._maps: dict[int, SignalMap] = {}

    def specs(self, shape: torch.Size) -> dict[str, TensorSpec]:
        """The spec of every signal; ``shape`` is ``[B, A]``."""
        flag = Categorical(2, shape=shape, dtype=torch.bool, device=self._device)
        return {
            name: flag.clone() if each.dtype is torch.bool else Unbounded(shape, self._device, each.dtype)
            for name, each in self._signals.items()
        }

    def nothing(self, shape: torch.Size) -> dict[str, Tensor]:
        """What signals say at a reset: 0, ``[B, A]``."""
        return {name: torch.zeros(shape, dtype=each.dtype, device=self._device) for name, each in self._signals.items()}

    def load(self, index: Sequence[int], scenes: Sequence[Scene], batch: Scene, controlled: Sequence[Tensor]) -> None:
        """Take over the S scenes at hand.

        Args:
            index: of each in the source.
            scenes: uncollated, on the CPU.
            batch: collated, on the device.
            controlled: ``[A]`` bool of each, on the CPU: whose height is that of the ground.
        """
        made = self._maps
        self._maps = {
            i: made[i] if i in made else SignalMap(scene, self._device) for i, scene in zip(index, scenes, strict=True)
        }
        self._index, self._agents = list(index), batch.agents
        if self._lifted:
            # Rows and not a mask, which would have to be counted on the device in every decision.
            self._moved = [mask.nonzero()[:, 0].to(self._device) for mask in controlled]
            self._start_heights()

    def _start_heights(self) -> None:
        """Heights of agents, and of their centres above the ground: ``[S, K, A]``."""
        z = self._agents.position[:, :, CURRENT_STEP]
        ground = [
            self._maps[index].ground.height(place[:, :2], place[:, 2])
            for index, place in zip(self._index, z, strict=True)
        ]
        self._first = z[..., 2][:, None].expand(-1, self._num_rollouts, -1)
        self._above = (z[..., 2] - torch.stack(ground))[:, None].expand_as(self._first)
        if not hasattr(self, "_height"):
            self._height = self._first.clone()

    def reset(self, rows: Tensor) -> None:
        """Start some rows ``[B]`` bool anew."""
        if self._lifted:
            again = rows.view(-1, self._num_rollouts, 1)
            self._height = torch.where(again, self._first, self._height)

    def measure(self, poses: Tensor, valid: Tensor, step: Tensor) -> dict[str, Tensor]:
        """All signals of one decision, each ``[B, A]``.

        Args:
            poses: ``[B, A, F + 1, 3]``, the pose before the decision first.
            valid: ``[B, A, F + 1]`` bool.
            step: ``[B]`` int64, logged step of the pose before.
        """
        poses, valid, step = (value.unflatten(0, (-1, self._num_rollouts)) for value in (poses, valid, step))
        height = self._heights(poses, step) if self._lifted else None
        maps = [self._maps[index] for index in self._index]
        decision = Decision(poses, valid, height, step, self._agents, maps)
        there = valid[..., 1:].any(-1)
        return {
            name: torch.where(there, each.measure(decision), 0).to(each.dtype).flatten(0, 1)
            for name, each in self._signals.items()
        }

    def _heights(self, poses: Tensor, step: Tensor) -> Tensor:
        """``[S, K, A, F + 1]``: of the ground under controlled agents, of the log for the others."""
        steps = poses.shape[-2] - 1
        at = step[..., None] + torch.arange(steps + 1, device=step.device)
        logged = self._agents.position[..., 2].transpose(1, 2)  # [S, L, A]
        scene = torch.arange(len(step), device=step.device)[:, None, None]
        height = logged[scene, at].transpose(-1, -2).contiguous()
        for row, (index, moved) in enumerate(zip(self._index, self._moved, strict=True)):
            start, above = self._height[row][:, moved], self._above[row][:, moved]
            rise = climb(self._maps[index].ground, poses[row][:, moved, 1:], start, start - above)
            height[row][:, moved] = start[..., None] + torch.nn.functional.pad(rise, (1, 0))
        self._height = height[..., -1]
        return height
