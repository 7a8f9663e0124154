"""What the scene encoder reads: map pieces and lights, and agents' histories, each in a frame of its own.

Long polylines are cut into pieces of about ten metres. A piece, a light or an agent is a pose plus features measured
from that pose, so nothing here depends on where the scene lies or how it is turned (but for which of the farthest
pieces are seen, where there are more than ``max_pieces``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from tensordict import TensorClass
from torch import Tensor

from dpa.models.pieces import PieceOptions, cut_map, light_poses
from envs.episode import HISTORY, Episode
from envs.scene import CURRENT_STEP, LightState, Scene

PIECE_POINTS = 5
"""Points that describe a piece."""
POSITION_SCALE = 10.0
"""Metres that count as one in a feature."""


@dataclass(frozen=True)
class ContextOptions(PieceOptions):
    """How a scene is cut up for the encoder."""

    max_pieces: int = 512
    piece_length: float = 12.0


class SceneContext(TensorClass["nocast"]):
    """Inputs of a :class:`~dpa.models.encoder.SceneEncoder`: one scene, or a padded batch (``*`` is nothing or ``S``).

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
    pieces = cut_map(scene, episode.logged.shape[-2], options, PIECE_POINTS)
    return SceneContext(
        episode=episode,
        **{f"map_{name}": value for name, value in pieces._asdict().items()},
        light_pose=light_poses(scene.road, scene.lights),
        light_state=scene.lights.state[:, :HISTORY] + 1,
        light_valid=scene.lights.state[:, CURRENT_STEP] != LightState.ABSENT,
        batch_size=[],
    )
