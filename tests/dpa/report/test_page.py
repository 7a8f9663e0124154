"""The page is one valid, self-contained file."""

from __future__ import annotations

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from dpa.report.page import Picture, write_page
from dpa.report.player import PlayerScene
from envs.sources.synthetic import straight_road
from tests.dpa.report.made_rollouts import judged, slower

VOID = {"meta", "br", "img", "input", "hr", "link"}


class Page(HTMLParser):
    """Checks that every element is closed in order, and collects text, attributes and scripts."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.text: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.data = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open.pop() == tag, f"</{tag}> closes nothing, open are {self.open}"

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["script"]:
            self.data = self.data or data
        elif self.open[-1:] != ["style"]:
            self.text.append(data)


@pytest.fixture
def players() -> list[PlayerScene]:
    evil = straight_road(2)
    evil.scene_id = "<img src=x> </script> & <!--{config}-->"
    two, one = judged(evil, [slower(evil, 9), slower(evil, 5)], [-2.0, -1.0]), judged(evil, [slower(evil, 7)], [-1.5])
    rollouts = {"reference": two, "DPA </script><b>": one}
    return [PlayerScene(straight_road(2), rollouts), PlayerScene(evil, rollouts)]


@pytest.fixture
def page(comparison: dict[str, Any], players: list[PlayerScene], tmp_path: Path) -> str:
    Image.new("RGB", (4, 4)).save(tmp_path / "figure.png")
    figures = [Picture(tmp_path / "figure.png", 'A "figure" & <more>. Second sentence.')]
    config = {"name": "<script>", "mark": "<!--{title}-->"}
    return write_page(tmp_path / "out", comparison, figures, players, config=config).read_text(encoding="utf-8")


def test_the_page_is_balanced_html_and_every_mark_was_filled(page: str) -> None:
    parsed = Page(page)
    assert "DPA-OMF is 0.018 more realistic" in "".join(parsed.text)
    assert not re.search(r"<!--\{", page)
    identities = [value for _, name, value in parsed.attributes if name == "id"]
    assert len(identities) == len(set(identities))


def test_the_page_asks_nothing_of_a_network(page: str) -> None:
    assert not re.search(r"https?:|//[\w-]+\.\w|@import|url\(", page)
    for tag, name, value in Page(page).attributes:
        assert name not in ("href", "action", "srcset"), (tag, name, value)
        assert name != "src" or value.startswith("data:image/png;base64,")
    assert "default-src 'none'" in page


def test_text_of_others_is_shown_and_not_run(page: str) -> None:
    text = "".join(Page(page).text)
    for wanted in (
        "made & up <by hand>",
        "python -m recipes.compare 'name=<b>'",
        '"name": "<script>"',
        "<!--{title}-->",
    ):
        assert wanted in text
    assert page.count("<script") == 2


def test_the_page_shows_table_command_versions_and_times(page: str) -> None:
    text = " ".join("".join(Page(page).text).split())
    for wanted in ("+0.018 [+0.006, +0.030]", "–", "torch 2.13.0", "1 h 6 min", "align 2 min 5 s", "54 eval", "2024"):
        assert wanted in text, wanted


def test_the_player_data_hold_scenes_and_every_method(page: str) -> None:
    data = json.loads(Page(page).data)
    assert [scene["id"] for scene in data["scenes"]][1].startswith("<img src=x> </script>")
    assert [len(given["kept"]) for given in data["scenes"][0]["rollouts"].values()] == [2, 1]


def test_the_page_is_replaced_whole_and_kept_on_failure(page: str, comparison: dict[str, Any], tmp_path: Path) -> None:
    comparison["rows"][0]["realism"] = math.nan
    with pytest.raises(ValueError, match="NaN"):
        write_page(tmp_path / "out", comparison, config={})
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["index.html"]
    assert (tmp_path / "out" / "index.html").read_text(encoding="utf-8") == page


def test_without_scenes_there_is_no_player(comparison: dict[str, Any], tmp_path: Path) -> None:
    text = write_page(tmp_path, comparison, config={}).read_text(encoding="utf-8")
    assert "<canvas" not in text and "<script" not in text
    Page(text)


def test_a_missing_key_and_a_figure_that_is_no_png_are_named(comparison: dict[str, Any], tmp_path: Path) -> None:
    del comparison["versions"]
    with pytest.raises(ValueError, match="no versions"):
        write_page(tmp_path, comparison, config={})
    comparison["versions"] = {}
    (tmp_path / "x.png").write_text("text")
    with pytest.raises(ValueError, match=r"x\.png is not a PNG"):
        write_page(tmp_path, comparison, [Picture(tmp_path / "x.png", "x")], config={})


if __name__ == "__main__":
    pytest.main([__file__])
