"""Tiny parametric scenes for tests and documentation; nothing is read from disk."""

from __future__ import annotations

import torch
from torch import Tensor

from envs.scene import (
    CURRENT_STEP,
    LOG_STEPS,
    STEP_SECONDS,
    AgentKind,
    Agents,
    Lacks,
    Lights,
    LightState,
    MapKind,
    RoadMap,
    Scene,
)

CAR = (4.6, 1.9, 1.5)
"""Length, width and height of a synthetic car [m]."""


def build_scene(
    poses: Tensor,
    lines: list[tuple[MapKind, Tensor]],
    *,
    valid: Tensor | None = None,
    kind: Tensor | None = None,
    lights: Lights | None = None,
    scene_id: str = "synthetic",
) -> Scene:
    """A scene from poses and polylines; the first agent is the SDC, all are to be predicted and as large as a car.

    Args:
        poses: ``[A, L, 3]`` x, y, heading.
        lines: kind and points ``[n, 2]`` or ``[n, 3]`` of each polyline; ``feature_id`` counts from 1.
        valid: ``[A, L]`` bool; all true by default.
        kind: ``[A]``; vehicles by default.
        lights: none by default.
        scene_id: name of the scene.

    Examples:
        >>> poses = torch.zeros(1, 91, 3)
        >>> edge = torch.tensor([[50.0, 5.0], [-50.0, 5.0]])
        >>> build_scene(poses, [(MapKind.EDGE_BOUNDARY, edge)]).agents.sdc
        tensor([True])
    """
    num = poses.shape[0]
    valid = torch.ones(num, LOG_STEPS, dtype=torch.bool) if valid is None else valid
    poses = poses.float() * valid[..., None]
    position = torch.cat((poses[..., :2], torch.zeros_like(poses[..., :1])), -1)
    velocity = torch.zeros_like(poses[..., :2])
    velocity[:, 1:] = (poses[:, 1:, :2] - poses[:, :-1, :2]) / STEP_SECONDS
    velocity[:, 0] = velocity[:, 1]
    both = valid.clone()
    both[:, 1:] &= valid[:, :-1]
    counts = torch.tensor([len(points) for _, points in lines])
    return Scene(
        agents=Agents(
            position=position,
            heading=poses[..., 2],
            velocity=velocity * both[..., None],
            valid=valid,
            extent=torch.tensor(CAR).expand(num, 3).clone(),
            kind=torch.full((num,), AgentKind.VEHICLE) if kind is None else kind,
            track_id=torch.arange(num) + 1,
            predict=torch.ones(num, dtype=torch.bool),
            sdc=torch.arange(num) == 0,
            batch_size=[],
        ),
        road=RoadMap(
            points=torch.cat([torch.nn.functional.pad(p.float(), (0, 3 - p.shape[-1])) for _, p in lines]),
            start=torch.cumsum(counts, 0) - counts,
            count=counts,
            kind=torch.tensor([int(k) for k, _ in lines]),
            feature_id=torch.arange(len(lines)) + 1,
            speed_limit=torch.zeros(len(lines)),
            links=torch.empty(0, 3, dtype=torch.int64),
            batch_size=[],
        ),
        lights=no_lights() if lights is None else lights,
        origin=torch.zeros(3, dtype=torch.float64),
        lacks=torch.tensor(Lacks.TOPOLOGY | Lacks.SPEED_LIMITS),
        scene_id=scene_id,
        batch_size=[],
    )


def no_lights() -> Lights:
    """Lights of a scene that has none (G = 0)."""
    return Lights(
        lane_id=torch.empty(0, dtype=torch.int64),
        state=torch.empty(0, LOG_STEPS, dtype=torch.int64),
        stop_point=torch.empty(0, LOG_STEPS, 3),
        batch_size=[],
    )


def straight_road(num_vehicles: int = 2, speed: float = 10.0, gap: float = 15.0, seed: int | None = None) -> Scene:
    """Vehicles in file on a straight road of two lanes, 10 m wide, along x.

    Args:
        num_vehicles: A; the first one leads and is the SDC.
        speed: of every vehicle [m/s].
        gap: between two centres [m].
        seed: with a seed, each vehicle has its own gentle change of speed.

    Examples:
        >>> straight_road(2, speed=10.0).agents.velocity[0, 0]
        tensor([10.,  0.])
    """
    time = (torch.arange(LOG_STEPS) - CURRENT_STEP) * STEP_SECONDS
    accel = torch.zeros(num_vehicles)
    if seed is not None:
        accel = torch.rand(num_vehicles, generator=torch.Generator().manual_seed(seed)) - 0.5
    x = -gap * torch.arange(num_vehicles)[:, None] + speed * time + accel[:, None] * time**2 / 2
    poses = torch.stack((x, torch.full_like(x, -2.5), torch.zeros_like(x)), -1)
    along = torch.linspace(-200, 300, 51)

    def line(y: float, backward: bool = False) -> Tensor:
        points = torch.stack((along, torch.full_like(along, y)), -1)
        return points.flip(0) if backward else points

    lines = [
        (MapKind.LANE_SURFACE_STREET, line(-2.5)),
        (MapKind.LANE_SURFACE_STREET, line(2.5, backward=True)),
        (MapKind.LINE_BROKEN_YELLOW, line(0.0)),
        (MapKind.EDGE_BOUNDARY, line(-5.0)),
        (MapKind.EDGE_BOUNDARY, line(5.0, backward=True)),
    ]
    return build_scene(poses, lines, scene_id=f"straight_road_{num_vehicles}_{seed}")


def two_cars_head_on(speed: float = 8.0) -> Scene:
    """Two cars on one lane that drive at each other and overlap from the middle of the episode on."""
    scene = straight_road(num_vehicles=2, speed=speed)
    time = (torch.arange(LOG_STEPS) - CURRENT_STEP) * STEP_SECONDS
    poses = torch.zeros(2, LOG_STEPS, 3)
    poses[0, :, 0] = speed * time - 30
    poses[1, :, 0] = 30 - speed * time
    poses[1, :, 2] = torch.pi
    poses[..., 1] = -2.5
    agents = build_scene(poses, [(MapKind.EDGE_BOUNDARY, torch.zeros(2, 2))]).agents
    scene.agents = agents
    scene.scene_id = "two_cars_head_on"
    return scene


def red_light(speed: float = 8.0) -> Scene:
    """One car that drives through a light that is red all the time, 20 m ahead of it on a lane of its own."""
    scene = straight_road(num_vehicles=1, speed=speed)
    scene.lights = Lights(
        lane_id=torch.tensor([1]),
        state=torch.full((1, LOG_STEPS), int(LightState.STOP)),
        stop_point=torch.tensor([20.0, -2.5, 0.0]).expand(1, LOG_STEPS, 3).clone(),
        batch_size=[],
    )
    scene.scene_id = "red_light"
    return scene
