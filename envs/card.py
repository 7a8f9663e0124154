"""What a set of scenes holds, as counts that add up: the numbers of a store's data card.

Counts are gathered while scenes are made and added up over shards, so describing a million scenes reads none of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from envs.scene import EDGE_KINDS, LANE_KINDS, LOG_STEPS, STEP_SECONDS, AgentKind, Lacks, LightState, MapKind, Scene

BINS = {
    "agents of a scene": (8.0, "agents"),
    "speed": (1.0, "m/s"),
    "duration": (1.0, "s"),
    "travel": (10.0, "m"),
    "length": (0.5, "m"),
}
"""Histogram -> width of a bin, and the unit. Speeds are of valid states; the others of agents at the current step."""
CLASSES = tuple(kind.name.lower() for kind in AgentKind)
AGENT_COLUMNS = (
    "agents at the current step", "in all", "in a scene", "speed, median / 95 %", "there for", "travel", "length"
)  # fmt: skip
"""Titles of :func:`agent_rows`; what has no other name is a median."""
MAP_COLUMNS = ("map, in a scene", "polylines", "points")
"""Titles of :func:`map_rows`."""


class Card:
    """Counts of scenes.

    Attributes:
        counts: table -> row -> count. Rows of a histogram are the numbers of its bins: row ``"3"`` of a table with bins
            of 8 counts what lies in ``[24, 32)``.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> card = Card()
        >>> card.add(straight_road(num_vehicles=3))
        >>> card.counts["scenes"], card.counts["agents"]
        ({'all': 1, 'with lights': 0}, {'vehicle': 3})
        >>> card.quantile("duration vehicle")
        '9-10'
    """

    def __init__(self, counts: Mapping[str, Mapping[str, int]] | None = None) -> None:
        self.counts: dict[str, dict[str, int]] = {name: dict(rows) for name, rows in (counts or {}).items()}

    def add(self, scene: Scene) -> None:
        """Count one uncollated scene."""
        agents, valid = scene.agents, scene.agents.valid.numpy()
        present, kind = agents.present.numpy(), agents.kind.numpy()
        self._count("scenes", "all", 1)
        self._count("scenes", "with lights", int(len(scene.lights.lane_id) > 0))
        self._count("states", "all", valid.size)
        self._count("states", "valid", int(valid.sum()))
        self._histogram("agents of a scene", np.array([present.sum()]))
        speed = np.linalg.norm(agents.velocity.numpy(), axis=-1)
        for number in np.unique(kind[present]):
            name = CLASSES[number]
            rows = present & (kind == number)
            self._count("agents", name, int(rows.sum()))
            self._histogram(f"speed {name}", speed[rows][valid[rows]], "speed")
            self._histogram(f"duration {name}", valid[rows].sum(1) * STEP_SECONDS, "duration")
            self._histogram(f"travel {name}", (speed[rows] * valid[rows]).sum(1) * STEP_SECONDS, "travel")
            self._histogram(f"length {name}", agents.extent.numpy()[rows, 0], "length")
        self._add_map(scene)
        states, times = np.unique(scene.lights.state.numpy(), return_counts=True)
        for state, count in zip(states.tolist(), times.tolist(), strict=True):
            if state != LightState.ABSENT:
                self._count("light states", LightState(state).name.lower(), count)
        for lack in Lacks(int(scene.lacks)):
            self._count("lacks", lack.name.lower(), 1)

    def merge(self, counts: Mapping[str, Mapping[str, int]]) -> None:
        """Add the counts of other scenes."""
        for table, rows in counts.items():
            for row, count in rows.items():
                self._count(table, row, count)

    def remove(self, counts: Mapping[str, Mapping[str, int]]) -> None:
        """Take away the counts of some of the scenes that were counted; what is left is as if they had never been."""
        for table, rows in counts.items():
            mine = self.counts[table]
            for row, count in rows.items():
                mine[row] -= count
                if not mine[row] and table != "scenes":  # whose rows are there for any scene, also where they are 0
                    del mine[row]
            if not mine:
                del self.counts[table]

    def histogram(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Left edges of the bins of a histogram, and the counts; empty where nothing was counted."""
        rows = self.counts.get(name, {})
        if not rows:
            return np.zeros(0), np.zeros(0, dtype=np.int64)
        counts = np.zeros(max(map(int, rows)) + 1, dtype=np.int64)
        for row, count in rows.items():
            counts[int(row)] = count
        return np.arange(len(counts)) * _width(name), counts

    def quantile(self, name: str, share: float = 0.5) -> str:
        """The bin of a histogram that holds a quantile (the median), as ``low-high``.

        Args:
            name: of a histogram in which something was counted.
            share: of what was counted that lies below.
        """
        numbers, counts = zip(*sorted((int(row), count) for row, count in self.counts[name].items()), strict=True)
        place = int(np.searchsorted(np.cumsum(counts), share * sum(counts)))
        low, width = numbers[place] * _width(name), _width(name)
        return f"{low:g}-{low + width:g}"

    def _add_map(self, scene: Scene) -> None:
        groups = {"lane": LANE_KINDS, "road edge": EDGE_KINDS}
        kind, count = scene.road.kind.numpy(), scene.road.count.numpy()
        for number in np.unique(kind):
            rows = kind == number
            name = next((group for group, kinds in groups.items() if number in kinds), None)
            name = name or ("line" if number < MapKind.EDGE_UNKNOWN else MapKind(number).name.lower().replace("_", " "))
            self._count("polylines", name, int(rows.sum()))
            self._count("points", name, int(count[rows].sum()))

    def _count(self, table: str, row: str, count: int) -> None:
        rows = self.counts.setdefault(table, {})
        rows[row] = rows.get(row, 0) + count

    def _histogram(self, table: str, values: np.ndarray, bins: str | None = None) -> None:
        width, _ = BINS[bins or table]
        numbers, times = np.unique((np.clip(values, 0, 1e6) // width).astype(np.int64), return_counts=True)
        for number, count in zip(numbers.tolist(), times.tolist(), strict=True):
            self._count(table, str(number), count)


def card_text(
    card: Card, title: str, facts: Mapping[str, Any], skipped: Iterable[str], notes: Mapping[str, int]
) -> str:
    """A data card as Markdown; the picture beside it is ``card.png``.

    Args:
        card: counts.
        title: heading.
        facts: name -> value, the first table.
        skipped: errors of the records that gave no scene.
        notes: what readers could not take over -> how often.
    """
    lines = [f"# {title}", "", "![what the scenes hold](card.png)", "", "| | |", "|---|---|"]
    lines += [f"| {name} | {value} |" for name, value in {**facts, **scene_facts(card)}.items()]
    lines += ["", *_markdown(AGENT_COLUMNS, agent_rows(card)), "", *_markdown(MAP_COLUMNS, map_rows(card)), ""]
    lines += _listing("Left out or changed by the reader", [f"{note}: {count} times" for note, count in notes.items()])
    lines += _listing("Records that gave no scene", skipped)
    return "\n".join(lines).rstrip() + "\n"


def scene_facts(card: Card) -> dict[str, str]:
    """What a card says of its scenes, by name.

    Args:
        card: of one scene or more.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> card = Card()
        >>> card.add(straight_road(2))
        >>> scene_facts(card)["agents at the current step"]
        '2 (2.0 in a scene)'
    """
    scenes, states = card.counts["scenes"], card.counts["states"]
    every, agents = scenes["all"], sum(card.counts.get("agents", {}).values())
    lacks = sorted(card.counts.get("lacks", {}).items())
    return {
        "scenes": str(every),
        "scenes with traffic lights": f"{scenes['with lights']} ({scenes['with lights'] / every:.0%})",
        "agents at the current step": f"{agents} ({agents / every:.1f} in a scene)",
        "valid states": f"{states['valid'] / states['all']:.0%} of agents x {LOG_STEPS} steps",
        "lacks": ", ".join(f"{name.replace('_', ' ')} ({count} scenes)" for name, count in lacks) or "nothing",
    }


def agent_rows(card: Card) -> list[list[str]]:
    """One row for each class, of agents that are there at the current step."""
    rows = []
    for name in CLASSES:
        count = card.counts.get("agents", {}).get(name)
        if count:
            low, high = (card.quantile(f"speed {name}", share) for share in (0.5, 0.95))
            others = [f"{card.quantile(f'{what} {name}')} {BINS[what][1]}" for what in ("duration", "travel", "length")]
            per_scene = count / card.counts["scenes"]["all"]
            rows.append([name, str(count), f"{per_scene:.1f}", f"{low} / {high} m/s", *others])
    return rows


def map_rows(card: Card) -> list[list[str]]:
    """One row for each kind of polyline."""
    every, points = card.counts["scenes"]["all"], card.counts.get("points", {})
    polylines = sorted(card.counts.get("polylines", {}).items())
    return [[name, f"{count / every:.1f}", f"{points[name] / every:.0f}"] for name, count in polylines]


def _width(name: str) -> float:
    return next(width for bins, (width, _) in BINS.items() if name.startswith(bins))


def _markdown(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|", *(f"| {' | '.join(row)} |" for row in rows)]


def _listing(title: str, rows: Iterable[str]) -> list[str]:
    rows = list(rows)
    return [f"## {title}", "", *(f"* {row}" for row in rows), ""] if rows else []
