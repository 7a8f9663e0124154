"""The metric is computed where the scene is, safety and rewards on the CPU: rollouts come over once."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from dpa.ranking import PreferenceDistance
from dpa.realism import RealismConfig, contributions, realism, realism_of, realism_of_groups
from dpa.realism.metric import RealismResult
from dpa.safety import safety
from envs.scene import Scene
from recipes.benchmark.pretended import DEVICE, Pretended
from recipes.benchmark.realism import noisy_log

AGENTS, ROLLOUTS = 5, 6
YEARS = ("2023", "2024", "2025")
SIZES = {"index", "bincount", "nonzero", "_unique2", "_local_scalar_dense", "_to_copy", "synchronize"}
"""What a metric on a device asks for: which agents, lines and samples count, and, at the end, the figures."""


@pytest.fixture
def case(scene: Callable[..., Scene]) -> tuple[Scene, Tensor]:
    made = scene(AGENTS)
    made.agents.predict[1:3] = True
    return made, noisy_log(made, ROLLOUTS)


def assert_same(got: RealismResult, want: RealismResult) -> None:
    assert got.as_dict() == pytest.approx(want.as_dict(), rel=1e-6, nan_ok=True)


@pytest.mark.parametrize("year", YEARS)
def test_rollouts_come_once_to_a_scene_on_the_cpu(year: str, case: tuple, there: Pretended) -> None:
    made, rollouts = case
    want, given = realism(made, rollouts, year), rollouts.to(DEVICE)
    there.reset()
    assert_same(realism(made, given, year), want)
    assert there.read_backs == {"_to_copy": 1} and not there.kernels


def test_groups_of_rollouts_come_once_too(case: tuple, there: Pretended) -> None:
    made, rollouts = case
    halves, given = torch.arange(ROLLOUTS).view(2, -1), rollouts.to(DEVICE)
    want = realism_of_groups(made, rollouts, halves)
    there.reset()
    for mine, theirs in zip(realism_of_groups(made, given, halves), want, strict=True):
        assert_same(mine, theirs)
    assert there.read_backs == {"_to_copy": 1}


@pytest.mark.parametrize("quirks", [True, False])
@pytest.mark.parametrize("year", YEARS)
def test_a_scene_on_a_device_is_scored_there(year: str, quirks: bool, case: tuple, there: Pretended) -> None:
    made, rollouts = case
    want, given = realism(made, rollouts, year, quirks=quirks), (made.to(DEVICE), rollouts.to(DEVICE))
    there.reset()
    assert_same(realism(*given, year, quirks=quirks), want)
    assert set(there.read_backs) <= SIZES


def test_scenes_on_a_device_are_scored_together(scene: Callable[..., Scene], there: Pretended) -> None:
    scenes = [scene(count, seed=count) for count in (3, 5)]
    rollouts = [noisy_log(each, ROLLOUTS) for each in scenes]
    want = realism_of(scenes, rollouts, "2025")
    got = realism_of([each.to(DEVICE) for each in scenes], [each.to(DEVICE) for each in rollouts], "2025")
    for mine, theirs in zip(got, want, strict=True):
        assert_same(mine, theirs)


def test_what_each_agent_adds_is_told_on_the_device(case: tuple, there: Pretended) -> None:
    made, rollouts = case
    config = RealismConfig.load("2024")
    want = contributions(realism(made, rollouts, config, features=True).features, config)
    on_device = realism(made.to(DEVICE), rollouts.to(DEVICE), config, features=True).features
    torch.testing.assert_close(contributions(on_device, config).cpu(), want, rtol=0, atol=1e-6)


def test_what_is_unsafe_is_looked_for_on_the_cpu(case: tuple, there: Pretended) -> None:
    made, rollouts = case
    controlled = torch.ones(AGENTS, dtype=torch.bool)
    want, given = safety(made, rollouts, controlled), (rollouts.to(DEVICE), controlled.to(DEVICE))
    there.reset()
    assert safety(made, *given) == want
    assert there.read_backs == {"_to_copy": 2} and not there.kernels


def test_a_rankings_scene_stays_on_the_cpu_and_rollouts_anywhere(case: tuple, there: Pretended) -> None:
    made, rollouts = case
    on_device = PreferenceDistance(method="sinkhorn", stride=5)(made, rollouts.to(DEVICE))
    assert on_device.distance.device.type == DEVICE


if __name__ == "__main__":
    pytest.main([__file__])
