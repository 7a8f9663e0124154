"""The page of a study in a real browser: nothing fails or asks for a network, figures live, a phone is enough."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from dpa.report.experiment import read_experiment
from dpa.report.table import difference

DRAWN = "body[data-drawn=yes]"
WIDE, PHONE = {"width": 1300, "height": 900}, {"width": 390, "height": 844}


class Opened(NamedTuple):
    """A page in a browser, with what the browser said and asked for since it was opened."""

    page: Any
    said: list[str]
    asked: list[str]


@contextmanager
def open_page(chromium: Any, path: Path, **options: Any) -> Iterator[Opened]:
    page = chromium.new_page(reduced_motion="reduce", **options)  # a scroll is over at once
    opened = Opened(page, [], [])
    page.on("console", lambda message: opened.said.append(f"{message.type}: {message.text}"))
    page.on("pageerror", lambda error: opened.said.append(str(error)))
    page.on("request", lambda request: opened.asked.append(request.url))
    page.goto(path.as_uri())
    page.wait_for_selector(DRAWN)
    yield opened
    page.close()


@pytest.fixture(scope="module")
def opened(chromium: Any, study_page: Path) -> Iterator[Opened]:
    with open_page(chromium, study_page, viewport=WIDE) as opened:
        yield opened


@pytest.fixture
def page(opened: Opened) -> Any:
    opened.page.set_viewport_size(WIDE)
    return opened.page


def test_the_page_loads_without_an_error_and_asks_for_nothing_else(opened: Opened, study_page: Path) -> None:
    assert opened.said == []
    assert opened.asked == [study_page.as_uri()]


def test_every_figure_is_drawn_and_those_of_a_folded_part_when_it_opens(page: Any) -> None:
    plots, drawn = page.locator(".plot"), page.locator(".plot.js-plotly-plot > .plot-container .main-svg:first-child")
    hidden = page.locator("details:not([open]) .plot").count()
    assert hidden and drawn.count() == plots.count() - hidden
    folded = page.locator("details:not([open]):has(.plot) > summary")
    while folded.count():
        folded.first.click()
    page.wait_for_selector(DRAWN)
    assert drawn.count() == plots.count() > 20
    assert all(box["width"] > 200 and box["height"] > 100 for box in (plot.bounding_box() for plot in plots.all()))


def test_a_point_tells_its_interval_and_seeds_when_it_is_pointed_at(page: Any, runs: Path) -> None:
    forest = page.locator("#experiment-methods .plot").first
    forest.scroll_into_view_if_needed()
    point = forest.locator(".scatterlayer path.point").first.bounding_box()
    page.mouse.move(point["x"] + point["width"] / 2 - 30, point["y"] + point["height"] / 2)
    page.mouse.move(point["x"] + point["width"] / 2, point["y"] + point["height"] / 2)
    told = forest.locator(".hoverlayer .hovertext").text_content()
    entries = read_experiment(runs / "experiments" / "methods.json").own_best.paired
    assert any(difference(e["realism_difference"], e["ci95"]) in told for e in entries)
    assert "3 seeds" in told and "by seed" in told


def test_a_figure_can_be_saved_and_never_sent_away(page: Any) -> None:
    forest = page.locator("#experiment-methods .plot").first
    forest.hover()
    buttons = forest.locator(".modebar-btn")
    titles = buttons.evaluate_all("buttons => buttons.map((button) => button.dataset.title)")
    assert titles == ["Download plot", "Zoom", "Pan", "Reset axes"]
    with page.expect_download() as saved:
        buttons.first.click()
    assert Path(saved.value.path()).read_text(encoding="utf-8").startswith("<svg")


def test_a_tab_shows_its_table_and_hides_the_other(page: Any) -> None:
    own, common = page.locator("#experiment-methods [role=tab]").all()
    panels = page.locator("#experiment-methods [role=tabpanel]")
    assert [panel.is_visible() for panel in panels.all()] == [True, False]
    common.click()
    assert [panel.is_visible() for panel in panels.all()] == [False, True]
    assert panels.nth(1).locator("tbody tr").first.inner_text().startswith("reference\ntop-p 0.95")
    common.press("ArrowLeft")
    assert own.get_attribute("aria-selected") == "true"
    assert [panel.is_visible() for panel in panels.all()] == [True, False]


def test_the_index_leads_to_every_section(page: Any) -> None:
    links = page.locator("nav a")
    sections = page.locator("main > section")
    assert links.count() == sections.count()
    links.last.click()
    assert page.evaluate("location.hash") == links.last.get_attribute("href")
    assert page.locator(f"section{links.last.get_attribute('href')}").count() == 1


def test_the_player_draws_its_scene(page: Any) -> None:
    canvas = page.locator("#player-log")
    canvas.scroll_into_view_if_needed()
    colours = canvas.evaluate(
        "c => new Set(new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer)).size"
    )
    assert colours > 5


def test_a_phone_scrolls_tables_and_never_the_page(opened: Opened) -> None:
    page = opened.page
    page.set_viewport_size(PHONE)
    page.wait_for_timeout(500)  # Plotly waits a moment before it fits a figure to a new width
    assert page.evaluate("document.documentElement.scrollWidth") == PHONE["width"]
    boxes = page.locator(".wide")
    assert any(box.evaluate("box => box.scrollWidth > box.clientWidth") for box in boxes.all())
    widths = [svg.bounding_box()["width"] for svg in page.locator(".plot:visible .main-svg:first-child").all()]
    assert widths and max(widths) <= PHONE["width"]
    assert opened.said == []


if __name__ == "__main__":
    pytest.main([__file__])
