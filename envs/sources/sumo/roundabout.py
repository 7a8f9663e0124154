"""One or two roundabouts with their approaches.

A circle is driven counter-clockwise around an island, its left border. Every arm has an exit and then, a little further
on, an entry; both bend away from a splitter island, and join into one street where pedestrians cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envs.sources.sumo.plain import PlainEdge, PlainRoads

SPLIT = 30.0
"""From the circle's outer border to where entry and exit of an arm part [m]."""
HALF_GAP = 8.0
"""Half the way on the circle from an exit to the entry of the same arm [m]."""
ARM_ROOM = 4.6
"""Island's radius for each arm that a circle needs at least, so that exits and entries have room between them [m]."""
ENTRY_ANGLE = np.deg2rad(40.0)
"""Between the direction of an entry and that of the circle where they meet."""
JITTER = 0.1
"""How far an arm may lie from an even spacing, as a share of it."""
CURVE_POINTS = 12
"""Of the line of an entry or an exit."""


@dataclass(frozen=True)
class Circle:
    """One roundabout.

    Attributes:
        name: first part of the names of its nodes and edges.
        centre: ``[2]`` [m].
        island: radius of its left border [m].
        width: of all its lanes together [m].
        lanes: on it.
        arms: ``[n]`` directions of the arms, ascending [rad].
    """

    name: str
    centre: np.ndarray
    island: float
    width: float
    lanes: int
    arms: np.ndarray

    @property
    def gap(self) -> float:
        """Angle at the centre between an arm and its entry or exit [rad]."""
        return HALF_GAP / (self.island + self.width / 2)

    def at(self, angle: float, radius: float) -> np.ndarray:
        """``[2]``: the point at an angle and a distance from the centre."""
        return self.centre + radius * np.array([np.cos(angle), np.sin(angle)])

    def fork(self, arm: int) -> np.ndarray:
        """``[2]``: where entry and exit of an arm part."""
        return self.at(self.arms[arm], self.island + self.width + SPLIT)


def draw_entry(circle: Circle, arm: int) -> np.ndarray:
    """``[n, 2]``: left border of an arm's entry, from the fork to the middle of the circle's lanes; a Bezier curve."""
    angle = circle.arms[arm] + circle.gap
    outward = np.array([np.cos(circle.arms[arm]), np.sin(circle.arms[arm])])
    begin, end = circle.fork(arm), circle.at(angle, circle.island + circle.width / 2)
    aim = angle + np.pi / 2 + ENTRY_ANGLE  # the circle's direction, turned inward
    reach = 0.4 * np.linalg.norm(end - begin)
    controls = np.stack((begin, begin - reach * outward, end - reach * np.array([np.cos(aim), np.sin(aim)]), end))
    t = np.linspace(0, 1, CURVE_POINTS)[:, None]
    weights = np.concatenate(((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3), axis=1)
    return weights @ controls


def draw_exit(circle: Circle, arm: int) -> np.ndarray:
    """``[n, 2]``: left border of an arm's exit, to the fork: its entry in a mirror, backwards."""
    entry = draw_entry(circle, arm)[::-1] - circle.centre
    axis = np.array([np.cos(circle.arms[arm]), np.sin(circle.arms[arm])])
    return circle.centre + 2 * (entry @ axis)[:, None] * axis - entry


def make_roundabouts(rules: dict[str, float], rng: np.random.Generator) -> PlainRoads:
    """Roads of one roundabout, or of two that a street joins.

    Args:
        rules: of the preset in ``sumo.yaml``, pairs drawn.
        rng: for what differs between circles and between arms.
    """
    roads = PlainRoads(node_radius=1.0)
    first = _draw_circle("A", np.zeros(2), rng.uniform(0, 2 * np.pi), rules, rng)
    circles, links = [first], []
    if rules["circles"] > 1:
        reach = 2 * SPLIT + first.island + first.width + rules["link_length"]
        angle = first.arms[0]
        # the other circle is of about the same size; its own radius is drawn, so the street's length varies a little
        second = _draw_circle("B", first.at(angle, reach + rules["island"] + first.width), angle + np.pi, rules, rng)
        circles.append(second)
        links = [(first, second)]
    for circle in circles:
        _add_circle(roads, circle, rules)
        for arm in range(len(circle.arms)):
            linked = bool(links) and arm == 0
            entry_lanes = 1 if linked else int(rng.integers(1, circle.lanes + 1))
            _add_branches(roads, circle, arm, entry_lanes, rules)
            if not linked:
                _add_arm(roads, circle, arm, entry_lanes, rules, rng)
    for one, other in links:
        for source, target in ((one, other), (other, one)):
            shape = np.stack((source.fork(0), target.fork(0)))
            street = f"{source.name}{target.name}"
            roads.edges.append(_street(street, (f"{source.name}0_fork", f"{target.name}0_fork"), shape, 1, rules))
            roads.connections += [(f"{source.name}0_out", 0, street, 0), (street, 0, f"{target.name}0_in", 0)]
    return roads


def _draw_circle(
    name: str, centre: np.ndarray, first_arm: float, rules: dict[str, float], rng: np.random.Generator
) -> Circle:
    """A circle whose first arm has the direction asked for; the others are spread around it."""
    count = int(rng.integers(rules["fewest_arms"], rules["most_arms"] + 1))
    opposite = 2 * np.pi * np.arange(1, count) / count - np.pi  # the other arms, seen from the far side of the circle
    if rules["circles"] > 1:
        opposite *= min(1.0, np.pi / 2 / opposite.max())  # they lead away from the other circle, so no two arms meet
    jitter = JITTER * (opposite[1] - opposite[0]) * rng.uniform(-1, 1, count - 1)
    others = first_arm + np.pi + opposite + jitter
    arms = np.append(first_arm, others)
    island = max(rules["island"], ARM_ROOM * count)
    return Circle(name, centre, island, rules["lanes"] * rules["circle_lane_width"], rules["lanes"], arms)


def _street(edge_id: str, ends: tuple[str, str], shape: np.ndarray, lanes: int, rules: dict[str, float]) -> PlainEdge:
    return PlainEdge(
        edge_id, *ends, shape, lanes, rules["speed"], rules["lane_width"], priority=1, pavement=rules["pavement"]
    )


def _add_circle(roads: PlainRoads, circle: Circle, rules: dict[str, float]) -> None:
    """The ring: from an arm's exit to its entry (no pavement on the splitter island), then to the next arm's exit."""
    stops: list[tuple[str, float]] = []
    for arm, direction in enumerate(circle.arms):
        stops += [
            (f"{circle.name}{arm}_exit", direction - circle.gap),
            (f"{circle.name}{arm}_entry", direction + circle.gap),
        ]
    names, edges = [name for name, _ in stops], []
    for i, (name, begin) in enumerate(stops):
        after, end = stops[(i + 1) % len(stops)]
        sweep = (end - begin) % (2 * np.pi)
        angles = begin + np.linspace(0, 1, max(4, round(sweep * 12))) * sweep
        shape = circle.centre + circle.island * np.stack((np.cos(angles), np.sin(angles)), -1)
        roads.nodes[name] = circle.at(begin, circle.island + circle.width / 2)
        pavement = 0.0 if name.endswith("exit") else rules["pavement"]
        roads.edges.append(
            PlainEdge(f"{name}_on", name, after, shape, circle.lanes, rules["circle_speed"],
                      rules["circle_lane_width"], priority=5, pavement=pavement)
        )  # fmt: skip
        edges.append(f"{name}_on")
        for lane in range(circle.lanes):
            roads.connections.append((f"{name}_on", lane, f"{after}_on", lane))
    roads.roundabouts.append((names, edges))


def _add_branches(roads: PlainRoads, circle: Circle, arm: int, entry_lanes: int, rules: dict[str, float]) -> None:
    """Entry and exit of an arm; only the outer lane of the circle leaves it, so nobody cuts across another lane."""
    name = f"{circle.name}{arm}"
    before = f"{circle.name}{(arm - 1) % len(circle.arms)}_entry_on"
    roads.nodes[f"{name}_fork"] = circle.fork(arm)
    entry, leave = draw_entry(circle, arm), draw_exit(circle, arm)
    roads.edges.append(_street(f"{name}_in", (f"{name}_fork", f"{name}_entry"), entry, entry_lanes, rules))
    roads.edges.append(_street(f"{name}_out", (f"{name}_exit", f"{name}_fork"), leave, 1, rules))
    roads.connections += [(f"{name}_in", lane, f"{name}_entry_on", lane) for lane in range(entry_lanes)]
    roads.connections.append((before, 0, f"{name}_out", 0))
    if rules["pavement"]:
        roads.crossings.append((f"{name}_fork", [f"{name}_in", f"{name}_out"]))


def _add_arm(
    roads: PlainRoads, circle: Circle, arm: int, lanes: int, rules: dict[str, float], rng: np.random.Generator
) -> None:
    """The street from the fork to the end of the world, bent a little to one side."""
    name, direction = f"{circle.name}{arm}", circle.arms[arm]
    along = np.linspace(0, rules["arm_length"], CURVE_POINTS)
    aside = rng.uniform(-0.15, 0.15) * along**2 / rules["arm_length"]
    outward = np.array([np.cos(direction), np.sin(direction)])
    shape = circle.fork(arm) + along[:, None] * outward + aside[:, None] * np.array([-outward[1], outward[0]])
    roads.nodes[f"{name}_end"] = shape[-1]
    roads.edges.append(_street(f"{name}_arrive", (f"{name}_end", f"{name}_fork"), shape[::-1], lanes, rules))
    roads.edges.append(_street(f"{name}_depart", (f"{name}_fork", f"{name}_end"), shape, 1, rules))
    roads.connections += [(f"{name}_arrive", lane, f"{name}_in", lane) for lane in range(lanes)]
    roads.connections.append((f"{name}_out", 0, f"{name}_depart", 0))
