"""What a study is handed on as: the same numbers, and nothing that is heavy or belongs to others."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from dpa.report.cards import read_preference_cards
from recipes.report import report
from tests.dpa.report.runs import write_runs


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_runs(tmp_path_factory.mktemp("study"))
    trained = folder / "seed_0" / "dpa_omf"
    (trained / "checkpoints").mkdir()
    (trained / "wandb" / "offline-run").mkdir(parents=True)
    for file in ("policy.pt", "checkpoints/state.json", ".partial-eval.json", "wandb/offline-run/metadata.json"):
        (trained / file).write_text("{}")
    return folder


@pytest.fixture(scope="module")
def archive(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return report(runs, tmp_path_factory.mktemp("out") / "new" / "study.zip")


def test_tables_made_from_it_are_the_same(runs: Path, archive: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(archive).extractall(tmp_path / "again")
    one, other = (report(each, tmp_path / f"{each.name}.md").read_text() for each in (runs, tmp_path / "again"))
    assert one == other


def test_a_page_is_made_from_it(archive: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(archive).extractall(tmp_path / "again")
    page = report(tmp_path / "again", tmp_path / "page.html").read_text(encoding="utf-8")
    for file in (tmp_path / "again" / "experiments").glob("*.json"):
        assert f'id="experiment-{file.stem}"' in page


def test_it_holds_the_values_behind_every_row_and_the_curves_and_neither_weights_nor_scenes(
    runs: Path, archive: Path
) -> None:
    names = set(zipfile.ZipFile(archive).namelist())
    kept = {file.relative_to(runs).as_posix() for file in runs.rglob("*.csv")} | {"stages.json", "scenes.json"}
    kept |= {file.relative_to(runs).as_posix() for file in runs.glob("seed_*/*/eval_*.json")}
    assert kept <= names
    unwanted = ("players.json", "wandb/", "checkpoints/", "preferences_", ".partial-", ".pt")
    assert not [name for name in names if any(part in name for part in unwanted)]


def test_equal_studies_give_equal_files(runs: Path, archive: Path, tmp_path: Path) -> None:
    assert report(runs, tmp_path / "again.zip").read_bytes() == archive.read_bytes()


def test_scenes_can_be_called_by_number_and_the_numbers_stay(tmp_path: Path) -> None:
    mine = write_runs(tmp_path / "study")
    named = sorted(mine.glob("seed_*/*/eval_*.json"))
    for file in named:
        content = json.loads(file.read_text())
        names = [f"recording {place:x}" for place in range(len(content["per_scene"]["realism"]))]
        file.write_text(json.dumps(content | {"scenes": names}))
    archive = zipfile.ZipFile(report(mine, tmp_path / "study.zip", numbered=True))
    assert named and not [name for name in archive.namelist() if b"recording" in archive.read(name)]
    for file in named:
        kept = json.loads(archive.read(file.relative_to(mine).as_posix()))
        assert kept["scenes"][1] == "scene 1" and kept["per_scene"] == json.loads(file.read_text())["per_scene"]
    with pytest.raises(ValueError, match=r"--number-scenes is for results.zip; page.html shows scenes by their names"):
        report(mine, tmp_path / "page.html", numbered=True)


def test_the_cards_of_ranked_rollouts_are_in_it_without_their_stores(runs: Path, archive: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(archive).extractall(tmp_path)
    assert not list(tmp_path.glob("seed_*/preferences_*"))
    one, other = (
        {name: card.to_json() for name, card in read_preference_cards(each).items()} for each in (runs, tmp_path)
    )
    assert one == other != {}
    assert report(tmp_path, tmp_path.parent / "twice.zip").read_bytes() == archive.read_bytes()


@pytest.mark.parametrize(
    ("content", "told"), [("[]", "it is [], which it must not be"), ('{"a": {"scenes": -1}}', "card is {'scenes': -1}")]
)
def test_a_file_of_cards_that_holds_something_else_is_named(tmp_path: Path, content: str, told: str) -> None:
    (tmp_path / "preferences.json").write_text(content)
    with pytest.raises(ValueError, match=r"preferences\.json holds no cards of ranked rollouts .*; remove it") as error:
        read_preference_cards(tmp_path)
    assert told in str(error.value)
