"""The study of the discriminator: it learns what it can, its tables by hand, and the recipe on tiny scenes."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig
from torch import Tensor

from dpa.discriminator import Discriminator, mean_squared_jerk
from dpa.ranking import PreferenceDistance, log_trajectory
from dpa.ranking.agreement import rank_correlation
from dpa.realism import RealismConfig
from dpa.tokens import VerletTokenizer
from dpa.training.checkpoint import load_policy
from dpa.training.loggers import read_curve
from envs.episode import EpisodeOptions
from envs.scene import Scene
from envs.sources.synthetic import straight_road
from recipes import discriminator
from recipes.common.cli import CONFIG
from recipes.common.models import build_policy, policy_config, write_policy
from recipes.common.rolled import Rolled, driven_log
from recipes.studies import adversary
from recipes.studies.adversary import best_look, fit, measured_on
from recipes.studies.motions import Motions, MotionShelf, Sight
from recipes.studies.spurious import QUANTITIES, RANKINGS, Ranked, partial, summarise

SMALL = ["num_rollouts=8", "memory=0.001", "training.num_rollouts=3", "training.steps=6", "training.look_interval=2"]
SMALL += ["training.checkpoint_interval=2", "training.width=8", "training.held_out=0.3", "training.batch_scenes=2"]


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An untrained policy, as an option."""
    folder = tmp_path_factory.mktemp("policies") / "a"
    folder.mkdir()
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        config = policy_config(compose("pretrain", ["model=nano"]).model)
    torch.manual_seed(0)
    write_policy(folder / "policy.pt", build_policy(config), config, {})
    return f"policies={folder}/policy.pt"


def configuration(*more: str) -> DictConfig:
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        return compose("discriminator", list(more))


# --- what it learns -------------------------------------------------------------------------------------------------
def jittered(seed: int, rollouts: int = 8) -> tuple[Scene, Tensor]:
    """A scene, and rollouts that are its log with jitter, more of it from one to the next."""
    scene, draw = straight_road(3, seed=seed), torch.Generator().manual_seed(seed)
    log = log_trajectory(scene, 80)
    sideways = torch.randn(rollouts, 3, 16, generator=draw).repeat_interleave(5, -1)
    strength = torch.linspace(0.02, 0.4, rollouts)[torch.randperm(rollouts, generator=draw)]
    poses = log.repeat(rollouts, 1, 1, 1)
    poses[..., 1] += sideways * strength[:, None, None]
    return scene, poses


def motions_of(scene: Scene, poses: Tensor) -> Motions:
    each = Rolled(0, scene, poses, torch.ones(3, dtype=torch.bool))
    return Sight()(each, log_trajectory(scene, 80))


def learnt(shelf: MotionShelf, folder: Path, *more: str) -> tuple[Discriminator, list[dict]]:
    cfg = configuration("training.look_interval=20", "training.batch_scenes=4", "training.lr=5e-3", *more)
    shape = {"num_features": Sight().width, "width": 16}
    return fit(cfg.training, shape, shelf, folder, seed=0, decided_by={}, logger=cfg.logger)


@pytest.fixture(scope="module")
def jitter_shelf(tmp_path_factory: pytest.TempPathFactory) -> MotionShelf:
    shelf = MotionShelf(tmp_path_factory.mktemp("jitter"), {})
    for seed in range(12):
        shelf.put(seed, motions_of(*jittered(seed)))
    return shelf


def test_of_jittered_logs_it_learns_that_they_jitter_and_ranks_by_smoothness(
    jitter_shelf: MotionShelf, tmp_path: Path
) -> None:
    net, curve = learnt(jitter_shelf, tmp_path, "training.steps=120")
    assert curve[-1]["held_out_auc"] > 0.95 and curve[-1]["train_loss"] < curve[0]["train_loss"] < 0.75
    for seed in range(100, 104):
        scene, poses = jittered(seed, rollouts=32)
        seen = motions_of(scene, poses)
        score, jerk = net.score(seen.rollouts, seen.valid).detach(), mean_squared_jerk(scene, poses, stride=5)
        assert rank_correlation(-score, jerk) > 0.8


def test_where_logs_are_named_at_random_it_learns_nothing(jitter_shelf: MotionShelf, tmp_path: Path) -> None:
    shelf, scenes = MotionShelf(tmp_path / "shelf", {}), range(24)
    draw = torch.Generator().manual_seed(0)
    for seed in scenes:
        seen = motions_of(*jittered(seed))
        rows = torch.cat((seen.log, seen.rollouts))[torch.randperm(9, generator=draw)]
        shelf.put(seed, Motions(rows[:1], rows[1:], seen.valid))
    net, _ = learnt(shelf, tmp_path / "run", "training.steps=60", "training.patience=100")
    others = []
    for seed in range(200, 240):
        seen = motions_of(*jittered(seed))
        rows = torch.cat((seen.log, seen.rollouts))[torch.randperm(9, generator=draw)]
        others.append(Motions(rows[:1], rows[1:], seen.valid))
    assert abs(measured_on(net, others)["auc"] - 0.5) < 0.15  # 40 scenes: a standard error of 0.05


def test_training_stops_when_the_held_out_scenes_gain_no_more(jitter_shelf: MotionShelf, tmp_path: Path) -> None:
    options = ("training.lr=0.5", "training.patience=2", "training.steps=400", "training.look_interval=5")
    net, curve = learnt(jitter_shelf, tmp_path, *options)
    best = curve.index(best_look(curve))
    assert len(curve) == best + 3 < 80, "two looks after the best one"
    held_out = [jitter_shelf.get(scene) for scene in adversary.split_of(range(12), 0.2, 0)[1]]
    assert measured_on(net, held_out)["loss"] == pytest.approx(curve[best]["held_out_loss"])
    assert curve[best]["held_out_auc"] == max(look["held_out_auc"] for look in curve)


def test_training_that_is_killed_goes_on_to_the_same_bits(
    jitter_shelf: MotionShelf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ("training.steps=12", "training.look_interval=3", "training.checkpoint_interval=4")
    whole, curve = learnt(jitter_shelf, tmp_path / "whole", *options)
    count, batch_of = [], adversary._batch

    def killed(*args: object) -> tuple[Tensor, ...]:
        count.append(1)
        if len(count) == 9:
            raise KeyboardInterrupt
        return batch_of(*args)

    with monkeypatch.context() as patch:
        patch.setattr(adversary, "_batch", killed)
        with pytest.raises(KeyboardInterrupt):
            learnt(jitter_shelf, tmp_path / "killed", *options)
    again, same = learnt(jitter_shelf, tmp_path / "killed", *options)
    assert same == curve
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in whole.state_dict().items())
    assert read_curve(tmp_path / "killed", "train/loss") == read_curve(tmp_path / "whole", "train/loss")


def test_a_shelf_of_other_options_is_told_and_kept(tmp_path: Path) -> None:
    seen = motions_of(*jittered(0))
    MotionShelf(tmp_path / "shelf", {"seed": 0}).put(4, seen)
    again = MotionShelf(tmp_path / "shelf", {"seed": 0})
    assert again.scenes() == [4]
    for mine, theirs in zip(again.get(4), seen, strict=True):
        assert torch.allclose(mine.float(), theirs.float(), atol=2e-2) and mine.shape == theirs.shape
    with pytest.raises(ValueError, match="shelf holds motions of other options .'seed': 0 there, 1 here"):
        MotionShelf(tmp_path / "shelf", {"seed": 1})
    assert again.scenes() == [4]
    again.remove()
    assert not (tmp_path / "shelf").exists()


def test_the_log_goes_through_the_tokens_of_the_policy_and_what_is_not_controlled_replays() -> None:
    scene, tokenizer = straight_road(3, seed=5), VerletTokenizer()
    log = log_trajectory(scene, 80)
    driven = driven_log(scene, tokenizer, EpisodeOptions(max_controlled=1))
    moved = (driven - log)[..., :2].abs().amax((1, 2))
    assert moved[0] > 1e-3 and torch.equal(moved[1:], torch.zeros(2))
    bins = driven[0, 4::5, 0].diff(n=2) / tokenizer.bins[1, 0]
    assert torch.allclose(bins, bins.round(), atol=1e-3), "its displacements change by whole bins"
    raw = driven_log(scene, None, EpisodeOptions())
    assert torch.equal(raw[..., :2], log[..., :2])


# --- the tables -----------------------------------------------------------------------------------------------------
def scene_of(score: list[float], distance: list[float], **quantity: list[float]) -> dict:
    flat = {name: [1.0] * len(score) for name in QUANTITIES} | {"distance": distance, "ade": distance} | quantity
    figures = {"realism": 0.5}
    ends = {"best": {"realism": 0.6}, "worst": {"realism": 0.4}}
    return {
        "score": score,
        "quantity": flat,
        "log": {"score": 2.5, "jerk": 1.5, "jerk_2hz": 0.5},
        "realism": dict.fromkeys(RANKINGS, ends) | {"random": figures},
    }


def test_a_discriminator_that_ranks_by_jerk_is_told_from_one_that_ranks_by_the_distance() -> None:
    jerk, distance = [1.0, 2, 3, 4], [2.0, 1, 4, 3]
    by_jerk = scene_of([4.0, 3, 2, 1], distance, jerk=jerk)
    found = summarise({"0": [by_jerk, by_jerk], "1": [by_jerk, by_jerk]})
    assert found["correlation"]["jerk"]["discriminator"].mean == pytest.approx(-1)
    assert found["correlation"]["distance"]["distance"].mean == pytest.approx(-1)
    assert found["jerk_minus_distance"].mean == pytest.approx(1 - 0.6)
    assert found["correlation"]["collision"]["discriminator"] is None, "nobody collides: nothing is ranked"
    assert found["auc"]["discriminator"].mean == 0.5, "two of four rollouts score below the log"
    assert found["auc"]["jerk"].mean == 0.75 and found["auc"]["jerk"].num_seeds == 2
    assert found["realism"]["discriminator"]["best"]["realism"].mean == pytest.approx(0.1)
    assert found["minus"]["distance"].mean == pytest.approx(0)
    by_distance = scene_of([-d for d in distance], distance, jerk=jerk)
    found = summarise({"0": [by_distance, by_distance]})
    assert found["jerk_minus_distance"].mean == pytest.approx(0.6 - 1)


def test_a_partial_correlation_is_that_of_residuals() -> None:
    draw = np.random.default_rng(0)
    z = draw.random(200)
    x, y = z + draw.random(200), z + 0.3 * draw.random(200)
    ranks = [np.argsort(np.argsort(value)).astype(float) for value in (x, y, z)]
    ranks = [rank - rank.mean() for rank in ranks]
    left, right = (rank - ranks[2] * (rank @ ranks[2]) / (ranks[2] @ ranks[2]) for rank in ranks[:2])
    expected = left @ right / np.sqrt((left @ left) * (right @ right))
    found = partial(*(np.array([rank_correlation(a, b)]) for a, b in ((x, y), (x, z), (y, z))))
    assert found == pytest.approx([expected])
    assert np.isnan(partial(np.array([0.5]), np.array([1.0]), np.array([0.5])))


def test_random_scores_correlate_with_nothing() -> None:
    draw = np.random.default_rng(1)
    values = [scene_of(draw.random(64).tolist(), draw.random(64).tolist()) for _ in range(20)]
    found = Ranked({"0": values}).random("distance")
    assert abs(found.mean()) < 0.05 and found.shape == (1, 20)


def test_scenes_without_realism_are_refused() -> None:
    scene = scene_of([4.0, 3, 2, 1], [1.0, 2, 3, 4], jerk=[1.0, 2, 3, 4])
    scene["realism"]["random"] = {"realism": None}
    with pytest.raises(ValueError, match="no scene has realism"):
        summarise({"0": [scene]})


# --- the recipe -----------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_recipe_goes_on_after_a_kill_and_gives_what_it_would_have_given(
    run: Callable, options: Callable, policy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = run("discriminator", *options("discriminator", policy, *SMALL, f"output={tmp_path / 'whole'}"))
    assert whole.status == 0, whole.err
    assert "held-out AUC" in whole.out and "mean squared jerk" in whole.out
    summary = json.loads((tmp_path / "whole/summary.json").read_text())
    assert set(summary["correlation"]) == set(QUANTITIES) and list(summary["policies"]) == ["a"]
    assert [look["step"] for look in summary["policies"]["a"]["curve"]] == [2, 4, 6]
    assert summary["correlation"]["jerk"]["discriminator"]["scenes"] == 2 == summary["made"]["scenes"]
    assert summary["realism"]["distance"]["best"]["realism"]["ci95"]
    assert (tmp_path / "whole/discriminator.png").stat().st_size > 10_000
    assert not (tmp_path / "whole/a/motions").exists()

    command = options("discriminator", policy, *SMALL, f"output={tmp_path / 'killed'}")
    for place, after in (("seen", 4), ("measure_scene", 1)):
        real, calls = getattr(discriminator, place), []

        def killed(*args: object, real: Callable = real, calls: list = calls, after: int = after, **kwargs: object):
            calls.append(1)
            if len(calls) > after:
                raise KeyboardInterrupt
            return real(*args, **kwargs)

        with monkeypatch.context() as patch:
            patch.setattr(discriminator, place, killed)
            assert run("discriminator", *command).status == 130
    assert run("discriminator", *command).status == 0
    first, second = (load_policy(tmp_path / side / "a/discriminator.pt")[0] for side in ("whole", "killed"))
    assert all(torch.equal(value, second[key]) for key, value in first.items())
    mine, theirs = (json.loads((tmp_path / side / "a.json").read_text()) for side in ("whole", "killed"))
    assert mine == theirs
    again = json.loads((tmp_path / "killed/summary.json").read_text())
    assert again.pop("made")["command"].endswith("killed") and summary.pop("made")["command"].endswith("whole")
    assert again == summary

    for place in ("fit", "measure_scene"):
        monkeypatch.setattr(discriminator, place, lambda *_, **__: pytest.fail("it was done before"))
    assert run("discriminator", *command).status == 0, "nothing is done again"
    other = run("discriminator", *command, "sight.tokenized=false")
    assert other.status == 2 and "was written with other options ('sight.tokenized'" in other.err


def test_scores_are_those_of_the_network_and_rates_those_of_the_events() -> None:
    scene, poses = jittered(0)
    poses[0, 0, 40:, 1] += 20.0  # one of three leaves the road
    poses[1, 1, 40:, 0] += 15.0  # one of three runs into its leader, who is hit as well
    each = Rolled(0, scene, poses, torch.ones(3, dtype=torch.bool))
    rates = discriminator.event_rates(each)
    assert rates["offroad"][:2].tolist() == pytest.approx([1 / 3, 0])
    assert rates["collision"][:3].tolist() == pytest.approx([0, 2 / 3, 0])


def test_what_lies_behind_a_hole_of_the_log_has_no_jerk() -> None:
    sight, found = Sight(), []
    net = Discriminator(num_features=sight.width, width=4)
    for last in (45, 91):  # a hole, or the end of the log
        scene, poses = jittered(0)
        scene.agents.valid[0, 40:last] = False
        each = Rolled(0, scene, poses, torch.ones(3, dtype=torch.bool))
        metric, distance = RealismConfig.load("2024"), PreferenceDistance()
        found.append(
            discriminator.measure_scene(each, net, sight, VerletTokenizer(), EpisodeOptions(), distance, metric, 0)
        )
    for jerk in ("jerk", "jerk_2hz"):
        assert (
            found[0]["log"][jerk] == found[1]["log"][jerk] and found[0]["quantity"][jerk] == found[1]["quantity"][jerk]
        )


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["num_rollouts=4"], "num_rollouts must be 8 or more, got 4"),
        (["split=train"], "split=train ranks the scenes that the discriminator learns from"),
        (["training.held_out=1.5"], "training.held_out must lie between 0 and 1, got 1.5"),
        (["training.held_out=0.99"], "training.held_out=0.99 holds 6 of 6 scenes with controlled agents out"),
        (["training.steps=0"], "training.steps must be 1 or more, got 0"),
        (["policies=[]"], "policies=.. names no policy"),
        (["sight.road=[sky]"], "unknown features .'sky'."),
        (["sight.stride=20"], "sight: stride must be 1 to 10"),
        (["sight.tokenized=perhaps"], "tokenized must be true or false, got 'perhaps'"),
        (["+sight.colour=red"], "sight has no option 'colour'"),
        (["ranking.kind=astrology"], "ranking.kind must be one of"),
    ],
)
def test_a_wrong_option_is_one_clear_sentence(
    run: Callable, options: Callable, policy: str, tmp_path: Path, more: list[str], message: str
) -> None:
    more = [f"+{option}" if option.startswith("ranking.kind") else option for option in more]
    outcome = run("discriminator", *options("discriminator", policy, *SMALL, f"output={tmp_path / 'out'}", *more))
    assert outcome.status == 2
    assert re.search(message, outcome.err), outcome.err


if __name__ == "__main__":
    pytest.main([__file__])
