"""A small comparison, a small study with everything that a real one has, its page, and a browser to open pages in."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from recipes.report import report
from tests.dpa.report.runs import write_runs

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
"""Names of an installed browser; where there is none, Playwright's own is used."""
QUIET = (
    "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--no-first-run", "--disable-quic",
)  # fmt: skip
"""A browser that asks nothing of a network by itself."""


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A headless Chromium (a Playwright ``Browser``); tests that open pages are skipped where there is none."""
    api = pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install -e .[dev]")
    installed = next(filter(None, map(shutil.which, BROWSERS)), None)
    with api.sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=installed, args=list(QUIET))
        except api.Error as error:
            pytest.skip(f"needs a browser: install chromium, or playwright install chromium ({error.message[:200]})")
        yield browser
        browser.close()


@pytest.fixture
def comparison() -> dict[str, Any]:
    """Two methods with two seeds each against a reference that was sampled in two ways."""

    def row(method: str, seed: int, top_p: float, realism: float, pair_accuracy: float | None) -> dict[str, Any]:
        return {
            "method": method, "seed": seed, "top_p": top_p, "n_scenes": 54, "kinematic": 0.4, "interactive": 0.75,
            "map_based": 0.8, "realism": realism, "min_ade": 1.4, "collision_rate": 0.2, "offroad_rate": 0.1,
            "preference_distance": 5.0, "pair_accuracy": pair_accuracy,
        }  # fmt: skip

    return {
        "metric": "2024",
        "scenes": {"train": 100, "tune": 24, "eval": 54, "source": "made & up <by hand>"},
        "rows": [
            row("reference", 0, 0.95, 0.700, None),
            row("reference", 0, 0.85, 0.705, None),
            row("DPA-OMF", 0, 0.95, 0.716, 0.62),
            row("DPA-OMF", 1, 0.95, 0.720, 0.66),
            row("DPA-ADEF", 0, 0.95, 0.702, 0.6),
            row("DPA-ADEF", 1, 0.95, 0.704, 0.6),
        ],
        "paired": [
            {"method": "DPA-OMF", "realism_difference": 0.018, "ci95": [0.006, 0.03], "over": "seeds and scenes",
             "n_seeds": 2},
            {"method": "DPA-ADEF", "realism_difference": 0.003, "ci95": [-0.004, 0.01], "over": "seeds and scenes",
             "n_seeds": 2},
        ],
        "per_scene": {},
        "seeds": [0, 1],
        "stages": {"pretrain": 3600.0, "align": 125.0},
        "worker_seconds": 4000.0,
        "versions": {"torch": "2.13.0"},
        "command": "python -m recipes.compare 'name=<b>'",
    }  # fmt: skip


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of results with everything in it; tests that change it copy it first."""
    return write_runs(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="session")
def study_page(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its page, in a folder of its own."""
    return report(runs, tmp_path_factory.mktemp("page"))


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Figures that were saved."""
    saved, save = [], Figure.savefig

    def keep(figure: Figure, *args: Any, **options: Any) -> None:
        saved.append(figure)
        save(figure, *args, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    return saved
