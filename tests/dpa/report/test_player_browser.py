"""The player in a real browser: what is drawn, what the controls do, and that it asks nothing of a network."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dpa.report.page import write_rollouts
from envs.render import fit_view
from tests.dpa.report.made_rollouts import made_players
from tests.dpa.report.player_reader import SETTLE, Player

RING, ROAD = [227, 0, 27], [245, 159, 0]


@pytest.fixture(scope="module")
def page_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rollouts(tmp_path_factory.mktemp("page") / "play.html", made_players(), {"made": "by hand"})


@pytest.fixture
def open_player(chromium: Any, page_path: Path) -> Iterator[Callable[..., Player]]:
    """Opens the page; afterwards the browser must have had nothing to complain of, and nothing to ask."""
    opened, said, asked = [], [], []

    def open_with(**options: Any) -> Player:
        page = chromium.new_page(**{"viewport": {"width": 1200, "height": 1000}, **options})
        opened.append(page)
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(page_path.as_uri())
        page.evaluate(SETTLE)
        return Player(page)

    yield open_with
    for page in opened:
        page.close()
    assert said == []
    assert asked == [page_path.as_uri()] * len(opened)


@pytest.fixture
def player(open_player: Callable[..., Player]) -> Player:
    return open_player()


# --- what is there --------------------------------------------------------------------------------------------------
def test_it_opens_with_the_most_likely_rollout_of_the_first_method(player: Player) -> None:
    assert player.options("method") == ["reference", "DPA-OMF"]
    shown = r"\d\w\w of 4 · distance [\d.]+ · −1\.00 nats per token · most likely"
    assert re.fullmatch(shown, player.chosen("rollout"))
    assert "reference" in player.text("roll-name") and "−1.00 nats" in player.text("roll-name")
    assert player.text("clock") == "+0.0 s"


def test_every_control_has_a_name_that_a_screen_reader_can_tell(player: Player) -> None:
    unnamed = player.page.evaluate(
        """() => [...document.querySelectorAll("#player select, #player input, #player button, #player canvas")]
            .filter(e => !(e.getAttribute("aria-label") || e.labels?.[0]?.innerText.trim() || e.innerText?.trim()))
            .map(e => e.id)"""
    )
    assert unnamed == []


# --- time -----------------------------------------------------------------------------------------------------------
def test_play_advances_the_clock_and_pause_stops_it(player: Player) -> None:
    before = player.picture("roll")
    player["play"].click()
    player.wait_past(0.3)
    assert player.text("play") == "pause" and player.picture("roll") != before
    player.click("play")
    stopped = player.text("clock")
    player.page.wait_for_timeout(250)
    assert player.text("clock") == stopped and player.text("play") == "play"


def test_it_stops_at_the_end_and_plays_again_from_now(player: Player) -> None:
    player.at(7.8)
    player["speed"].select_option("4")
    player["play"].click()
    player.page.wait_for_function("() => document.getElementById('player-play').textContent === 'play'")
    assert player.text("clock") == "+8.0 s"
    player["play"].click()
    player.page.wait_for_function("() => parseFloat(document.getElementById('player-clock').value.slice(1)) < 6")


def test_scrubbing_sets_the_time_of_both_pictures(player: Player) -> None:
    before = player.picture("log"), player.picture("roll")
    player.at(3.5)
    assert player.text("clock") == "+3.5 s"
    assert player.picture("log") != before[0] and player.picture("roll") != before[1]
    player.at(-1.0)
    assert player.text("clock") == "−1.0 s"


def test_up_to_now_both_sides_show_the_log(player: Player) -> None:
    player["paths"].uncheck()
    player.at(-0.5)
    assert player.picture("log") == player.picture("roll")
    player.at(5.0)
    assert player.picture("log") != player.picture("roll")


def test_keys_play_and_step(player: Player) -> None:
    player["roll"].focus()
    player.page.keyboard.press("ArrowRight")
    player.page.evaluate(SETTLE)
    assert player.text("clock") == "+0.1 s"
    player.page.keyboard.press("ArrowLeft")
    player.page.evaluate(SETTLE)
    assert player.text("clock") == "+0.0 s"
    player.page.keyboard.press("Space")
    player.wait_past(0.1)


# --- what is chosen -------------------------------------------------------------------------------------------------
def test_another_method_draws_its_own_most_likely_rollout_at_the_same_time(player: Player) -> None:
    player.at(6.0)
    roll = player.picture("roll")
    player.choose("method", "DPA-OMF")
    assert "DPA-OMF" in player.text("roll-name") and "−0.500 nats" in player.text("roll-name")
    assert player.chosen("rollout").endswith("most likely")
    assert player.picture("roll") != roll and len(player.options("rollout")) == 2
    assert player.text("clock") == "+6.0 s"


def test_another_rollout_is_drawn_and_told(player: Player) -> None:
    player.at(6.0)
    before = player.picture("roll")
    player.choose("rollout", re.compile("1st of 4"))
    assert "distance 0.0" in player.text("roll-name") and player.picture("roll") != before
    player.click("likely")
    assert "−1.00 nats" in player.text("roll-name") and player.picture("roll") == before


def test_the_order_sorts_the_list_and_keeps_the_rollout(player: Player) -> None:
    def numbers(pattern: str) -> list[float]:
        return [float(re.search(pattern, text)[1].replace("−", "-")) for text in player.options("rollout")]

    assert numbers(r"distance ([\d.]+)") == sorted(numbers(r"distance ([\d.]+)"))
    shown = player.text("roll-name")
    player.choose("sort", "likelihood")
    assert numbers(r"(−[\d.]+) nats per token") == [-1.0, -1.5, -2.0, -3.0]
    assert player.options("rollout")[0].startswith("1st of 4") and player.chosen("rollout").endswith("most likely")
    assert player.text("roll-name") != shown and "1st of 4" in player.text("roll-name")


def test_another_scene_shows_its_lights(player: Player) -> None:
    red = [193, 18, 31]
    assert player.count("log", red) == 0
    player.choose("scene", "red_light")
    assert player.count("log", red) > 20 and player.count("roll", red) > 20


# --- mishaps --------------------------------------------------------------------------------------------------------
def test_agents_that_collide_are_ringed_at_the_steps_at_which_they_do(player: Player) -> None:
    for seconds, colliding in ((2.0, 0), (2.1, 2), (3.0, 2), (3.1, 0)):
        player.at(seconds)
        assert (player.count("roll", RING) > 100) == (colliding > 0), seconds
        assert f"{colliding} in collision" in player.text("roll-name")
        assert player.count("log", RING) == 0 and "0 in collision" in player.text("log-name")
    player.at(2.5)
    player["marks"].uncheck()
    player.page.evaluate(SETTLE)
    assert player.count("roll", RING) == 0


def test_agents_that_leave_the_road_are_hatched(player: Player) -> None:
    player.at(4.0)
    assert player.count("roll", ROAD) == 0 and "0 left the road" in player.text("roll-name")
    player.at(4.1)
    assert player.count("roll", ROAD) > 30 and "1 left the road" in player.text("roll-name")
    assert "0 left the road" in player.text("log-name")


def test_who_was_off_the_road_from_the_start_has_not_left_it(chromium: Any, tmp_path: Path) -> None:
    players = made_players()[:1]
    players[0].scene.agents.position[2, :, 1] -= 6.0
    page = chromium.new_page()
    page.goto(write_rollouts(tmp_path / "play.html", players, {}).as_uri())
    player = Player(page)
    player.at(6.0)
    assert "0 left the road, 1 is off it from the start" in player.text("log-name")
    page.close()


def test_the_time_bar_marks_the_steps_of_mishaps(player: Player) -> None:
    assert player.count("strip", RING) > 50 and player.count("strip", ROAD) > 200
    player.choose("rollout", re.compile("1st of 4"))
    assert player.count("strip", RING) == player.count("strip", ROAD) == 0
    width = player["strip"].bounding_box()["width"]
    player.click("strip", position={"x": 8 + (width - 16) * 50 / 90, "y": 8})
    assert player.text("clock") == "+4.0 s"


# --- the coupling ---------------------------------------------------------------------------------------------------
def test_the_agent_that_pays_most_is_offered_first_with_its_coupling(player: Player) -> None:
    shares = [int(re.search(r"(\d+) % of the distance", text)[1]) for text in player.options("agent")]
    assert shares == sorted(shares, reverse=True) and sum(shares) == pytest.approx(100, abs=2)
    assert player.chosen("agent") == player.options("agent")[0]
    assert player.text("sentence").startswith(player.chosen("agent").split(" · ")[0].capitalize())
    assert "most of it for" in player.text("sentence")


def test_the_matrix_follows_the_time_and_sets_it(player: Player) -> None:
    before = player.picture("matrix")
    player.at(6.0)
    assert player.picture("matrix") != before
    assert re.match(r"At \+6\.0 s the rollout is coupled with \+\d\.\d s of the log", player.text("moment"))
    player.click("matrix", position={"x": 150, "y": 150})
    assert player.text("clock") != "+6.0 s"


def test_a_rollout_that_is_the_log_lies_on_the_diagonal(player: Player) -> None:
    player.choose("rollout", re.compile("1st of 4"))
    player.at(5.0)
    assert "pays nothing" in player.text("sentence")
    assert player.text("moment") == "At +5.0 s the rollout is coupled with +5.0 s of the log, at a cost of 0.0."


def test_another_agent_changes_matrix_and_sentence(player: Player) -> None:
    matrix, sentence = player.picture("matrix"), player.text("sentence")
    player.choose("agent", player.options("agent")[1])
    assert player.picture("matrix") != matrix and player.text("sentence") != sentence


def test_a_click_on_an_agent_in_either_picture_chooses_it(player: Player) -> None:
    view, side = fit_view(made_players()[0].scene), player["log"].bounding_box()["width"]
    scale = side / 2 / view.radius
    # Now the cars stand in file along x, 15 m apart, the first one at 0.
    for picture, number in (("log", 2), ("roll", 1), ("roll", 3)):
        x, y = -15.0 * (number - 1), -2.5
        place = {"x": side / 2 + (x - view.x) * scale, "y": side / 2 - (y - view.y) * scale}
        player.click(picture, position=place)
        assert player.chosen("agent").split(" · ")[0].endswith(f" {number}")


# --- moving about ---------------------------------------------------------------------------------------------------
def test_dragging_zooming_and_resetting_move_both_pictures(player: Player) -> None:
    before = player.picture("log")
    box = player["log"].bounding_box()
    player.page.mouse.move(box["x"] + 100, box["y"] + 100)
    player.page.mouse.down()
    player.page.mouse.move(box["x"] + 160, box["y"] + 130, steps=4)
    player.page.mouse.up()
    player.page.evaluate(SETTLE)
    dragged = player.picture("log")
    assert dragged != before
    player.click("in")
    assert player.picture("log") != dragged
    player.click("fit")
    assert player.picture("log") == before


@pytest.mark.parametrize("width", [320, 390, 768, 1200])
def test_nothing_is_wider_than_the_screen(open_player: Callable[..., Player], width: int) -> None:
    player = open_player(viewport={"width": width, "height": 844}, has_touch=True)
    assert player.page.evaluate("document.documentElement.scrollWidth") <= width
    log, roll = (player[name].bounding_box() for name in ("log", "roll"))
    assert (roll["y"] > log["y"] + log["height"] - 1) == (width < 700)
    assert log["width"] > 0.8 * width or width > 700


def test_two_fingers_zoom_and_choose_nobody(open_player: Callable[..., Player]) -> None:
    player = open_player(viewport={"width": 390, "height": 844}, has_touch=True)
    before, chosen, box = player.picture("log"), player.chosen("agent"), player["log"].bounding_box()
    touch = player.page.context.new_cdp_session(player.page)

    def fingers(kind: str, *away: float) -> None:
        middle = box["x"] + box["width"] / 2
        points = [{"x": middle + x, "y": box["y"] + 60, "id": number} for number, x in enumerate(away)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", -20, 20)
    for step in range(1, 8):
        fingers("touchMove", -20 - 10 * step, 20 + 10 * step)
    fingers("touchEnd")
    player.page.evaluate(SETTLE)
    assert player.picture("log") != before and player.chosen("agent") == chosen
    scale = player.page.evaluate("visualViewport.scale")
    assert scale == 1
    player.click("fit")
    assert player.picture("log") == before


def test_a_tap_plays(open_player: Callable[..., Player]) -> None:
    player = open_player(viewport={"width": 390, "height": 844}, has_touch=True, device_scale_factor=2)
    player["play"].tap()
    player.wait_past(0.2)


if __name__ == "__main__":
    pytest.main([__file__])
