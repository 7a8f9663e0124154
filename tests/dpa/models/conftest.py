"""Scenes, models and rigid motions for the tests of the policy."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from dpa.models.motionlm import MotionLM, MotionLMConfig
from dpa.tokens import VerletTokenizer
from envs.geometry.frames import rotate, to_world
from envs.scene import AgentKind, Lights, LightState, MapKind, Scene
from envs.sources.synthetic import build_scene

TINY = MotionLMConfig(width=24, heads=2, feed=48, encoder_layers=1, decoder_layers=2)


def lively_scene(num_agents: int = 3, seed: int = 0, leave: bool = True) -> Scene:
    """Agents of all classes on curves of their own, a crossing with a light, and logs that begin and end."""
    generator = torch.Generator().manual_seed(seed)
    turn = 0.4 * (torch.rand(num_agents, 1, generator=generator) - 0.5)
    speed = 1 + 8 * torch.rand(num_agents, 1, generator=generator)
    heading = 6 * torch.rand(num_agents, 1, generator=generator) - 3 + turn * torch.arange(91) * 0.1
    moves = 0.1 * speed[..., None] * torch.stack((heading.cos(), heading.sin()), -1)
    xy = moves.cumsum(1) + 15 * torch.randn(num_agents, 1, 2, generator=generator)
    valid = torch.ones(num_agents, 91, dtype=torch.bool)
    if leave:
        valid[-1, 40:60] = False
        valid[0, :4] = False
    along = torch.linspace(-60, 60, 41)
    lines = [
        (MapKind.LANE_SURFACE_STREET, torch.stack((along, 0.1 * along), -1)),
        (MapKind.LANE_SURFACE_STREET, torch.stack((0.2 * along, along), -1)),
        (MapKind.EDGE_BOUNDARY, torch.stack((along, 0.1 * along - 5), -1)),
        (MapKind.CROSSWALK, torch.randn(4, 2, generator=generator)),
    ]
    lights = Lights(
        lane_id=torch.tensor([1]),
        state=torch.randint(int(LightState.STOP), int(LightState.GO) + 1, (1, 91), generator=generator),
        stop_point=torch.tensor([-6.0, -0.6, 0.0]).expand(1, 91, 3).clone(),
        batch_size=[],
    )
    kind = torch.tensor([AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST]).repeat(num_agents)[:num_agents]
    poses = torch.cat((xy, heading[..., None]), -1)
    return build_scene(poses, lines, valid=valid, kind=kind, lights=lights, scene_id=f"lively_{num_agents}_{seed}")


def with_arrivals(scene: Scene, first_steps: dict[int, int]) -> Scene:
    """The scene with some agents' logs beginning at later steps."""
    for agent, step in first_steps.items():
        for name in ("position", "heading", "velocity", "valid"):
            getattr(scene.agents, name)[agent, :step] = 0
    scene.agents.predict[1::3] = False
    return scene


def moved(scene: Scene, motion: Tensor) -> Scene:
    """The same scene somewhere else, turned: ``motion`` is the pose at which its origin ends up."""
    scene = scene.clone()
    agents = scene.agents
    poses = to_world(agents.poses, motion) * agents.valid[..., None]
    agents.position[..., :2], agents.heading[:] = poses[..., :2], poses[..., 2]
    agents.velocity[:] = rotate(agents.velocity, motion[2].expand(agents.velocity.shape[:-1]))
    for points in (scene.road.points, scene.lights.stop_point):
        points[..., :2] = rotate(points[..., :2], motion[2].expand(points.shape[:-1])) + motion[:2]
    return scene


def shake(model: nn.Module, seed: int = 0) -> None:
    """Give every parameter a value of its own: what starts at zero (the gaze) would hide mistakes."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))


def tiny_model(config: MotionLMConfig = TINY) -> MotionLM:
    torch.manual_seed(0)
    model = MotionLM(config, VerletTokenizer()).eval()
    shake(model)
    return model


@pytest.fixture
def model() -> MotionLM:
    """A small model whose parameters are all non-zero."""
    return tiny_model()


@pytest.fixture
def scene() -> Callable[..., Scene]:
    """Makes :func:`lively_scene`."""
    return lively_scene


@pytest.fixture
def arriving() -> list[Scene]:
    """Of different sizes, some with agents that come in the middle of a decision, at its end, or never in time."""
    return [
        with_arrivals(lively_scene(5, seed=1, leave=False), {1: 23, 3: 15}),
        lively_scene(2, seed=2),
        with_arrivals(lively_scene(6, seed=3), {2: 11, 4: 88}),
    ]


@pytest.fixture
def move() -> Callable[[Scene, Tensor], Scene]:
    """Makes :func:`moved` scenes."""
    return moved
