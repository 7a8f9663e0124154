"""The page is one valid, self-contained file; what the player unpacks is what was packed."""

from __future__ import annotations

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from dpa.report.page import Picture, write_page
from dpa.report.player import PlayerScene, pack_players, pack_tracks, simplified
from envs.render import pose_tracks
from envs.scene import AgentKind, Scene
from envs.sources.synthetic import red_light, straight_road, two_cars_head_on

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


def unpack(track: list[int | None]) -> list[tuple[int, int, int] | None]:
    """What the player's script does, in whole centimetres."""
    poses, pose, rest = [], np.zeros(3, dtype=int), iter(track)
    for item in rest:
        if item is None:
            poses.append(None)
            continue
        pose = pose + np.array((item, next(rest), next(rest)))
        poses.append(tuple(pose.tolist()))
    return poses


@pytest.fixture
def players() -> list[PlayerScene]:
    rollouts = {"reference": torch.rand(2, 2, 80, 3) * 50, "DPA </script><b>": torch.zeros(1, 2, 80, 3)}
    evil = two_cars_head_on()
    evil.scene_id = "<img src=x> </script> & <!--{config}-->"
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
    assert [len(rollouts) for rollouts in data["scenes"][0]["rollouts"].values()] == [2, 1]


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


@pytest.mark.parametrize("shape", [(2, 80, 3), (1, 3, 80, 3), (1, 2, 79, 3), (0, 2, 80, 3)])
def test_rollouts_that_do_not_fit_are_refused_with_scene_and_method(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"straight_road_2_None, method 'm': .*A'=2"):
        pack_players([PlayerScene(straight_road(2), {"m": torch.zeros(shape)})])


@settings(max_examples=25, deadline=None)
@given(st.lists(st.one_of(st.none(), st.tuples(*[st.floats(-900, 900)] * 3)), min_size=1, max_size=12))
def test_packed_tracks_unpack_to_the_rounded_poses(poses: list[tuple[float, float, float] | None]) -> None:
    rows = torch.tensor([[pose or (math.nan,) * 3 for pose in poses]], dtype=torch.float64)
    (packed,) = pack_tracks(rows)
    expected = [None if pose is None else tuple(round(value * 100) for value in pose) for pose in poses]
    for found, want in zip(unpack(packed), expected, strict=True):
        assert (found is None) == (want is None)
        assert found is None or np.abs(np.subtract(found, want)).max() <= 1


def test_the_packed_log_is_the_log_and_absent_agents_stay_absent() -> None:
    scene = straight_road(2)
    scene.agents.valid[1, 20:] = False
    scene.agents.kind[1] = AgentKind.PEDESTRIAN
    data = pack_players([PlayerScene(scene, {})])
    packed = data["scenes"][0]
    assert [data["classes"][index]["name"] for index in packed["class"]] == ["SDC", "Pedestrian"]
    tracks = [unpack(track) for track in packed["log"]]
    assert tracks[1][20:] == [None] * 71
    log: Tensor = pose_tracks(scene)
    np.testing.assert_allclose(np.array(tracks[0]) / 100, log[0].numpy(), atol=0.0051)


def test_lights_are_packed_step_by_step() -> None:
    scene: Scene = red_light()
    scene.lights.state[0, 5] = -1
    (light,) = pack_players([PlayerScene(scene, {})])["scenes"][0]["lights"]
    assert light["at"] == [2000, -250]
    assert [step for step, group in enumerate(light["groups"]) if group != "stop"] == [5]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=15))
def test_a_simplified_line_keeps_its_ends_and_stays_near_its_points(points: list[tuple[float, float]]) -> None:
    line = np.array(points)
    keep = simplified(line, 0.5)
    assert keep[0] and keep[-1]
    kept = keep.nonzero()[0]
    for index in (~keep).nonzero()[0]:
        start, end = line[kept[kept < index][-1]], line[kept[kept > index][0]]
        chord = end - start
        along = np.clip((line[index] - start) @ chord / max(chord @ chord, 1e-12), 0, 1)
        assert np.linalg.norm(line[index] - start - along * chord) <= 0.5 + 1e-9


if __name__ == "__main__":
    pytest.main([__file__])
