"""A page of rollouts is one valid, self-contained file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dpa.report.page import write_rollouts
from dpa.report.player import PlayerScene
from envs.sources.synthetic import straight_road
from tests.dpa.report.made_rollouts import judged, slower
from tests.dpa.report.parsed import Page


@pytest.fixture
def players() -> list[PlayerScene]:
    evil = straight_road(2)
    evil.scene_id = "<img src=x> </script> & <!--{config}-->"
    two, one = judged(evil, [slower(evil, 9), slower(evil, 5)], [-2.0, -1.0]), judged(evil, [slower(evil, 7)], [-1.5])
    rollouts = {"reference": two, "DPA </script><b>": one}
    return [PlayerScene(straight_road(2), rollouts), PlayerScene(evil, rollouts)]


@pytest.fixture
def page(players: list[PlayerScene], tmp_path: Path) -> str:
    shown = {"policy": "<script>", "mark": "<!--{title}-->"}
    return write_rollouts(tmp_path / "out" / "play.html", players, shown, title="A <b>").read_text(encoding="utf-8")


def test_the_page_is_balanced_html_and_every_mark_was_filled(page: str) -> None:
    parsed = Page(page)
    assert "A <b> Scenes" in parsed.text
    identities = [value for _, name, value in parsed.attributes if name == "id"]
    assert len(identities) == len(set(identities))


def test_the_page_asks_nothing_of_a_network(page: str) -> None:
    assert not re.search(r"https?:|//[\w-]+\.\w|@import|url\(", page)
    assert not [name for _, name, _ in Page(page).attributes if name in ("href", "action", "srcset", "src")]
    assert "default-src 'none'" in page


def test_text_of_others_is_shown_and_not_run(page: str) -> None:
    text = Page(page).text
    assert "<script>" in text and "<!--{title}-->" in text
    assert page.count("<script") == 2


def test_the_player_data_hold_scenes_and_every_method(page: str) -> None:
    (data,) = Page(page).data
    assert [scene["id"] for scene in data["scenes"]][1].startswith("<img src=x> </script>")
    assert [len(given["kept"]) for given in data["scenes"][0]["rollouts"].values()] == [2, 1]


def test_the_page_is_replaced_whole_and_kept_on_failure(page: str, tmp_path: Path) -> None:
    other = straight_road(3)
    misfit = PlayerScene(straight_road(2), {"m": judged(other, [slower(other, 1)], [-1.0])})
    with pytest.raises(ValueError, match="straight_road_2"):
        write_rollouts(tmp_path / "out" / "play.html", [misfit], {})
    with pytest.raises(ValueError, match="at least one scene"):
        write_rollouts(tmp_path / "out" / "play.html", [], {})
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["play.html"]
    assert (tmp_path / "out" / "play.html").read_text(encoding="utf-8") == page


if __name__ == "__main__":
    pytest.main([__file__])
