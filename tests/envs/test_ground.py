"""Height of the road under moving agents."""

from __future__ import annotations

import pytest
import torch

from envs.geometry.ground import Ground, lift

TIME = torch.arange(1, 81) * 0.1
CENTRE = 0.75
"""Height of a car's centre above the road [m]."""


def slope_and_bridge() -> torch.Tensor:
    """A road along x that climbs by 10 %, and a level bridge across it, 6 m above its foot."""
    along, across = torch.linspace(-50, 150, 401), torch.linspace(-50, 50, 201)
    road = torch.stack((along, torch.zeros_like(along), 0.1 * along.clamp(min=0)), -1)
    bridge = torch.stack((torch.full_like(across, 5.0), across, torch.full_like(across, 6.0)), -1)
    return torch.cat((road, bridge))


def test_an_agent_climbs_the_road_and_passes_under_the_bridge() -> None:
    poses = torch.zeros(1, 1, 80, 3)
    poses[..., 0] = 10 * TIME
    lifted = lift(poses, torch.tensor([[0.0, 0, CENTRE]]), slope_and_bridge())[0, 0]
    torch.testing.assert_close(lifted[:, 2], CENTRE + 0.1 * lifted[:, 0], atol=0.2, rtol=0)


def test_an_agent_on_the_bridge_stays_on_it() -> None:
    poses = torch.zeros(1, 1, 80, 3)
    poses[..., 0], poses[..., 1] = 5.0, 4 * TIME
    lifted = lift(poses, torch.tensor([[5.0, 0, 6 + CENTRE]]), slope_and_bridge())
    assert lifted[..., 2].unique().tolist() == [6 + CENTRE]


def test_an_agent_that_stands_keeps_its_height() -> None:
    lifted = lift(torch.zeros(2, 1, 80, 3), torch.tensor([[0.0, 0, 1.5]]), slope_and_bridge())
    assert lifted[..., 2].unique().tolist() == [1.5]


@pytest.mark.parametrize("steps", [1, 5, 7, 80])
def test_place_and_heading_pass_through_for_any_number_of_steps(steps: int) -> None:
    poses = torch.randn(4, 2, steps, 3, generator=torch.Generator().manual_seed(0))
    lifted = lift(poses, torch.zeros(2, 3), torch.zeros(3, 3))
    assert torch.equal(lifted[..., [0, 1, 3]], poses)
    assert (lifted[..., 2] == 0).all()


def test_bad_input_is_refused() -> None:
    poses = torch.zeros(1, 3, 5, 3)
    with pytest.raises(ValueError, match="starts of 2"):
        lift(poses, torch.zeros(2, 3), torch.zeros(3, 3))
    poses[0, 1, 2, 0] = torch.nan
    with pytest.raises(ValueError, match="agent 1 is not finite"):
        lift(poses, torch.zeros(3, 3), torch.zeros(3, 3))
    with pytest.raises(ValueError, match="no point"):
        Ground(torch.empty(0, 3))
