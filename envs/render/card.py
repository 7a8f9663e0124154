"""The picture of a data card: what the agents of a set of scenes are and how they move."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from envs.card import BINS, CLASSES, Card
from envs.render.style import AGENT_COLORS, INK_COLOR, LIGHT_GROUP, LIGHT_STYLE
from envs.scene import AgentKind, LightState

_INCHES, _DPI = (11.0, 5.6), 110
_PER_CLASS = (("speed", "of valid states"), ("duration", "of tracks"), ("travel", "of tracks"))


def draw_card(card: Card) -> np.ndarray:
    """``[H, W, 3]`` uint8: agents by class, agents of a scene, lights, and speed, duration and travel by class.

    Args:
        card: counts of one scene or more.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> card = Card()
        >>> card.add(straight_road(3))
        >>> draw_card(card).shape
        (616, 1210, 3)
    """
    figure = Figure(figsize=_INCHES, dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 3)
    _draw_classes(upper[0], card)
    _draw_crowding(upper[1], card)
    _draw_lights(upper[2], card)
    for axes, (name, what) in zip(lower, _PER_CLASS, strict=True):
        _draw_histograms(axes, card, name, what)
    for axes in (*upper, *lower):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8, colors=INK_COLOR)
        axes.title.set_fontsize(9.5)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _draw_classes(axes: Axes, card: Card) -> None:
    counts = card.counts["agents"]
    names = [name for name in CLASSES if name in counts]
    bars = axes.barh(names, [counts[name] for name in names], color=[_color(name) for name in names])
    axes.bar_label(bars, padding=3, fontsize=8, color=INK_COLOR)
    axes.invert_yaxis()
    axes.margins(x=0.18)
    axes.set_title(f"agents at the current step, {card.counts['scenes']['all']} scenes")


def _draw_crowding(axes: Axes, card: Card) -> None:
    edges, counts = card.histogram("agents of a scene")
    axes.bar(edges, counts, width=BINS["agents of a scene"][0] * 0.92, align="edge", color=INK_COLOR)
    axes.set_title("scenes by number of agents")


def _draw_lights(axes: Axes, card: Card) -> None:
    totals = dict.fromkeys(LIGHT_STYLE, 0)
    for name, count in card.counts.get("light states", {}).items():
        totals[LIGHT_GROUP[LightState[name.upper()]]] += count
    every = sum(totals.values())
    shares = [100 * count / every if every else 0.0 for count in totals.values()]
    axes.bar(list(totals), shares, color=[color for _, color in LIGHT_STYLE.values()])
    axes.set_ylim(0, 100)
    scenes = card.counts["scenes"]
    axes.set_title(f"states of lights [%], {scenes['with lights']} of {scenes['all']} scenes have lights")


def _draw_histograms(axes: Axes, card: Card, name: str, what: str) -> None:
    """Shares by class as steps, so that few cyclists show beside many cars."""
    width, unit = BINS[name]
    for label in CLASSES:
        edges, counts = card.histogram(f"{name} {label}")
        if counts.sum():
            shares = 100 * counts / counts.sum()
            axes.stairs(shares, np.append(edges, edges[-1] + width), color=_color(label), lw=1.5, label=label)
    axes.set_yscale("log")
    axes.set_ylim(0.05, 120)
    axes.legend(fontsize=7, frameon=False)
    axes.set_title(f"{name} [{unit}], % {what}")


def _color(name: str) -> str:
    return AGENT_COLORS[AgentKind[name.upper()]]
