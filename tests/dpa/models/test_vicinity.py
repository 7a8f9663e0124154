"""Vicinity: the nearest things, seen from each node."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from dpa.models.vicinity import SCALE, Vicinity
from envs.geometry.frames import to_local, to_world

WIDTH = 16


@pytest.fixture(autouse=True)
def _no_gradients() -> None:
    with torch.no_grad():
        yield


def make_vicinity(nearest: int = 3) -> Vicinity:
    torch.manual_seed(0)
    return Vicinity(WIDTH, nearest)


def surroundings(nodes: int = 4, tokens: int = 9, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Poses of nodes, tokens with poses, and a mask that hides some tokens from some nodes."""
    generator = torch.Generator().manual_seed(seed)
    scale = torch.tensor([20.0, 20.0, 2.0])
    pose = torch.randn(2, nodes, 3, generator=generator) * scale
    token_pose = torch.randn(2, tokens, 3, generator=generator) * scale
    mask = torch.rand(2, nodes, tokens, generator=generator) > 0.3
    return pose, torch.randn(2, tokens, WIDTH, generator=generator), token_pose, mask


def by_hand(vicinity: Vicinity, pose: Tensor, tokens: Tensor, token_pose: Tensor, mask: Tensor) -> Tensor:
    """One node ``[3]``: every token one by one, the nearest of those it may see, their maximum."""
    seen = []
    for token, at, visible in zip(tokens, token_pose, mask.tolist(), strict=True):
        x, y, heading = to_local(at, pose).tolist()
        distance = (x**2 + y**2) ** 0.5
        features = torch.tensor([x / SCALE, y / SCALE, math.cos(heading), math.sin(heading), distance / SCALE])
        if visible:
            seen.append((distance, vicinity.inner(vicinity.token(token) + vicinity.relative(features))))
    nearest = [value for _, value in sorted(seen, key=lambda pair: pair[0])[: vicinity.nearest]]
    return vicinity.out(torch.stack(nearest).amax(0) if nearest else torch.zeros(WIDTH))


@pytest.mark.parametrize("nearest", [1, 3, 20])
def test_it_is_the_maximum_over_the_nearest_tokens_that_may_be_seen(nearest: int) -> None:
    vicinity, (pose, tokens, token_pose, mask) = make_vicinity(nearest), surroundings()
    mask[0, 1] = False
    pooled = vicinity(pose, tokens, token_pose, mask)
    for row in range(2):
        for node in range(4):
            expected = by_hand(vicinity, pose[row, node], tokens[row], token_pose[row], mask[row, node])
            torch.testing.assert_close(pooled[row, node], expected, atol=1e-4, rtol=1e-4)


def test_it_does_not_change_when_the_scene_is_moved_and_turned() -> None:
    vicinity, (pose, tokens, token_pose, mask) = make_vicinity(), surroundings()
    motion = torch.tensor([150.0, -80.0, 2.0])
    there = vicinity(to_world(pose, motion), tokens, to_world(token_pose, motion), mask)
    torch.testing.assert_close(there, vicinity(pose, tokens, token_pose, mask), atol=1e-4, rtol=1e-4)


def test_what_is_hidden_or_far_changes_nothing() -> None:
    vicinity, (pose, tokens, token_pose, mask) = make_vicinity(3), surroundings()
    near = (pose[:, :, None, :2] - token_pose[:, None, :, :2]).norm(dim=-1).masked_fill(~mask, torch.inf)
    used = torch.zeros_like(mask).scatter(-1, near.argsort(-1)[..., :3], True).any(1) & mask.any(1)
    spoiled = tokens.where(used[..., None], torch.full((), 1e6))
    assert (~used).any()
    assert torch.equal(vicinity(pose, spoiled, token_pose, mask), vicinity(pose, tokens, token_pose, mask))


def test_a_node_may_be_alone() -> None:
    vicinity, (pose, tokens, token_pose, mask) = make_vicinity(), surroundings()
    empty = vicinity(pose, tokens, token_pose, torch.zeros_like(mask))
    assert torch.equal(empty, vicinity.out.bias.expand_as(empty))


if __name__ == "__main__":
    pytest.main([__file__])
