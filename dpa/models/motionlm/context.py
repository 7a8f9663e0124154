"""What MotionLM sees of a scene: map pieces and lights, and its agents' histories, each in a frame of its own.

Long polylines are cut into pieces of about ten metres. A piece, a light or an agent is a pose plus features measured
from that pose, so nothing here depends on where the scene lies or how it is turned (but for which of the farthest
pieces are seen, where there are more than ``max_pieces``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorClass
from torch import Tensor

from dpa.models.pieces import cut_map, light_poses, places_ahead
from envs.episode import HISTORY, Episode
from envs.scene import CURRENT_STEP, LightState, Scene

PIECE_POINTS = 5
"""Points that describe a piece."""
POSITION_SCALE = 10.0
"""Metres that count as one in a feature."""
NUM_LIGHT_STATES = len(LightState)


@dataclass(frozen=True)
class ContextOptions:
    """How a scene is cut up for MotionLM.

    Attributes:
        max_pieces: map pieces kept, those nearest to where any present agent is or may soon be.
        piece_length: target length of a map piece [m].

    Raises:
        ValueError: a number that is not positive.
    """

    max_pieces: int = 512
    piece_length: float = 12.0

    def __post_init__(self) -> None:
        for name in ("max_pieces", "piece_length"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}.")


class SceneContext(TensorClass["nocast"]):
    """Inputs of MotionLM for one scene, or for a padded batch of them (``*`` is nothing or ``S``).

    Attributes:
        episode: its agents.
        map_pose: ``[*, P, 3]`` middle of a piece, heading along it.
        map_points: ``[*, P, PIECE_POINTS, 2]`` in the frame of the piece [m].
        map_kind: ``[*, P]`` :class:`~envs.scene.MapKind`.
        map_light: ``[*, P]`` light state of the piece's lane at the current step, plus one (0: none).
        map_valid: ``[*, P]`` bool.
        light_pose: ``[*, G, 3]`` stop point, heading of the lane.
        light_state: ``[*, G, HISTORY]`` :class:`~envs.scene.LightState` plus one.
        light_valid: ``[*, G]`` bool.
    """

    of_agents: ClassVar[tuple[str, ...]] = ()
    episode: Episode
    map_pose: Tensor
    map_points: Tensor
    map_kind: Tensor
    map_light: Tensor
    map_valid: Tensor
    light_pose: Tensor
    light_state: Tensor
    light_valid: Tensor


def featurize(scene: Scene, episode: Episode, options: ContextOptions | None = None) -> SceneContext:
    """Cut up one uncollated scene.

    Examples:
        >>> from envs.episode import make_episode
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> featurize(scene, make_episode(scene)).map_points.shape[1:]
        torch.Size([5, 2])
    """
    options = options or ContextOptions()
    cut = {"length": options.piece_length, "num_points": PIECE_POINTS, "most": options.max_pieces}
    pieces = cut_map(scene.road, scene.lights, places_ahead(scene.agents, episode.logged.shape[-2]), **cut)
    return SceneContext(
        episode=episode,
        map_pose=pieces.pose,
        map_points=pieces.points,
        map_kind=pieces.kind,
        map_light=pieces.light,
        map_valid=torch.ones(len(pieces.kind), dtype=torch.bool),
        light_pose=light_poses(scene.road, scene.lights),
        light_state=scene.lights.state[:, :HISTORY] + 1,
        light_valid=scene.lights.state[:, CURRENT_STEP] != LightState.ABSENT,
        batch_size=[],
    )
