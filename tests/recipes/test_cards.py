"""Data cards of a study's scenes: counted once, of exactly the scenes of each split, and never mixed up."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dpa.report.scenes import read_scene_cards
from envs.card import Card
from envs.store import SceneStore
from recipes.common.scenes import Splits
from recipes.experiment.cards import write_scene_cards


@pytest.fixture
def splits(stores: Path) -> Splits:
    """Tuning scenes that are some of one store, and training scenes that are the others."""
    pool = SceneStore(stores / "train")
    return Splits(pool.subset([0, 1, 3, 4, 6, 7]), pool.subset([2, 5]), SceneStore(stores / "eval"))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "runs" / "scenes.json"


def test_cards_count_the_scenes_of_each_split_and_no_others(splits: Splits, path: Path) -> None:
    write_scene_cards(path, splits)
    written = json.loads(path.read_text())["splits"]
    assert list(written) == ["train", "tune", "eval"]
    for name, found in written.items():
        one_by_one = Card()
        for scene in splits[name]:
            one_by_one.add(scene)
        assert found["counts"] == one_by_one.counts
        assert sum(origin["scenes"] for origin in found["origins"]) == len(splits[name])


def test_the_page_reads_what_was_written(splits: Splits, path: Path) -> None:
    write_scene_cards(path, splits)
    assert {name: card.facts["scenes"] for name, card in read_scene_cards(path).items()} == {
        name: str(size) for name, size in splits.sizes().items()
    }


def test_scenes_are_counted_once_for_all_experiments(
    splits: Splits, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_scene_cards(path, splits)
    before = path.read_bytes()
    monkeypatch.delattr(SceneStore, "card")
    write_scene_cards(path, splits)
    assert path.read_bytes() == before


def test_cards_of_other_scenes_are_refused_and_kept(splits: Splits, stores: Path, path: Path) -> None:
    write_scene_cards(path, splits)
    before = path.read_bytes()
    other = Splits(splits.train, splits.tune, SceneStore(stores / "other"))
    with pytest.raises(ValueError, match=r"scenes\.json was written with other options \('scenes\.eval': '\w+' there"):
        write_scene_cards(path, other)
    assert path.read_bytes() == before


def test_damaged_cards_are_refused(splits: Splits, path: Path) -> None:
    path.parent.mkdir()
    path.write_text("{")
    with pytest.raises(ValueError, match=r"scenes\.json is no result of this recipe .* remove it"):
        write_scene_cards(path, splits)


if __name__ == "__main__":
    pytest.main([__file__])
