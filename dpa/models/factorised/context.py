"""What a policy of neighbourhoods sees of a scene: short map pieces, and its agents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from tensordict import TensorClass
from torch import Tensor

from dpa.models.pieces import PieceOptions, cut_map
from envs.episode import Episode
from envs.scene import Scene

PIECE_POINTS = 3
"""Points that describe a piece."""


@dataclass(frozen=True)
class NeighbourhoodOptions(PieceOptions):
    """How a scene is cut up: into short pieces."""

    max_pieces: int = 768
    piece_length: float = 5.0


class NeighbourhoodContext(TensorClass["nocast"]):
    """Inputs of a policy for one scene, or for a padded batch of them (``*`` is nothing or ``S``).

    Attributes:
        episode: its agents.
        map_pose: ``[*, P, 3]`` middle of a piece, heading along it.
        map_points: ``[*, P, PIECE_POINTS, 2]`` in the frame of the piece [m].
        map_kind: ``[*, P]`` :class:`~envs.scene.MapKind`.
        map_light: ``[*, P]`` light state of the piece's lane at the current step, plus one (0: none).
        map_valid: ``[*, P]`` bool.
    """

    of_agents: ClassVar[tuple[str, ...]] = ()
    episode: Episode
    map_pose: Tensor
    map_points: Tensor
    map_kind: Tensor
    map_light: Tensor
    map_valid: Tensor


def featurize(scene: Scene, episode: Episode, options: NeighbourhoodOptions | None = None) -> NeighbourhoodContext:
    """Cut up one uncollated scene.

    Examples:
        >>> from envs.episode import make_episode
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> featurize(scene, make_episode(scene)).map_points.shape[1:]
        torch.Size([3, 2])
    """
    options = options or NeighbourhoodOptions()
    pieces = cut_map(scene, episode.logged.shape[-2], options, PIECE_POINTS, evenly=True)
    return NeighbourhoodContext(
        episode=episode,
        **{f"map_{name}": value for name, value in pieces._asdict().items()},
        batch_size=[],
    )
