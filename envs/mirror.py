"""The mirror image of an uncollated scene: the same traffic on the other side of the road.

A mirrored scene keeps its ``scene_id`` and has axes of its own: ``origin`` still says which point of the recording its
zero is, but ``position + origin`` is no longer a position in the recording's world frame. Such scenes are for training;
nothing that is made in them may be written back in world coordinates, a challenge submission above all.
"""

from __future__ import annotations

import torch

from envs.scene import EDGE_KINDS, LinkKind, Scene


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
