"""The benchmark measures what it says it measures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from torchrl.envs import TransformedEnv

from dpa.models import Contexts, MotionActor
from dpa.models.motionlm import MotionLM, featurize
from dpa.ranking import transport_cost
from dpa.tokens import TokenAction, VerletTokenizer
from envs import keys
from envs.sources.tfrecord import frame
from envs.traffic import TrafficEnv
from recipes.benchmark import transport
from recipes.benchmark.__main__ import main
from recipes.benchmark.realism import crowded_scene, noisy_log
from recipes.benchmark.rollout import NaiveActor, UncachedActor
from recipes.plan import main as plan_main


def test_a_crowded_scene_has_the_agents_and_edges_that_were_asked_for() -> None:
    scene = crowded_scene(agents=128, segments=5000).validate()
    assert int(scene.agents.present.sum()) == 128
    assert int(scene.agents.evaluated.sum()) == 9
    assert int((scene.road.count - 1).sum()) == 5000
    assert noisy_log(scene, 2).shape == (2, 128, 80, 4)


@pytest.mark.slow
def test_the_metric_is_timed_on_files_of_ones_own(
    stores: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.json"
    options = ["--num-rollouts", "2", "--repeats", "1", "--threads", "1", "--json", str(out)]
    assert main(["realism", "--scenarios", str(stores / "eval"), *options]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert len(rows) == 3 and all(row["seconds"] > 0 and row["process_gib"] > 0 for row in rows)
    assert "s per scene" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_kernels_and_synchronisations_are_printed_part_by_part(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, sizes = tmp_path / "out.json", ["--agents", "2", "--rollouts", "2", "--scenes", "1"]
    assert main(["device", "--model", "nano", "--device", "nowhere", *sizes, "--json", str(out)]) == 0
    rows = {row["part"]: row for row in json.loads(out.read_text())["rows"]}
    assert rows["policy"]["synchronisations"] == 1 and rows["env step"]["synchronisations"] == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "kernels" in printed and "synchronisations" in printed and "ranking of a scene, sinkhorn" in printed


def test_sizes_that_cannot_be_counted_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["device", "--agents", "0"]) == 2
    assert "--agents must be 1 or more" in capsys.readouterr().err


def test_a_file_that_is_not_there_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["realism", "--scenarios", "nowhere"]) == 2
    assert "nowhere does not exist" in capsys.readouterr().err


def test_scenes_are_measured_raw_and_stored(make_scenario, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raw, out, work = tmp_path / "raw.tfrecord", tmp_path / "out.json", tmp_path / "work"
    work.mkdir()
    raw.write_bytes(frame(make_scenario().SerializeToString()))
    options = ["--copies", "3", "--workers", "1", "--batch", "4", "--repeats", "1", "--folder", str(work)]
    assert main(["scenes", "womd", str(raw), *options, "--json", str(out)]) == 0
    figures = {row["what"]: row["figure"] for row in json.loads(out.read_text())["rows"]}
    assert figures["raw files"] * 1000 == pytest.approx(raw.stat().st_size, abs=10)  # ids of copies are a little longer
    assert 0 < figures["store"] < figures["raw files"]
    assert figures["conversion with 1 processes, start included"] > 0
    assert "scenes of womd, 6 in all" in capsys.readouterr().out
    assert not list(work.iterdir())


@pytest.mark.slow
def test_rollouts_are_measured_and_planned_with(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, plan = tmp_path / "rollout.json", tmp_path / "plan.json"
    small = ["--model", "nano", "--agents", "2", "--rollouts", "2", "--threads", "1", "--repeats", "1"]
    assert main(["rollout", *small, "--json", str(out)]) == 0
    assert "incremental over naive" in capsys.readouterr().out
    *rows, limit = json.loads(out.read_text())["rows"]
    assert [row["how"] for row in rows] == ["incremental", "collector", "naive", "uncached", "ranked", "trained"]
    assert all(row["agent_steps_per_second"] > 0 for row in rows)
    assert 0 < limit["fraction_reached"] < 1
    assert plan_main([str(out), "--workers", "4", "--json", str(plan)]) == 0
    assert "grows with" in capsys.readouterr().out
    hours = {part["name"]: part["hours"] for part in json.loads(plan.read_text())["parts"]}
    assert hours["collect and rank"] == pytest.approx(
        487_000 * 64 * 50 * 80 / rows[4]["agent_steps_per_second"] / 4 / 3600
    )


@pytest.mark.slow
def test_training_is_measured_beside_another_checkout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "training.json"
    small = ["--model", "nano", "--agents", "6", "--pieces", "16", "--scenes", "12", "--epochs", "2", "--repeats", "1"]
    here = ["--against", str(Path(__file__).parents[2]), "--folder", str(tmp_path), "--json", str(out)]
    assert main(["training", *small, *here]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert [(row["processes"], row["threads"]) for row in rows] == [(1, 2), (1, 2), (2, 1), (2, 1)]
    assert all(speed > 0 for row in rows for speed in row["scenes_per_second"].values())
    assert "pre-training, scenes/s" in capsys.readouterr().out


def test_a_checkout_without_the_recipe_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["training", "--against", str(tmp_path)]) == 2
    assert "holds no recipes/pretrain.py" in capsys.readouterr().err


def test_transport_is_measured_against_a_loop_over_pot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transport, "RANKED_AGENTS", 3)
    monkeypatch.setattr(transport, "RANKED_ROLLOUTS", 2)
    out = tmp_path / "transport.json"
    small = ["--problems", "48", "--steps", "20", "--threads", "2", "--repeats", "1"]
    assert main(["transport", *small, "--json", str(out)]) == 0
    assert "times the loop" in " ".join(capsys.readouterr().out.split())
    *rows, ranking = json.loads(out.read_text())["rows"]
    assert [row["how"].split(",")[0] for row in rows] == [
        *("loop over ot.emd2", "exact", "exact", "exact at 2 Hz", "windowed", "sinkhorn", "time_aligned")
    ]
    assert all(row["seconds"] > 0 and row["problems_per_second"] > 0 for row in rows)
    assert [row["spearman"] for row in rows[:3]] == [1, 1, 1]
    assert ranking["agents"] == 3 and 0 < ranking["transport_seconds"] < ranking["seconds"]


def test_the_loop_over_pot_gives_the_exact_distances() -> None:
    clouds = transport.make_clouds(problems=16, steps=20)
    x, y, valid, weights = clouds
    want = transport_cost(x, y, valid, valid, weights).distance
    torch.testing.assert_close(transport.pot_loop(clouds), want, rtol=1e-4, atol=1e-4)


def test_sizes_that_cannot_be_measured_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["transport", "--steps", "81"]) == 2
    assert "steps must be 5 to 80, got 81" in capsys.readouterr().err


@pytest.mark.parametrize("kind", [NaiveActor, UncachedActor])
def test_the_naive_decoder_decodes_the_same(kind: type[MotionActor]) -> None:
    """It is what the other one is measured against, so it must do the same work."""
    torch.manual_seed(0)
    model, scenes = MotionLM("nano", VerletTokenizer()).eval(), [crowded_scene(3, 100), crowded_scene(2, 100)]
    found = []
    for each in (MotionActor, kind):
        env = TransformedEnv(TrafficEnv(scenes, num_scenes=2, num_rollouts=2), TokenAction(model.tokenizer))
        found.append(env.rollout(16, each(model, Contexts(scenes, featurize), num_rollouts=2)))
    controlled = found[0][keys.CONTROLLED]
    assert torch.equal(*(rollout[keys.TOKEN][controlled] for rollout in found))
    log_probs = (rollout[keys.LOG_PROB][controlled] for rollout in found)
    torch.testing.assert_close(*log_probs, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"rows": []}', '{"rows": [{"how": "naive", "agent_steps_per_second": 1}], "options": {}}']
)
def test_a_plan_without_rates_is_refused(content: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rates.json").write_text(content)
    assert plan_main([str(tmp_path / "rates.json")]) == 2
    assert "rates.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--json", "{folder}"], "is a folder; name a file"),
        (["--device", "gpu"], "device must be cpu, cuda or cuda:N, got 'gpu'"),
        (["--model", "smart_nano", "--compile"], "decoding of smart_nano is not compiled"),
    ],
)
def test_what_cannot_be_measured_or_written_is_told_before_it_is_measured(
    more: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rollout", *(each.format(folder=tmp_path) for each in more)]) == 2
    assert told in capsys.readouterr().err
