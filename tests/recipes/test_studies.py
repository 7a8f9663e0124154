"""The studies of rankings: their statistics by hand, and both recipes on tiny scenes."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from PIL import Image
from tensorboard.backend.event_processing.plugin_event_accumulator import EventAccumulator

from dpa.realism import realism
from dpa.realism.config import FOLDER
from dpa.report.statistics import Interval
from dpa.tokens import VerletTokenizer
from dpa.training.loggers import read_curve
from envs.scene import CURRENT_STEP
from envs.sources.synthetic import straight_road
from envs.store import SceneStore
from recipes import validity
from recipes.common.cli import CONFIG
from recipes.common.models import build_policy, policies_of, policy_config, write_policy
from recipes.common.rolled import Rolled, waiting
from recipes.ladder import BESIDES, table
from recipes.sensitivity import Variants
from recipes.sensitivity import summarise as summarise_variants
from recipes.studies.rows import measure_row
from recipes.studies.rungs import logged, tokenized_log
from recipes.studies.tables import StudyTable, tell
from recipes.validity import compare_with, summarise, windows
from tests.dpa.training.offline import wandb_history

SMALL = ["num_rollouts=8", "memory=0.001"]


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Two untrained policies, as an option."""
    folder = tmp_path_factory.mktemp("policies")
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        config = policy_config(compose("pretrain", ["model=nano"]).model)
    for seed in (0, 1):
        torch.manual_seed(seed)
        (folder / str(seed)).mkdir()
        write_policy(folder / f"{seed}/policy.pt", build_policy(config), config, {})
    return f"policies=[{folder}/0/policy.pt,{folder}/1/policy.pt]"


def test_policies_are_named_one_by_one_or_by_a_wildcard(tmp_path: Path) -> None:
    files = [tmp_path / f"seed_{seed}/reference/policy.pt" for seed in (10, 0, 1)]
    odd = tmp_path / "odd[1]/policy.pt"
    for file in (*files, odd):
        file.parent.mkdir(parents=True)
        file.touch()
    like = f"{tmp_path}/seed_*/reference/policy.pt"
    for given in (like, [like]):
        assert list(policies_of(OmegaConf.create({"policies": given})).values()) == sorted(files)
    both = policies_of(OmegaConf.create({"policies": [str(odd), like]}))
    assert list(both.values()) == [odd, *sorted(files)], "a file that is there is no wildcard"
    with pytest.raises(ValueError, match=r"no file is like .*round_\*/policy\.pt; check the folder"):
        policies_of(OmegaConf.create({"policies": f"{tmp_path}/round_*/policy.pt"}))


# --- validity -------------------------------------------------------------------------------------------------------
def test_windows_slide_from_the_nearest_to_the_farthest_rollouts() -> None:
    found = windows(torch.tensor([5.0, 1, 4, 0, 3, 2]), size=3, stride=1)
    assert [group.tolist() for group in found] == [[3, 1, 5], [1, 5, 4], [5, 4, 2], [4, 2, 0]]


def scene_of(distance: list[float], score: list[float], random: float = 0.5) -> dict:
    return {"omf": {"distance": distance, "realism": score}, "random": {"realism": [random]}}


def test_a_distance_that_orders_realism_correlates_with_it_in_every_scene() -> None:
    scenes = [scene_of([1.0, 2, 3], [0.7, 0.6, 0.5]), scene_of([10.0, 20, 30], [0.3, 0.2, 0.1], random=0.2)]
    found = summarise({"0": scenes, "1": scenes})["omf"]
    assert found["correlation"].mean == pytest.approx(-1) and found["correlation"].num_scenes == 2
    assert found["nearest"].mean == pytest.approx(0.15) and found["farthest"].mean == pytest.approx(-0.05)
    assert [window.mean for window in found["distance"]] == pytest.approx([0.5, 1, 1.5])
    assert found["nearest"].num_seeds == 2


def test_rankings_are_compared_scene_by_scene() -> None:
    scene = {
        "omf": {"distance": [1.0, 2], "realism": [0.7, 0.4]},
        "ade": {"distance": [1.0, 2], "realism": [0.6, 0.5]},
        "random": {"realism": [0.5]},
    }
    found = compare_with({"0": [scene, scene]}, "ade")
    assert list(found) == ["omf"]
    assert found["omf"]["nearest"].mean == pytest.approx(0.1) and found["omf"]["farthest"].mean == pytest.approx(-0.1)
    scene["ade"]["realism"] = [0.5, 0.6]  # its nearer window is the less realistic one
    assert compare_with({"0": [scene, scene]}, "ade")["omf"]["near_half"].mean == pytest.approx(-2)


def test_scenes_that_say_nothing_are_left_out() -> None:
    scenes = [scene_of([1.0, 2, 3], [0.7, 0.6, 0.5]), scene_of([1.0, 1, 1], [0.7, 0.6, 0.5])]
    without = {"omf": {"distance": [1, 2, 3], "realism": [None] * 3}, "random": {"realism": [None]}}
    found = summarise({"0": [*scenes, without]})["omf"]
    assert found["correlation"].num_scenes == 1 and found["nearest"].num_scenes == 2
    with pytest.raises(ValueError, match="no scene has realism"):
        summarise({"0": [without]})
    with pytest.raises(ValueError, match="omf: in no scene do both measures tell rollouts apart"):
        summarise({"0": scenes[1:]})


def test_validity_scores_each_window_as_the_metric_does(
    run: Callable, options: Callable, policies: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def spied(scene: object, simulated: torch.Tensor, groups: list[torch.Tensor], metric: str) -> list:
        seen.append(groups)
        return [realism(scene, simulated[group], metric) for group in groups]

    monkeypatch.setattr(validity, "realism_of_groups", spied)
    command = options("validity", policies, *SMALL, "window=4", "stride=2", f"output={tmp_path / 'a'}")
    outcome = run("validity", *command)
    assert outcome.status == 0, outcome.err
    assert len(seen) == 4, "two policies, two tuning scenes"
    monkeypatch.undo()
    again = run("validity", *[option.replace(str(tmp_path / "a"), str(tmp_path / "b")) for option in command])
    assert again.status == 0
    for name in ("0.json", "1.json"):
        first, second = (json.loads((tmp_path / run / name).read_text())["per_scene"] for run in ("a", "b"))
        assert len(first) == 2 and list(first[0]) == [*cfg_rankings(), "ade", "random"]
        assert first[0]["ade"]["distance"] == sorted(first[0]["ade"]["distance"])
        assert np.array(first[0]["omf"]["realism"]) == pytest.approx(second[0]["omf"]["realism"], rel=1e-6)
    assert (tmp_path / "a/validity.png").stat().st_size > 10_000
    summary = json.loads((tmp_path / "a/summary.json").read_text())
    assert summary["minus"] == "ade" and summary["differences"]["omf"]["nearest"]["scenes"] == 2
    other = run("validity", *command, "against=omf")
    assert other.status == 0 and "minus that of 'omf'" in other.out, "nothing is measured again"
    assert "against must be one of omf" in run("validity", *command, "against=chance").err


def cfg_rankings() -> list[str]:
    with initialize_config_dir(CONFIG["config_path"], version_base="1.3"):
        return list(compose("validity").rankings)


def test_a_finished_study_is_read_back_and_a_killed_one_goes_on(
    run: Callable, options: Callable, policies: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = options("validity", policies, *SMALL, "window=4", "stride=4", f"output={tmp_path}")
    whole, seen = validity.measure_scene, []

    def counted(each: object, *args: object, **kwargs: object) -> dict:
        if len(seen) == 1:
            raise KeyboardInterrupt
        seen.append(each.index)
        return whole(each, *args, **kwargs)

    monkeypatch.setattr(validity, "measure_scene", counted)
    assert run("validity", *command).status == 130
    seen.append(None)
    assert run("validity", *command).status == 0
    assert sorted(index for index in seen if index is not None) == [0, 0, 1, 1], "no scene is measured twice"
    monkeypatch.setattr(validity, "measure_scene", None)
    assert run("validity", *command).status == 0
    other = run("validity", *command, "stride=2")
    assert other.status == 2 and "was written with other options ('stride'" in other.err
    mine = tmp_path / "2024.yaml"
    mine.write_text((FOLDER / "2024.yaml").read_text().replace("corner_rounding: 0.7", "corner_rounding: 0.5"))
    other = run("validity", *command, f"metric={mine}")
    assert other.status == 2 and "was written with other options ('metric'" in other.err, "of the same name"


@pytest.mark.parametrize(
    ("recipe", "more", "message"),
    [
        (
            "validity",
            ["window=9"],
            "two windows must fit into num_rollouts, got window=9, stride=8 and num_rollouts=8; say num_rollouts=17",
        ),
        ("validity", ["window=8", "stride=1"], "two windows must fit .* say num_rollouts=9"),
        ("validity", ["window=4", "stride=3"], "farthest . of num_rollouts=. are in no window: .* say num_rollouts="),
        ("validity", ["policies=[]"], "policies=.. names no policy"),
        ("validity", ["+rankings.ade={}"], "rankings.ade: ade and random stand for displacement and chance"),
        ("validity", ["logger.backend=mlflow"], "logger.backend must be csv, wandb or tensorboard, got 'mlflow'"),
        ("validity", ["+rankings.bad={method: teleport}"], "unknown transport method 'teleport'"),
        ("sensitivity", ["baseline=none"], "baseline must be one of the rankings paper"),
        ("sensitivity", ["num_rollouts=4"], "num_rollouts must be 8 or more, got 4"),
    ],
)
def test_a_wrong_option_is_told_before_any_work(
    run: Callable, options: Callable, policies: str, tmp_path: Path, recipe: str, more: list[str], message: str
) -> None:
    window = ["window=4", "stride=2"] if recipe == "validity" and not more[0].startswith("window") else []
    outcome = run(recipe, *options(recipe, policies, *SMALL, *window, f"output={tmp_path / 'out'}", *more))
    assert outcome.status == 2
    assert re.search(message, outcome.err), outcome.err
    assert not (tmp_path / "out").exists()


# --- sensitivity ----------------------------------------------------------------------------------------------------
def variants(**distances: list[float]) -> Variants:
    seconds = dict.fromkeys(distances, 0.1)
    return Variants({"0": [{"distance": {**distances, "ade": distances["paper"]}, "seconds": seconds}]}, "paper")


def test_a_ranking_turned_round_turns_every_pair_round() -> None:
    found = variants(paper=[1.0, 2, 3, 4, 5, 6, 7, 8], mirrored=[8.0, 7, 6, 5, 4, 3, 2, 1])
    assert found.correlation("mirrored").mean == pytest.approx(-1) and found.correlation("ade").mean == pytest.approx(1)
    assert found.turned("mirrored").mean == 1 and found.turned("ade").mean == 0
    assert found.overlap("mirrored").mean == 0 and found.overlap("ade").mean == 1


def test_pairs_are_sorted_by_their_margin() -> None:
    # Gaps over the mean of 10: 0.01 for the first two, which the variant turns round; more for all others.
    found = variants(paper=[9.0, 9.1, 11.0, 10.9], other=[9.1, 9.0, 11.0, 10.9])
    assert found.by_margin("other", 0.0, 0.02).mean == pytest.approx(0.5)
    assert found.by_margin("other", 0.1, 0.4).mean == 1
    assert found.by_margin("other", 0.4, np.inf) is None


def test_more_rollouts_make_wider_pairs() -> None:
    values = np.random.default_rng(0).random(64).tolist()
    rows = summarise_variants(variants(paper=values, other=values))["rollouts"]
    assert list(rows) == [8, 16, 32, 64]
    order = np.sort(values[:8])
    assert rows[8]["margin"].mean == pytest.approx((order[-2:].mean() - order[:2].mean()) / np.mean(values))


@pytest.mark.slow
def test_sensitivity_ranks_the_same_rollouts_by_every_variant(
    run: Callable, options: Callable, policies: str, tmp_path: Path
) -> None:
    outcome = run("sensitivity", *options("sensitivity", policies, *SMALL, f"output={tmp_path}"))
    assert outcome.status == 0, outcome.err
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {"2 Hz", "time-aligned", "ade", "progress only"} <= set(summary["variants"])
    assert summary["variants"]["2 Hz"]["correlation"]["mean"] > 0.5
    (first, *_) = json.loads((tmp_path / "0.json").read_text())["per_scene"]
    assert {len(values) for values in first["distance"].values()} == {8}
    assert (tmp_path / "sensitivity.png").stat().st_size > 10_000
    with (tmp_path / "tables/variants/table/0.csv").open() as file:
        (logged,) = (row for row in csv.DictReader(file) if row["ranking"] == "2 Hz")
    mean, low = (summary["variants"]["2 Hz"]["correlation"][key] for key in ("mean", "ci95"))
    assert float(logged["Spearman"]) == mean and float(logged["Spearman low"]) == low[0]
    assert read_curve(tmp_path, "variants/Spearman/2_Hz") == [(0, mean)]
    assert (tmp_path / "pictures/variants/sensitivity/0.png").is_file()


# --- rows -------------------------------------------------------------------------------------------------------------
def test_a_row_that_was_cut_off_goes_on_with_the_next_scene(tmp_path: Path, stores: Path) -> None:
    scenes, rolled, cut_at = SceneStore(stores / "eval"), [], [2]

    def roll(done: frozenset[int]) -> Iterator[Rolled]:
        for index, scene in waiting(scenes, done):
            rolled.append(index)
            yield Rolled.of(index, scene, logged(scene, 1, torch.Generator()))

    def measure(each: Rolled) -> dict[str, int]:
        if each.index in cut_at:
            raise KeyboardInterrupt
        return {"index": each.index}

    def row(**decided_by: int) -> list[dict]:
        return measure_row(tmp_path, "the log: itself", decided_by, scenes, roll, measure)

    with pytest.raises(KeyboardInterrupt):
        row(seed=0)
    assert list(tmp_path.glob("*.json")) == [], "nothing that is not whole looks finished"
    cut_at.clear()
    assert row(seed=0) == row(seed=0) == [{"index": 0}, {"index": 1}, {"index": 2}] and rolled == [0, 1, 2, 2]
    assert [path.name for path in tmp_path.iterdir() if path.is_file()] == ["the_log_itself.json"]
    with pytest.raises(ValueError, match=r"the_log_itself\.json was written with other options"):
        row(seed=1)


# --- ladder -----------------------------------------------------------------------------------------------------------
def test_the_log_through_tokens_starts_from_what_a_policy_sees() -> None:
    scene = straight_road(1, speed=15.0)
    scene.agents.valid[0, :8] = False
    scene.agents.position[0, :8] = 0.0
    (driven,) = tokenized_log(VerletTokenizer())(scene, 1, torch.Generator())
    log = scene.agents.position[0, CURRENT_STEP + 1 :, :2]
    assert (driven[0, :, :2] - log).norm(dim=-1).max() < 0.5


def test_scenes_that_some_rung_has_no_realism_for_count_for_none() -> None:
    def scores(*realism: float | None) -> dict:
        return {"2024": {"realism": list(realism), **{name: [0.1, 0.2, 0.3] for name in BESIDES}}}

    found = table({"log": scores(0.9, 0.7, 0.8), "noisy log": scores(0.5, None, 0.3)}, ["2024"])
    assert found.title == "2 scenes, 1 left out, which have no realism"
    assert found.rows["log"][0].mean == pytest.approx(0.85) and found.rows["noisy log"][0].mean == pytest.approx(0.4)
    assert found.rows["log"][1:] == pytest.approx([0.2] * len(BESIDES))
    with pytest.raises(ValueError, match="no scene has realism under every rung"):
        table({"log": scores(0.9, None, 0.8), "noisy log": scores(None, 0.5, None)}, ["2024"])


# --- tables ---------------------------------------------------------------------------------------------------------
def found_table(signed: bool = True) -> StudyTable:
    gain = Interval(0.0421, 0.03, 0.05, over="seeds and scenes", num_seeds=3, num_scenes=24)
    rows = {"omf": [gain, 1.5], "runs/ref/policy.pt": [-0.01, None]}
    return StudyTable("rankings", "24 scenes", ["ranking", "nearest window", "seconds"], rows, signed)


def test_a_table_is_printed_with_intervals_and_kept_as_numbers() -> None:
    assert found_table().printed() == [
        ["omf", "+0.042 [+0.030, +0.050]", "+1.500"],
        ["runs/ref/policy.pt", "-0.010", "–"],
    ]
    assert found_table(signed=False).printed()[0] == ["omf", "0.042 [0.030, 0.050]", "1.500"]
    titles, rows = found_table().kept()
    assert titles == ["ranking", "nearest window", "nearest window low", "nearest window high", "seconds"]
    assert rows == [["omf", 0.0421, 0.03, 0.05, 1.5], ["runs/ref/policy.pt", -0.01, None, None, None]]


@pytest.mark.parametrize("backend", ["csv", "tensorboard", "wandb"])
def test_a_study_is_logged_alike_in_every_backend(tmp_path: Path, backend: str) -> None:
    cfg = OmegaConf.create({"output": str(tmp_path / "study"), "logger": {"backend": backend, "mode": "offline"}})
    Image.new("RGB", (6, 4), "white").save(tmp_path / "drawn.png")
    tell(cfg, [found_table()], {"rankings/drawn": tmp_path / "drawn.png"})
    numbers = {"omf": 0.0421, "runs_ref_policy.pt": -0.01}
    folder = tmp_path / "study"
    assert (folder / "tables/rankings/table/0.csv").read_text().startswith("ranking,nearest window,nearest window low")
    for row, value in numbers.items():
        assert read_curve(folder, f"rankings/nearest_window/{row}") == [(0, value)]
    if backend == "tensorboard":
        events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"tensors": 0}).Reload()
        assert {"rankings/drawn", "rankings/table/text_summary"} <= set(events.Tags()["tensors"])
        for row, value in numbers.items():
            (event,) = events.Tensors(f"rankings/nearest_window/{row}")
            assert event.tensor_proto.float_val[0] == pytest.approx(value)
    if backend == "wandb":
        (run,) = folder.glob("wandb/offline-run-*/*.wandb")
        shown = {key: value for row in wandb_history(run) for key, value in row.items()}
        assert shown.keys() >= {"rankings/drawn/_type", "rankings/table/_type"}
        assert [shown[f"rankings/nearest_window/{row}"] for row in numbers] == pytest.approx(list(numbers.values()))
