"""What lies between a policy and the log: its rows by hand, and the recipe on tiny scenes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from torch import Tensor

from dpa.models import Decoding
from dpa.models.motionlm import MotionLM
from dpa.realism import RealismConfig
from dpa.tokens import VerletTokenizer
from envs.episode import EpisodeOptions
from envs.scene import CURRENT_STEP, MapKind, Scene
from envs.sources.synthetic import build_scene, straight_road
from recipes.common.cli import CONFIG
from recipes.common.models import build_policy, policy_config, write_policy
from recipes.common.rolled import Rolled, logs
from recipes.gap import PLACES, look, single_decisions, tables

METRIC = RealismConfig.load("2024")


class Imitates(MotionLM):
    """Is sure of the token that the log has."""

    def forward(self, context: object, tokens: Tensor, token_valid: Tensor) -> Tensor:
        return 50.0 * torch.nn.functional.one_hot(tokens, self.tokenizer.vocab_size)


class Stops(MotionLM):
    """Is sure of the same token whatever the log has: the one that brakes hardest."""

    def forward(self, context: object, tokens: Tensor, token_valid: Tensor) -> Tensor:
        brake = self.tokenizer.vocab_size // 2 - 6 * 13
        return 50.0 * torch.nn.functional.one_hot(torch.full_like(tokens, brake), self.tokenizer.vocab_size)


def logged(scene: Scene) -> Tensor:
    """``[A, 80, 4]``."""
    agents = scene.agents
    return agents.trajectory[:, CURRENT_STEP + 1 :]


def two_cars() -> Scene:
    """Two cars, one ahead of the other, at 10 m/s."""
    poses = torch.zeros(2, 91, 3)
    poses[..., 0] = torch.arange(91) + torch.tensor([[0.0], [30.0]])
    return build_scene(poses, [(MapKind.EDGE_BOUNDARY, torch.tensor([[250.0, 9.0], [-50.0, 9.0]]))])


def test_a_car_that_catches_up_collides_by_the_time_that_it_does() -> None:
    """By hand: 30 m apart at the centres, 5 m/s too fast: bumpers of 4.5 m cars meet in the sixth second."""
    scene = two_cars()
    faster = logged(scene).repeat(2, 1, 1, 1)
    faster[1, 0, :, 0] += 0.5 * torch.arange(1, 81)
    found = look(Rolled.of(0, scene, faster), METRIC)
    assert found["collision 2 s"] == 0.0 and found["collision 8 s"] == 0.5, "in one of two rollouts"
    assert found["away [m] 2 s"] == pytest.approx(5.0) and found["away [m] 8 s"] == pytest.approx(20.0), (
        "means over both"
    )


def test_of_a_log_that_has_ended_nothing_is_known() -> None:
    scene = two_cars()
    faster = logged(scene)[None].clone()
    faster[:, 0, :, 0] += 0.5 * torch.arange(1, 81)
    scene.agents.valid[0, CURRENT_STEP + 31 :] = False
    found = look(Rolled.of(0, scene, faster), METRIC)
    assert found["away [m] 2 s"] == pytest.approx(10.0) and found["collision 2 s"] == 0.0
    assert all(found[f"{name} 8 s"] is None for name in ("collision", "off-road", "away [m]"))


def test_nobody_runs_into_an_agent_whose_log_has_ended() -> None:
    """The front car leaves after three seconds, 60 m on; the other one, as logged, drives through where it was last."""
    scene = two_cars()
    log = logged(scene)[None].clone()
    scene.agents.valid[1, CURRENT_STEP + 31 :] = False
    log[:, 1, 30:, 0] = log[:, 1, 30:31, 0]
    assert look(Rolled.of(0, scene, log), METRIC)["collision 8 s"] == 0.0


def test_a_scene_without_a_self_driving_car_is_refused() -> None:
    scene = two_cars()
    scene.agents.sdc = torch.zeros(2, dtype=torch.bool)
    with pytest.raises(ValueError, match="has no self-driving car"):
        look(Rolled.of(0, scene, logged(scene)[None]), METRIC)


def rows(scene: Scene, model: type[MotionLM]) -> tuple[Tensor, Tensor, Tensor]:
    """``[A, 80, 4]`` of the log, of the log through tokens, and of single decisions."""
    tokenizer, cut = VerletTokenizer(), EpisodeOptions()
    options = OmegaConf.create({"num_rollouts": 1, "seed": 0, "device": "cpu"})
    decided = single_decisions([scene], model("nano", tokenizer), cut, Decoding(), options)
    return tuple(
        next(rolls).trajectories[0] for rolls in (logs([scene], cut, None), logs([scene], cut, tokenizer), decided)
    )


def test_single_decisions_of_who_knows_the_log_are_the_log_through_tokens() -> None:
    for seed in range(3):
        log, tokens, decided = rows(straight_road(3, seed=seed), Imitates)
        torch.testing.assert_close(decided, tokens)
        assert not torch.equal(tokens[0], log[0]) and torch.equal(tokens[1:], log[1:]), "the other agents are the log"


def test_errors_of_single_decisions_do_not_add_up() -> None:
    """One decision of hard braking costs six bins, give or take the one that tokens of the log lose and make good."""
    _, tokens, decided = rows(two_cars(), Stops)
    ends = (tokens - decided)[0, 4::5, 0]
    torch.testing.assert_close(ends, torch.full((16,), 6 * 0.28125), atol=0.282, rtol=0)


def test_a_further_policy_is_told_minus_the_first_scene_by_scene() -> None:
    """By hand; where the log of a scene has left, it counts in neither."""
    gap = {f"one: {place}": {"collision": [0.5, 0.25, None]} for place in PLACES}
    gap |= {f"two: {place}": {"collision": [0.25, 0.5, None]} for place in PLACES}
    gap["two: alone"] = {"collision": [0.0, 0.0, None]}
    values, minus = tables(gap, ["one", "two"], 3)
    assert values.rows["one: alone"][0].mean == 0.375 and values.rows["one: alone"][0].num_scenes == 2
    found = {name: cells[0].mean for name, cells in minus.rows.items()}
    assert found == {"two: single decisions": 0.0, "two: alone": -0.375, "two: among its own": 0.0}
    assert len(list(tables({"log": {"collision": [0.0]}}, ["one"], 1))) == 1, "one policy has nothing to be set against"


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("policies")
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        config = policy_config(compose("pretrain", ["model=nano"]).model)
    for name in ("one", "two"):
        (folder / name).mkdir()
        write_policy(folder / name / "policy.pt", build_policy(config), config, {})
    return [folder / name / "policy.pt" for name in ("one", "two")]


def test_the_recipe_tells_all_rows_with_intervals_and_reads_them_back(
    run: Callable, options: Callable, policies: list[Path], tmp_path: Path
) -> None:
    out = tmp_path / "gap.json"
    small = ("split=eval", "num_rollouts=3", f"output={tmp_path / 'gap'}", f"json={out}")
    outcome = run("gap", *options("gap", f"policies={policies[0]}", *small))
    assert outcome.status == 0, outcome.err
    content = json.loads(out.read_text())
    assert list(content["rows"]) == ["log", "log through tokens", "single decisions", "alone", "among its own"]
    away = {name: sum(row["away [m] 8 s"]) for name, row in content["rows"].items()}
    assert away["log"] == 0.0 < away["log through tokens"] < away["single decisions"] < away["alone"]
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "gap").glob("*_*.json")}
    assert "single decisions" in run("gap", *options("gap", f"policies={policies[0]}", *small)).out
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "gap").glob("*_*.json")}


def test_policies_with_different_tokens_are_refused(
    run: Callable, options: Callable, policies: list[Path], tmp_path: Path
) -> None:
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        linear = policy_config(compose("pretrain", ["model=nano", "model.tokenizer.interpolation=linear"]).model)
    (tmp_path / "linear").mkdir()
    write_policy(tmp_path / "linear/policy.pt", build_policy(linear), linear, {})
    both = f"policies=[{policies[0]},{tmp_path / 'linear/policy.pt'}]"
    outcome = run("gap", *options("gap", both, f"output={tmp_path / 'gap'}"))
    assert outcome.status == 2 and "linear has other tokens than the first policy" in outcome.err


@pytest.mark.slow
def test_rows_of_several_policies_are_named_by_them(
    run: Callable, options: Callable, policies: list[Path], tmp_path: Path
) -> None:
    both, out = f"policies=[{policies[0]},{policies[1]}]", tmp_path / "gap.json"
    small = ("split=tune", "num_rollouts=1", f"output={tmp_path / 'gap'}", f"json={out}")
    assert run("gap", *options("gap", both, *small)).status == 0
    assert list(json.loads(out.read_text())["rows"])[2::3] == ["one: single decisions", "two: single decisions"]
