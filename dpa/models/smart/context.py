"""What SMART sees of a scene: short map pieces, and its agents."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorClass
from torch import Tensor

from dpa.models.pieces import cut_map, places_ahead
from envs.episode import Episode
from envs.scene import Scene

PIECE_POINTS = 3
"""Points that describe a piece."""
SLACK = 0.01
"""Of a cut [m]: pieces are of the length of a few points, where rounding would move cuts from one to the next."""


@dataclass(frozen=True)
class SmartContextOptions:
    """How a scene is cut up for SMART.

    Attributes:
        max_pieces: map pieces kept, those nearest to where any present agent is or may soon be.
        piece_length: target length of a map piece [m].

    Raises:
        ValueError: a number that is not positive.
    """

    max_pieces: int = 768
    piece_length: float = 5.0

    def __post_init__(self) -> None:
        for name in ("max_pieces", "piece_length"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}.")


class SmartContext(TensorClass["nocast"]):
    """Inputs of SMART for one scene, or for a padded batch of them (``*`` is nothing or ``S``).

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


def featurize(scene: Scene, episode: Episode, options: SmartContextOptions | None = None) -> SmartContext:
    """Cut up one uncollated scene.

    Examples:
        >>> from envs.episode import make_episode
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(2)
        >>> featurize(scene, make_episode(scene)).map_points.shape[1:]
        torch.Size([3, 2])
    """
    options = options or SmartContextOptions()
    places = places_ahead(scene.agents, episode.logged.shape[-2])
    cut = {"length": options.piece_length, "num_points": PIECE_POINTS, "most": options.max_pieces, "slack": SLACK}
    pieces = cut_map(scene.road, scene.lights, places, **cut)
    return SmartContext(
        episode=episode,
        map_pose=pieces.pose,
        map_points=pieces.points,
        map_kind=pieces.kind,
        map_light=pieces.light,
        map_valid=torch.ones(len(pieces.kind), dtype=torch.bool),
        batch_size=[],
    )
