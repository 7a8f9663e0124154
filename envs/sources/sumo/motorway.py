"""A stretch of motorway: two carriageways with a median, on- and off-ramps, lanes to speed up and to slow down on.

Each carriageway is drawn from its own left border, lanes to the right of it. Along it, in its direction, lie either an
off-ramp and then an on-ramp (an interchange), or an on-ramp and then an off-ramp that share one extra lane (weaving:
those who enter and those who leave cross each other).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from envs.sources.sumo.plain import PlainEdge, PlainRoads

SPACING = 5.0
"""Between two points of a line that is drawn [m]."""
RAMP_LENGTH = 160.0
"""What is drawn of a ramp, from the motorway to the end of the world [m]."""
LEAD = 0.15
"""Share of the axis before the first extra lane."""


@dataclass(frozen=True)
class Axis:
    """A line with headings.

    Attributes:
        points: ``[n, 2]``, :data:`SPACING` apart [m].
        heading: ``[n]`` [rad].
    """

    points: np.ndarray
    heading: np.ndarray

    @property
    def length(self) -> float:
        """Along the line [m]."""
        return SPACING * (len(self.points) - 1)

    def back(self) -> Axis:
        """The same line in the other direction."""
        return Axis(self.points[::-1], self.heading[::-1] + np.pi)

    def aside(self, right: float) -> np.ndarray:
        """``[n, 2]``: the line moved to the right [m].

        Examples:
            >>> Axis(np.array([[0.0, 0.0], [5.0, 0.0]]), np.zeros(2)).aside(2.0).tolist()
            [[0.0, -2.0], [5.0, -2.0]]
        """
        return self.points + right * np.stack((np.sin(self.heading), -np.cos(self.heading)), -1)


def draw_axis(length: float, bends: tuple[float, float]) -> Axis:
    """A line from the origin to the east, in two arcs that meet smoothly.

    Args:
        length: [m].
        bends: how far each half turns to the left [rad].

    Examples:
        >>> axis = draw_axis(100.0, (0.2, -0.2))
        >>> axis.length, float(axis.heading[-1].round(6))
        (100.0, 0.0)
    """
    steps = round(length / SPACING)
    turn = np.repeat(np.asarray(bends) / (steps / 2), [steps // 2, steps - steps // 2])
    heading = np.concatenate(([0.0], np.cumsum(turn)))
    middle = (heading[1:] + heading[:-1]) / 2
    moves = SPACING * np.stack((np.cos(middle), np.sin(middle)), -1)
    return Axis(np.concatenate((np.zeros((1, 2)), np.cumsum(moves, axis=0))), heading)


def draw_ramp(start: np.ndarray, heading: float, radius: float) -> np.ndarray:
    """``[n, 2]``: an arc that leaves a place to the right.

    Args:
        start: ``[2]`` [m].
        heading: there [rad].
        radius: of the arc [m].
    """
    along = np.arange(0.0, RAMP_LENGTH + SPACING / 2, SPACING)
    local = np.stack((radius * np.sin(along / radius), -radius * (1 - np.cos(along / radius))), -1)
    cos, sin = np.cos(heading), np.sin(heading)
    return start + local @ np.array([[cos, sin], [-sin, cos]])


def make_motorway(rules: dict[str, float], rng: np.random.Generator) -> PlainRoads:
    """Roads of one stretch of motorway.

    Args:
        rules: of the preset in ``sumo.yaml``, pairs drawn.
        rng: for what differs between the two carriageways.

    Raises:
        ValueError: the ramps do not fit into the length.
    """
    roads = PlainRoads(node_radius=1.0)
    axis = draw_axis(rules["length"], (rules["bend"], rules["second_bend"]))
    for name, line in (("east", axis), ("west", axis.back())):
        weaving = bool(rng.random() < rules["weaving"])
        _add_carriageway(roads, name, line, rules, weaving, rng)
    return roads


def _add_carriageway(
    roads: PlainRoads, name: str, axis: Axis, rules: dict[str, float], weaving: bool, rng: np.random.Generator
) -> None:
    """One direction in five pieces, or three where it weaves; every second one has an extra lane."""
    border = axis.aside(rules["median"] / 2)
    last = len(border) - 1
    extra = round(rules["ramp_lane"] / SPACING)
    first = round(last * (LEAD + rng.uniform(0, 0.05)))
    if weaving:
        cuts, wide = [0, first, first + 2 * extra, last], (1,)
    else:
        # an off-ramp ends before the on-ramp begins
        gap = round(2.2 * RAMP_LENGTH / SPACING)
        cuts, wide = [0, first, first + extra, first + extra + gap, first + 2 * extra + gap, last], (1, 3)
    if cuts[-2] >= last:
        raise ValueError(f"a motorway of {rules['length']} m is too short for its ramps; make `length` longer.")
    lanes = rules["lanes"]
    for i, cut in enumerate(cuts):
        roads.nodes[f"{name}{i}"] = border[cut]
    for i, (begin, end) in enumerate(pairwise(cuts)):
        shape = border[begin : end + 1]
        count = lanes + (i in wide)
        roads.edges.append(_edge(f"{name}_{i}", (f"{name}{i}", f"{name}{i + 1}"), shape, count, rules["speed"], rules))
    outer = axis.aside(rules["median"] / 2 + lanes * rules["lane_width"])
    entry, leave = (1, 2) if weaving else (3, 2)
    _add_exit(roads, name, leave, outer[cuts[leave]], axis.heading[cuts[leave]], rules)
    _add_entry(roads, name, entry, outer[cuts[entry]], axis.heading[cuts[entry]], rules)
    for i in range(len(cuts) - 2):
        _join(roads, f"{name}_{i}", f"{name}_{i + 1}", lanes, i in wide, i + 1 in wide)


def _edge(
    edge_id: str, ends: tuple[str, str], shape: np.ndarray, lanes: int, speed: float, rules: dict[str, float]
) -> PlainEdge:
    return PlainEdge(edge_id, *ends, shape, lanes, speed, rules["lane_width"], motorway=True)


def _add_exit(
    roads: PlainRoads, name: str, node: int, start: np.ndarray, heading: float, rules: dict[str, float]
) -> None:
    """The off-ramp that the extra lane goes on as."""
    shape = draw_ramp(start, heading, rules["ramp_radius"])
    roads.nodes[f"{name}_off"] = shape[-1]
    roads.edges.append(_edge(f"{name}_off", (f"{name}{node}", f"{name}_off"), shape, 1, rules["ramp_speed"], rules))
    roads.connections.append((f"{name}_{node - 1}", 0, f"{name}_off", 0))


def _add_entry(
    roads: PlainRoads, name: str, node: int, end: np.ndarray, heading: float, rules: dict[str, float]
) -> None:
    """The on-ramp that goes on as the extra lane: an exit seen in a mirror, driven backwards."""
    mirrored = draw_ramp(np.zeros(2), 0.0, rules["ramp_radius"])[::-1] * [-1.0, 1.0]
    cos, sin = np.cos(heading), np.sin(heading)
    shape = end + mirrored @ np.array([[cos, sin], [-sin, cos]])
    roads.nodes[f"{name}_on"] = shape[0]
    roads.edges.append(_edge(f"{name}_on", (f"{name}_on", f"{name}{node}"), shape, 1, rules["ramp_speed"], rules))
    roads.connections.append((f"{name}_on", 0, f"{name}_{node}", 0))


def _join(roads: PlainRoads, source: str, target: str, lanes: int, from_wide: bool, to_wide: bool) -> None:
    """Every lane goes on; the extra one is reached and left by changing lanes, or by a ramp."""
    for lane in range(lanes):
        roads.connections.append((source, lane + from_wide, target, lane + to_wide))
