"""What all figures share: colours, a canvas of their own, quiet axes, and files that appear whole."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from envs.files import whole

INK, QUIET, RULE = "#3c4043", "#8b9096", "#e3e5e8"
VERDICTS = {"better": "#2a78b5", "worse": "#d55e00", "open": "#8b9096"}
"""Colours of what may be said of a difference; see :func:`dpa.report.statistics.verdict`."""
CYCLE = (
    "#2a78b5", "#d55e00", "#009e73", "#b0509a", "#c79a1b", "#56b4e9", "#6b6b6b",
    "#7a4b2a", "#1b3a7a", "#c1121f", "#7d8f00", "#8f7fe0", "#00a6a6", "#f08fb0",
    "#000000",
)  # fmt: skip
"""Colours of what is told apart; the first seven also by those who see few colours."""


def blank_figure(width: float, height: float) -> Figure:
    """A figure that belongs to no global state, so that threads and notebooks do not meet in it."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def calm(axes: Axes, grid: str) -> None:
    """Leave of an axes' frame only what is read: the bottom line and a pale grid along ``grid`` (x, y or both)."""
    axes.grid(axis=grid, color=RULE, lw=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=8, width=0.6, color=RULE)
    axes.title.set(fontsize=9, color=INK)
    for side, spine in axes.spines.items():
        spine.set_visible(side == "bottom")
        spine.set_color(RULE)


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a PNG whole or not at all.

    Raises:
        ValueError: another kind of file.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"a figure must end in .png, got {path}.")
    with whole(path) as part:
        figure.savefig(part, format="png", dpi=160)
