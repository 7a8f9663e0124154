"""Rollouts are ranked where they are, or come over once; features, cost and Sinkhorn are those of the CPU."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

from dpa.ranking import AGGREGATES, FEATURES, DisplacementDistance, Distance, PreferenceDistance, occupancy_features
from dpa.ranking.transform import RankRollouts
from dpa.ranking.transport.sinkhorn import CHECK_EVERY, Sinkhorn
from dpa.rewards import REWARDS, RealismRanking, RewardRollouts
from dpa.tokens import TokenAction, VerletTokenizer
from envs import keys
from envs.scene import Scene
from envs.traffic import TrafficEnv
from recipes.benchmark.pretended import DEVICE, Pretended
from recipes.benchmark.realism import noisy_log

FREE = sorted(set(FEATURES) - {"red_light"})
"""Features that wait for nobody; that of red lights asks which vehicles pass one."""
AGENTS, ROLLOUTS = 5, 6


@pytest.fixture
def case(scene: Callable[..., Scene]) -> tuple[Scene, Tensor, Tensor]:
    """A scene, rollouts beside its log, and whom the policy moves."""
    made = scene(AGENTS)
    return made, noisy_log(made, ROLLOUTS), torch.tensor([True, True, False, True, True])


@pytest.mark.parametrize("names", [*([name] for name in FREE), FREE], ids=str)
@pytest.mark.parametrize("stride", [1, 5])
def test_features_are_those_of_the_cpu_and_nobody_waits_for_them(
    names: list[str], stride: int, case: tuple, there: Pretended
) -> None:
    made, rollouts, _ = case
    want, want_valid = occupancy_features(made, rollouts, names, ego=torch.tensor([3, 0]), stride=stride)
    given = rollouts.to(DEVICE)
    there.reset()
    phi, valid = occupancy_features(made, given, names, ego=torch.tensor([3, 0]), stride=stride)
    assert not there.read_backs
    assert torch.equal(phi.cpu(), want) and torch.equal(valid.cpu(), want_valid)


def test_who_passes_a_red_light_is_asked_for(case: tuple, there: Pretended) -> None:
    made, rollouts, _ = case
    want = occupancy_features(made, rollouts, ["red_light"])[0]
    assert torch.equal(occupancy_features(made, rollouts.to(DEVICE), ["red_light"])[0].cpu(), want)
    assert there.read_backs


LOOKS = "_local_scalar_dense"
DISTANCES: dict[str, Distance] = {
    **{f"sinkhorn, {how}": PreferenceDistance(method="sinkhorn", aggregate=how, stride=5) for how in AGGREGATES},
    "sinkhorn, 10 Hz": PreferenceDistance(method="sinkhorn"),
    "sinkhorn, evaluated": PreferenceDistance(method="sinkhorn", agents="evaluated", stride=5),
    "average displacement": DisplacementDistance(),
    "final displacement": DisplacementDistance(measure="final", aggregate="mean_rank"),
}


@pytest.mark.parametrize("distance", DISTANCES.values(), ids=DISTANCES)
def test_a_ranking_on_the_device_is_that_of_the_cpu_and_reads_back_no_more_than_when_to_stop(
    distance: Distance, case: tuple, there: Pretended
) -> None:
    made, rollouts, controlled = case
    assert distance.on_device
    want, given = distance(made, rollouts, controlled), rollouts.to(DEVICE)
    there.reset()
    got = distance(made, given, controlled)
    assert set(there.read_backs) <= {LOOKS}
    assert there.read_backs[LOOKS] <= Sinkhorn().iterations / CHECK_EVERY
    for mine, theirs in zip(got, want, strict=True):
        assert mine.device.type == DEVICE and torch.equal(mine.cpu(), theirs)


def test_what_a_coupling_pays_is_told_on_the_device(case: tuple, there: Pretended) -> None:
    made, rollouts, controlled = case
    distance, ego = PreferenceDistance(method="sinkhorn", stride=5), controlled.nonzero()[:, 0]
    want = distance.couple(made, rollouts, ego).paid
    assert torch.equal(distance.couple(made, rollouts.to(DEVICE), ego).paid.cpu(), want)


def test_a_scene_that_ranks_nobody_does_so_on_the_device(case: tuple, there: Pretended) -> None:
    made, rollouts, controlled = case
    got = PreferenceDistance(method="sinkhorn")(made, rollouts.to(DEVICE), torch.zeros_like(controlled))
    assert all(value.device.type == DEVICE and not value.cpu().any() for value in got)


def test_exact_solvers_bring_features_over_once_and_couplings_back(case: tuple, there: Pretended) -> None:
    made, rollouts, controlled = case
    distance = PreferenceDistance(stride=5)
    assert not distance.on_device
    want, given = distance(made, rollouts, controlled), rollouts.to(DEVICE)
    there.reset()
    got = distance(made, given, controlled)
    assert there.read_backs == {"_to_copy": 4}  # both sides and their masks
    assert all(torch.equal(mine.cpu(), theirs) for mine, theirs in zip(got, want, strict=True))


def collected(scenes: list[Scene], device: str) -> TensorDict:
    """Rollouts as a collector gives them."""
    env = TrafficEnv(scenes, num_scenes=len(scenes), num_rollouts=ROLLOUTS, device=device)
    env = TransformedEnv(env, TokenAction(VerletTokenizer()))
    state, taken, generator = env.reset(), [], torch.Generator().manual_seed(0)
    for _ in range(16):
        drawn = torch.randint(80, 89, state[keys.KIND].shape, generator=generator)
        state[keys.TOKEN] = drawn.to(device)
        state[keys.SAMPLING_LOG_PROB] = drawn.to(device).float()
        whole = env.step(state)
        taken.append(whole.clone(False))
        state = whole["next"].exclude(keys.REWARD)
    return torch.stack(taken, 1)


FACTS = 3  # scene, step and who is controlled
TRANSFORMS: dict[str, tuple[Callable[[list[Scene]], RankRollouts], int]] = {
    "sinkhorn": (lambda scenes: RankRollouts(scenes, ROLLOUTS, PreferenceDistance(method="sinkhorn", stride=5)), FACTS),
    "displacement": (lambda scenes: RankRollouts(scenes, ROLLOUTS, DisplacementDistance()), FACTS),
    "exact": (lambda scenes: RankRollouts(scenes, ROLLOUTS, PreferenceDistance(stride=5)), FACTS + 1),
    "realism": (lambda scenes: RankRollouts(scenes, ROLLOUTS, RealismRanking()), FACTS + 1),
    "rewards": (
        lambda scenes: RewardRollouts(scenes, ROLLOUTS, PreferenceDistance(method="sinkhorn", stride=5), REWARDS),
        FACTS + 1,
    ),
}
"""How rollouts are ranked, and what comes over: facts about groups, and poses where the CPU ranks them."""


@pytest.mark.parametrize(("make", "copies"), TRANSFORMS.values(), ids=TRANSFORMS)
def test_rollouts_come_over_once_before_they_are_ranked(
    make: Callable, copies: int, scene: Callable[..., Scene], there: Pretended
) -> None:
    scenes = [scene(4, seed=0), scene(3, seed=1)]
    want, given = make(scenes)(collected(scenes, "cpu")), collected(scenes, DEVICE)
    there.reset()
    got = make(scenes)(given)
    # TensorDict waits twice: for all that has come over, and for all that goes back.
    assert {**there.read_backs, LOOKS: 0} == {"_to_copy": copies, "synchronize": 2, LOOKS: 0}
    assert bool(there.read_backs[LOOKS]) == bool(there.kernels["logsumexp"])
    for key, value in want.exclude(keys.RANKED_IN).items(True, True):  # that is a time
        assert got[key].device.type == DEVICE and torch.equal(got[key].cpu(), value), key


if __name__ == "__main__":
    pytest.main([__file__])
