"""Pieces of equal length, against shapely."""

from __future__ import annotations

import math

import numpy as np
import shapely
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpa.models.pieces import PieceOptions, Pieces, cut_map
from envs.geometry.frames import to_world
from envs.scene import MapKind, Scene
from envs.sources.synthetic import build_scene, straight_road

LANE = MapKind.LANE_SURFACE_STREET


def pieces_of(scene: Scene, length: float = 5.0) -> Pieces:
    return cut_map(scene, 80, PieceOptions(max_pieces=10_000, piece_length=length), 3, evenly=True)


def places_of(pieces: Pieces) -> torch.Tensor:
    """``[P, 3, 2]`` in the scene's frame."""
    points = torch.cat((pieces.points, torch.zeros_like(pieces.points[..., :1])), -1)
    return to_world(points, pieces.pose[:, None])[..., :2]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.floats(0.0, 30.0), st.floats(-2.0, 2.0)), min_size=1, max_size=8), st.floats(2.0, 15.0))
def test_their_points_lie_at_equal_distances_along_the_line(moves: list[tuple[float, float]], length: float) -> None:
    heading = np.cumsum([turn for _, turn in moves])
    ways = np.array([way for way, _ in moves])[:, None] * np.stack((np.cos(heading), np.sin(heading)), -1)
    line = np.concatenate((np.zeros((1, 2)), np.cumsum(ways, 0)))
    pieces = pieces_of(build_scene(torch.zeros(1, 91, 3), [(LANE, torch.tensor(line, dtype=torch.float32))]), length)
    count = max(1, math.ceil(shapely.LineString(line).length / length - 1e-3))
    assert len(pieces.pose) == count
    at = (np.arange(count)[:, None] + np.array([0.0, 0.5, 1.0])) / count
    expected = shapely.line_interpolate_point(shapely.LineString(line), at, normalized=True)
    np.testing.assert_allclose(
        places_of(pieces).numpy(), shapely.get_coordinates(expected).reshape(count, 3, 2), atol=2e-3
    )


def test_a_line_with_few_points_has_no_piece_without_a_length() -> None:
    """Points of this road lie 10 m apart."""
    pieces = pieces_of(straight_road(1))
    assert (pieces.points[:, -1] - pieces.points[:, 0]).norm(dim=-1).min() > 4


def test_a_single_point_is_a_piece() -> None:
    sign = (MapKind.STOP_SIGN, torch.tensor([[3.0, 4.0]]))
    pieces = pieces_of(build_scene(torch.zeros(1, 91, 3), [(LANE, torch.tensor([[0.0, 0.0], [4.0, 0.0]])), sign]))
    assert pieces.kind.tolist() == [LANE, MapKind.STOP_SIGN]
    assert places_of(pieces)[1].tolist() == [[3.0, 4.0]] * 3
