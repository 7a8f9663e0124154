"""The data card, its annotation time, and the command line that prints it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from dpa.preferences import PreferenceStore, PreferenceWriter, data_card
from dpa.preferences.__main__ import main
from dpa.preferences.card import DataCard, annotation_seconds
from dpa.preferences.examples import example_groups, example_provenance
from envs import keys
from envs.scene import AgentKind


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A store of three scenes, one of which has all rollouts at one distance."""
    groups = example_groups(3)
    groups[keys.DISTANCE][:2] = torch.tensor([[0.0, 1, 2, 3, 4, 5, 6, 7], [7.0, 6, 5, 4, 3, 2, 1, 0]])
    groups[keys.DISTANCE][2] = 3.0
    groups[keys.ADE] = torch.arange(8.0).expand(3, 8).clone()
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        writer.append(groups)
    return tmp_path


def test_card_of_a_hand_case(folder: Path) -> None:
    card = data_card(PreferenceStore(folder))
    assert (card.scenes, card.rollouts, card.pairs, card.agents) == (3, 8, 2, 2 + 3 + 4)
    assert card.tied_scenes == 1
    assert card.tied_pairs == pytest.approx(1 / 3)
    assert card.margin == pytest.approx((7 + 5 + 7 + 5 + 0 + 0) / 6)
    assert card.spearman == pytest.approx(0)
    assert card.same_side == pytest.approx((1 + 1 + 0 + 0 + 0.5 + 0.5) / 6)
    seconds = 0.7 + 4.2 * torch.tensor([1, 2, 3]).double() / 9
    assert card.human_hours == pytest.approx(float(seconds.sum()) * 2 / 3600)


def test_the_card_tells_classes_and_features_apart(tmp_path: Path) -> None:
    groups = example_groups(3)
    groups[keys.AGENT_KIND][2, 3] = AgentKind.OTHER
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        writer.append(groups)
    card = data_card(PreferenceStore(tmp_path))
    ranked = groups[keys.AGENT_RANKED]
    for name, kind in (("vehicle", 1), ("pedestrian", 2), ("cyclist", 3), ("other", 4)):
        rows = ranked & (groups[keys.AGENT_KIND] == kind)
        assert card.classes[name].agents == int(rows.sum())
        mean = groups[keys.AGENT_DISTANCE].transpose(1, 2)[rows].mean()
        assert card.classes[name].distance == pytest.approx(float(mean))
    shares = groups[keys.FEATURE_SHARE].mean((0, 1)).tolist()
    assert card.feature_shares == pytest.approx({"speed": shares[0], "effort": shares[1]})
    assert card.scene_bytes == sum(path.stat().st_size for path in tmp_path.glob("chunk-*")) / 3


def test_a_card_without_agents_or_shares_is_a_card(tmp_path: Path) -> None:
    groups = example_groups(1)
    groups[keys.AGENT_RANKED].zero_()
    groups[keys.AGENT_DISTANCE].zero_()
    groups[keys.DISTANCE].zero_()
    groups[keys.FEATURE_SHARE] = torch.empty(1, 8, 0)
    with PreferenceWriter(tmp_path, example_provenance()) as writer:
        writer.append(groups)
    card = data_card(PreferenceStore(tmp_path))
    assert card.agents == 0 and card.tied_scenes == 1 and card.feature_shares == {}
    assert card.to_json()["spearman"] is None and card.to_json()["classes"]["cyclist"]["distance"] is None
    assert "not stored" in str(card)
    again = DataCard.from_json(json.loads(json.dumps(card.to_json())))
    assert again.to_json() == card.to_json() and str(again) == str(card)


def test_annotation_time_meets_the_points_of_the_paper_and_stays_beyond_the_last() -> None:
    agents = torch.tensor([1, 10, 20, 30, 40, 80, 128])
    assert annotation_seconds(agents).tolist() == pytest.approx([0.7, 4.9, 9.8, 19.6, 29.4, 42.1, 42.1])


def test_info_prints_card_and_origin_and_writes_them(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", str(folder), "--pairs", "4", "--json", str(tmp_path / "card.json")]) == 0
    printed = capsys.readouterr().out
    assert "12 (4 per scene" in printed
    assert "distance made of     speed" in printed
    assert '"vocab_size": 169' in printed
    card = json.loads((tmp_path / "card.json").read_text())
    assert card["pairs"] == 4 and card["origin"]["vocab_size"] == 169 and card["classes"]["vehicle"]["agents"] == 4


def test_verify_tells_a_sound_store_from_a_damaged_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(folder)]) == 0
    chunk = next(folder.glob("chunk-*"))
    chunk.write_bytes(chunk.read_bytes()[:-1])
    assert main(["verify", str(folder)]) == 1
    assert f"{chunk.name} is not what its name says" in capsys.readouterr().out


def test_a_wrong_folder_or_too_many_pairs_end_with_one_clear_line(folder: Path, tmp_path: Path, capsys) -> None:
    assert main(["info", str(tmp_path / "nowhere")]) == 1
    assert main(["info", str(folder), "--pairs", "5"]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "no preference store" in lines[0]
    assert "5 disjoint pairs need 10 rollouts" in lines[1]
