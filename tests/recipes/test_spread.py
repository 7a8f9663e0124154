"""The spread of features between rollouts and log, and features named in a configuration."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from dpa.ranking import PreferenceDistance
from dpa.ranking.features import feature_names, feature_weights, log_trajectory
from envs.sources.synthetic import straight_road
from recipes.common.cli import build
from recipes.common.rolled import Rolled
from recipes.spread import spreads


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, run: Callable, options: Callable) -> Path:
    """A folder with the policies ``0`` and ``1``, and ``preferences`` of the first."""
    folder = tmp_path_factory.mktemp("runs")
    for seed in (0, 1):
        command = options("pretrain", f"output={folder / str(seed)}", f"seed={seed}", "pretraining.steps=2")
        assert run("pretrain", *command).status == 0
    command = options("collect", f"policy={folder / '0/policy.pt'}", f"output={folder / 'preferences'}")
    assert run("collect", *command).status == 0
    return folder


def test_the_recipe_measures_every_feature_that_is_asked_for(
    run: Callable, options: Callable, runs: Path, tmp_path: Path
) -> None:
    given = (f"policy={runs / '0/policy.pt'}", f"preferences={runs / 'preferences'}", f"json={tmp_path / 'out.json'}")
    outcome = run("spread", *options("spread", *given, "features=[speed,effort,red_light]"))
    assert outcome.status == 0, outcome.err
    rows = {row["feature"]: row for row in json.loads((tmp_path / "out.json").read_text())}
    assert list(rows) == ["speed", "effort", "red_light"]
    assert rows["speed"]["spread"] > 0
    assert rows["red_light"]["spread"] == 0
    assert sum(row["normalised"] for row in rows.values()) == pytest.approx(1)
    (told,) = re.findall(r"'(ranking\.weights=.*)'", outcome.out)
    weights = feature_weights(list(rows), OverridesParser.create().parse_override(told).value())
    assert weights[0] * rows["speed"]["spread"] ** 2 == pytest.approx(1.0, rel=5e-3)
    assert weights[2] == 10.0, "what never differs keeps its weight"


def test_rollouts_of_another_policy_are_refused(run: Callable, options: Callable, runs: Path) -> None:
    given = (f"policy={runs / '1/policy.pt'}", f"preferences={runs / 'preferences'}")
    outcome = run("spread", *options("spread", *given))
    assert outcome.status == 2
    assert "ranks rollouts of another policy than" in outcome.err


def test_a_distance_is_not_fitted_on_evaluation_scenes(run: Callable, options: Callable, runs: Path) -> None:
    given = (f"policy={runs / '0/policy.pt'}", f"preferences={runs / 'preferences'}", "split=eval")
    outcome = run("spread", *options("spread", *given))
    assert outcome.status == 2 and "not fitted on evaluation scenes" in outcome.err


def test_agents_that_the_log_replays_are_not_measured() -> None:
    scene = straight_road(2, speed=10.0)
    log = log_trajectory(scene, 80)
    rollout = log.clone()
    rollout[1] += torch.arange(1, 81)[:, None] * torch.tensor([0.3, 0, 0, 0])
    rolled = Rolled(0, scene, rollout[None], torch.tensor([True, False]))
    (row,) = spreads([rolled], ["effort"])
    assert row.spread == 0
    (row,) = spreads([rolled._replace(controlled=torch.tensor([False, True]))], ["speed"])
    assert row.spread == pytest.approx(3.0, abs=1e-3)


def test_features_that_never_differ_have_no_share() -> None:
    scene = straight_road(1, speed=10.0)
    rolled = Rolled(0, scene, log_trajectory(scene, 80)[None], torch.tensor([True]))
    assert [(row.paper, row.normalised) for row in spreads([rolled], ["speed", "effort"])] == [(0, 0), (0, 0)]


def test_only_valid_agent_steps_count_and_shares_follow_the_weights() -> None:
    scene = straight_road(1, speed=10.0)
    scene.agents.valid[0, 50:] = False
    rollout = log_trajectory(scene, 80) + torch.arange(1, 81)[:, None] * torch.tensor([0.3, 0, 0, 0])
    rows = {
        row.feature: row
        for row in spreads([Rolled(0, scene, rollout[None], torch.tensor([True]))], ["speed", "clearance"])
    }
    assert rows["speed"].spread == pytest.approx(3.0, abs=1e-3)
    assert rows["clearance"].spread == 0
    assert (rows["speed"].paper, rows["speed"].normalised) == (1.0, 1.0)


def test_no_valid_step_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="no agent-step"):
        spreads(iter([]), feature_names("full"))


def test_features_and_weights_are_one_line_of_yaml() -> None:
    ranking = OmegaConf.create({"features": ["collision", "road_edge", "red_light"], "weights": "normalised"})
    distance = build(PreferenceDistance, ranking, "collection.ranking")
    assert list(distance.describe()["weights"]) == ["collision", "road_edge", "red_light"]
    scene = straight_road(2)
    assert distance(scene, log_trajectory(scene, 80)[None]).distance.tolist() == [0.0]
