"""Vocabularies of a grid."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dpa.tokens.grids import LENGTH, MAJORITY, grid
from dpa.tokens.vocabulary import logged_motions, smallest_radius
from envs.scene import AgentKind
from envs.sources.synthetic import straight_road

VEHICLE = AgentKind.VEHICLE
MOTIONS = logged_motions([straight_road(8, seed=seed) for seed in range(12)], steps=5)[VEHICLE]
MIRROR = torch.tensor([1.0, -1.0, -1.0])


def bends(count: int, seed: int) -> Tensor:
    """``[n, 5, 3]`` motions along curves."""
    drawn = torch.rand(count, 2, generator=torch.Generator().manual_seed(seed))
    heading = (drawn[:, :1] - 0.5) * torch.linspace(0.2, 1, 5)
    moves = 1.5 * drawn[:, 1:, None] * torch.stack((heading.cos(), heading.sin()), -1)
    return torch.cat((moves.cumsum(1), heading[..., None]), -1)


def cell_of(motions: Tensor, width: float) -> list[tuple[float, float]]:
    """Which cell each motion ends in, by hand."""
    return [(round(x / (LENGTH * width)), round(y / width)) for x, y in motions[:, -1, :2].tolist()]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 99), st.floats(0.1, 0.8))
def test_every_motion_and_its_mirror_image_has_an_entry_in_its_cell_which_is_their_mean(
    seed: int, width: float
) -> None:
    motions = bends(60, seed)
    both = torch.cat((motions, motions * MIRROR))
    entries, cells = grid(motions, 10_000, width), cell_of(both, width)
    held = dict(zip(cell_of(entries, width), entries, strict=True))
    assert len(held) == len(entries), "one for each cell"
    for cell in set(cells) - {(0, 0)}:
        own = both[[each == cell for each in cells]]
        turn = torch.atan2(own[..., 2].sin().mean(0), own[..., 2].cos().mean(0))
        expected = torch.cat((own[..., :2].mean(0), turn[:, None]), -1)
        torch.testing.assert_close(held[cell], expected, atol=1e-5, rtol=1e-5)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 99), st.floats(0.1, 0.8))
def test_an_entry_without_a_motion_ends_in_the_middle_of_a_cell_beside_three_that_have_one(
    seed: int, width: float
) -> None:
    motions = bends(60, seed)
    full = {(0, 0), *cell_of(torch.cat((motions, motions * MIRROR)), width)}
    entries = grid(motions, 10_000, width)
    side = torch.tensor([LENGTH * width, width])
    for (row, column), entry in zip(cell_of(entries, width), entries, strict=True):
        if (row, column) not in full:
            around = [(row + i, column + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
            assert sum(each in full for each in around) >= MAJORITY
            torch.testing.assert_close(entry[-1, :2], torch.tensor([row, column]) * side, atol=1e-4, rtol=0)


def test_standing_still_comes_first_and_the_fullest_cells_are_kept() -> None:
    motions = torch.tensor([3.0] * 5 + [9.0] * 2 + [15.0])[:, None, None] * torch.tensor([1.0, 0.0, 0.0]).expand(
        1, 5, 3
    )
    entries = grid(motions, 3, 1.0)
    assert not entries[0].any() and entries[1:, -1, 0].tolist() == [3.0, 9.0]


def test_the_smallest_radius_fills_the_vocabulary() -> None:
    radius = smallest_radius("grid", MOTIONS, VEHICLE, 40, seed=0)
    assert len(grid(MOTIONS, 99, 2 * radius)) <= 40 < len(grid(MOTIONS, 99, 2 * 0.8 * radius))
