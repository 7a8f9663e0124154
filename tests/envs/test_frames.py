"""Angles and frames: against the matrices that they stand for."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from envs.geometry.frames import rotate, to_local, to_world, wrap_angle

FEW = settings(max_examples=50, deadline=None)
angles = st.floats(-50.0, 50.0)
poses = st.tuples(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0), st.floats(-math.pi, math.pi))


def tensor(pose: tuple[float, ...]) -> Tensor:
    return torch.tensor(pose, dtype=torch.float64)


def matrix(pose: Tensor) -> Tensor:
    """The 3 x 3 matrix that takes points of the pose's own frame to the world."""
    x, y, heading = pose.tolist()
    cos, sin = math.cos(heading), math.sin(heading)
    return torch.tensor([[cos, -sin, x], [sin, cos, y], [0.0, 0.0, 1.0]], dtype=torch.float64)


@FEW
@given(angles)
def test_a_wrapped_angle_points_the_same_way_and_lies_in_one_turn(angle: float) -> None:
    wrapped = wrap_angle(tensor((angle,)))
    assert -math.pi <= wrapped.item() <= math.pi  # the upper end by rounding only
    assert math.isclose(math.cos(wrapped.item()), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped.item()), math.sin(angle), abs_tol=1e-9)


def test_half_a_turn_wraps_to_the_negative_side() -> None:
    assert wrap_angle(tensor((math.pi,))).item() == -math.pi


@FEW
@given(st.floats(-9, 9), st.floats(-9, 9), angles)
def test_rotating_is_multiplying_by_the_rotation_matrix(x: float, y: float, angle: float) -> None:
    expected = matrix(tensor((0.0, 0.0, angle)))[:2, :2] @ tensor((x, y))
    torch.testing.assert_close(rotate(tensor((x, y)), tensor((angle,))[0]), expected)


@FEW
@given(poses, poses)
def test_to_world_composes_frames_as_matrices_do(pose: tuple, frame: tuple) -> None:
    world = to_world(tensor(pose), tensor(frame))
    torch.testing.assert_close(matrix(world), matrix(tensor(frame)) @ matrix(tensor(pose)))


@FEW
@given(poses, poses)
def test_to_local_undoes_to_world(pose: tuple, frame: tuple) -> None:
    there_and_back = to_local(to_world(tensor(pose), tensor(frame)), tensor(frame))
    torch.testing.assert_close(matrix(there_and_back), matrix(tensor(pose)), rtol=0, atol=1e-9)


def test_frames_are_broadcast_against_poses() -> None:
    many, frames = torch.randn(2, 1, 4, 3), torch.randn(5, 1, 3)
    local = to_local(many, frames)
    assert local.shape == (2, 5, 4, 3)
    torch.testing.assert_close(local[1, 3, 2], to_local(many[1, 0, 2], frames[3, 0]))


if __name__ == "__main__":
    pytest.main([__file__])
