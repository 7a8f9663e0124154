"""The benchmark measures what it says it measures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from envs.sources.tfrecord import frame
from recipes.benchmark.__main__ import main
from recipes.benchmark.realism import crowded_scene, noisy_log


def test_a_crowded_scene_has_the_agents_and_edges_that_were_asked_for() -> None:
    scene = crowded_scene(agents=128, segments=5000).validate()
    assert int(scene.agents.present.sum()) == 128
    assert int(scene.agents.evaluated.sum()) == 9
    assert int((scene.road.count - 1).sum()) == 5000
    assert noisy_log(scene, 2).shape == (2, 128, 80, 4)


def test_the_metric_is_timed_on_files_of_ones_own(
    stores: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.json"
    options = ["--num-rollouts", "2", "--repeats", "1", "--threads", "1", "--json", str(out)]
    assert main(["realism", "--scenarios", str(stores / "eval"), *options]) == 0
    rows = json.loads(out.read_text())["rows"]
    assert len(rows) == 3 and all(row["seconds"] > 0 and row["process_gib"] > 0 for row in rows)
    assert "s per scene" in " ".join(capsys.readouterr().out.split())


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
