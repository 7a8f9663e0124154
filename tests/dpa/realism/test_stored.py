"""A store keeps what the metric reads: realism from the store is realism from the raw file, bit for bit."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dpa.realism import realism
from envs.convert import convert
from envs.scene import Scene
from envs.sources.womd import read_womd
from tests.dpa.realism.golden import SHIPPED, Golden, golden_config

REAL = "637f20cafde22ff8"
NEWEST = [("code2025", year) for year in ("2023", "2024", "2025")]
OLDER = [("code2023", "2023"), ("code2023dec", "2023"), ("code2024", "2024")]


@pytest.fixture(scope="module")
def raw_and_stored(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Scene, Scene]]:
    """By id: each golden scene that has a raw file, read from there and from a store."""
    golden = shared / "realism/golden/raw"
    files = [shared / "scenes/womd/motion_data_one_scenario.tfrecord", *sorted(golden.glob("*.binproto"))]
    store = convert("womd", files, tmp_path_factory.mktemp("stored") / "store")
    raw = [scene for file in files for scene in read_womd(file)]
    return {scene.scene_id: (scene, store[store.index_of(scene.scene_id)]) for scene in raw}


@pytest.mark.parametrize(
    ("kind", "code", "year"),
    [(kind, *run) for kind in ("logged", "log_noise_smooth") for run in NEWEST]
    + [("log_noise_smooth", *run) for run in OLDER],
)
def test_the_official_values_come_out_of_a_store(
    shared: Path, raw_and_stored: dict[str, tuple[Scene, Scene]], kind: str, code: str, year: str
) -> None:
    raw, stored = raw_and_stored[REAL]
    golden, config = Golden(shared / "realism/golden", REAL, kind), golden_config(code, year)
    rollouts = golden.load_rollouts(stored)
    assert torch.equal(rollouts, golden.load_rollouts(raw))
    got = realism(stored, rollouts, config)
    assert got == realism(raw, rollouts, config)
    official = golden.load_output(code, year)["metrics"]
    names = got.official()["metrics"].keys() & official.keys()
    assert len(names) > 10
    for name in names:
        assert got.official()["metrics"][name] == pytest.approx(official[name], abs=1e-6, rel=1e-6), name


@pytest.mark.parametrize("name", ["synth_a", "synth_b"])
@pytest.mark.parametrize("kind", ["logged", "constvel", "cv_noise", "log_noise_iid", "log_noise_smooth"])
def test_corner_cases_score_the_same_from_a_store(
    raw_and_stored: dict[str, tuple[Scene, Scene]], name: str, kind: str
) -> None:
    raw, stored = raw_and_stored[name]
    rollouts = Golden(SHIPPED, name, kind).load_rollouts(stored)
    for year in ("2023", "2024", "2025"):
        assert realism(stored, rollouts, year) == realism(raw, rollouts, year)


if __name__ == "__main__":
    pytest.main([__file__])
