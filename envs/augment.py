"""Augmentation of uncollated scenes: the same traffic mirrored, turned, or with some of its agents left out.

Every function gives a new scene of the same ``scene_id`` and leaves the one that it is given as it is. A mirrored or
rotated scene has axes of its own: ``origin`` still says which point of the recording its zero is, but ``position +
origin`` is no longer a position in the recording's world frame. Such scenes are for training; nothing that is made in
them may be written back in world coordinates, a challenge submission above all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from envs.geometry import frames
from envs.scene import EDGE_KINDS, LinkKind, Scene, select_agents


def mirror(scene: Scene) -> Scene:
    """The scene as seen in a mirror along x: left and right swap, right-hand traffic becomes left-hand traffic.

    Road edges are turned round, so that the drivable side stays on their left.

    Args:
        scene: an uncollated scene.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> mirror(scene).agents.position[0, 0, 1] == -scene.agents.position[0, 0, 1]
        tensor(True)
    """
    scene = scene.clone()
    agents, road, lights = scene.agents, scene.road, scene.lights
    for y in (agents.position[..., 1], agents.velocity[..., 1], road.points[..., 1], lights.stop_point[..., 1]):
        y.neg_()
    agents.heading.neg_()
    edges = torch.isin(road.kind, torch.tensor(EDGE_KINDS))
    for start, count in zip(road.start[edges].tolist(), road.count[edges].tolist(), strict=True):
        road.points[start : start + count] = road.points[start : start + count].flip(0)
    left, right = (road.links[:, 2] == kind for kind in (LinkKind.LEFT, LinkKind.RIGHT))
    road.links[left, 2], road.links[right, 2] = int(LinkKind.RIGHT), int(LinkKind.LEFT)
    return scene


def rotate(scene: Scene, angle: float) -> Scene:
    """The scene turned counter-clockwise about the zero of its frame; heights stay.

    Headings come back in ``(-pi, pi]``. What the format keeps at zero, invalid states and absent lights, stays there.

    Args:
        scene: an uncollated scene.
        angle: [rad].

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> agents = rotate(straight_road(2), math.pi / 2).agents
        >>> agents.velocity[0, 0].round(decimals=4), agents.heading[0, 0]
        (tensor([ 0., 10.]), tensor(1.5708))
    """
    scene = scene.clone()
    agents = scene.agents
    # In double precision, so that far points lose no more than one rounding to float32.
    turn = torch.tensor(angle, dtype=torch.float64)
    for vectors in (agents.position, agents.velocity, scene.road.points, scene.lights.stop_point):
        xy = vectors[..., :2]
        xy.copy_(frames.rotate(xy.double(), turn))
    heading = -frames.wrap_angle(-(agents.heading.double() + turn))
    agents.heading.copy_(torch.where(agents.valid, heading, agents.heading))
    return scene


def drop_agents(scene: Scene, drop: Tensor) -> Scene:
    """Leave agents out; the SDC and the tracks to predict stay, whatever is asked.

    Args:
        scene: an uncollated scene of A agents.
        drop: ``[A]`` bool, who is to go.

    Returns:
        The rest of the agents in their order; map and lights are shared with ``scene``.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(3)
        >>> scene.agents.predict[1] = False
        >>> drop_agents(scene, torch.tensor([True, True, True])).agents.track_id
        tensor([1, 3])
    """
    return select_agents(scene, ~drop | scene.agents.evaluated)


@dataclass(frozen=True)
class Change:
    """What was drawn for a scene.

    Attributes:
        mirrored: the scene is mirrored.
        angle: that it is turned by [rad].
        drop: ``[A]`` bool, who is left out unless it has to stay (:func:`drop_agents`).
    """

    mirrored: bool
    angle: float
    drop: Tensor

    @property
    def only_mirrors(self) -> bool:
        """Whether there is nothing beside the mirror: one of two variants of a scene, worth keeping."""
        return self.angle == 0 and not self.drop.any()

    def __call__(self, scene: Scene) -> Scene:
        """The changed scene; the one that is given stays as it is, and what does not change may be shared with it."""
        if self.drop.any():
            scene = drop_agents(scene, self.drop)
        if self.mirrored:
            scene = mirror(scene)
        return rotate(scene, self.angle) if self.angle else scene


@dataclass(frozen=True)
class Augmentation:
    """How scenes are changed at random, each time that they are shown; by default not at all.

    Every scene takes the same draws whatever is switched on, so that one option does not change what another does.

    Attributes:
        rotation: the scene is turned by an angle drawn evenly between minus and plus this [rad].
        mirror: probability of the mirror image.
        agent_drop: probability of each agent to be left out; see :func:`drop_agents` for those who stay.

    Raises:
        ValueError: a rotation outside ``[0, pi]`` or a probability outside ``[0, 1]``.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> augment = Augmentation(rotation=math.pi, mirror=0.5)
        >>> scene = straight_road(2)
        >>> first, again = (augment(scene, torch.Generator().manual_seed(0)) for _ in range(2))
        >>> torch.equal(first.agents.position, again.agents.position)
        True
    """

    rotation: float = 0.0
    mirror: float = 0.0
    agent_drop: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.rotation <= math.pi:
            raise ValueError(f"rotation must lie in [0, pi] rad, got {self.rotation}.")
        for name in ("mirror", "agent_drop"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is a probability and must lie in [0, 1], got {getattr(self, name)}.")

    def draw(self, num_agents: int, generator: torch.Generator) -> Change:
        """What happens to a scene of so many agents; ``generator`` is on the CPU."""
        turn, flip = torch.rand(2, generator=generator).tolist()
        drop = torch.rand(num_agents, generator=generator) < self.agent_drop
        return Change(flip < self.mirror, (2 * turn - 1) * self.rotation, drop)

    def __call__(self, scene: Scene, generator: torch.Generator) -> Scene:
        """One variant of an uncollated scene, as :meth:`draw` and :class:`Change` have it."""
        return self.draw(len(scene.agents.sdc), generator)(scene)
