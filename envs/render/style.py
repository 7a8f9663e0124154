"""Colours, widths and markers of a bird's-eye picture; the scene player of a report uses the same ones."""

from __future__ import annotations

from typing import Literal, NamedTuple

from envs.scene import EDGE_KINDS, LANE_KINDS, AgentKind, LightState, MapKind

# Hues of Okabe and Ito, which stay apart under every common form of colour blindness; the map keeps to greys.
SDC_COLOR = "#d55e00"
"""The self-driving car, whatever its class."""
AGENT_COLORS: dict[int, str] = {
    AgentKind.UNSET: "#6b6b6b",
    AgentKind.VEHICLE: "#2a78b5",
    AgentKind.PEDESTRIAN: "#b0509a",
    AgentKind.CYCLIST: "#009e73",
    AgentKind.OTHER: "#6b6b6b",
}
SMALL_KINDS = (AgentKind.PEDESTRIAN, AgentKind.CYCLIST)
"""Classes that get a halo: their boxes are a few pixels in a window of a hundred metres."""
INK_COLOR = "#3c4043"
"""Letters and scale bars."""
GROUND_COLOR = "#edeeea"

STOP_SIGN_COLOR = "#b3261e"
_WHITE, _YELLOW = "#c3c8cd", "#dcb94a"


class MapLayer(NamedTuple):
    """One pass over the map.

    Attributes:
        paint: how: a lane as wide as it is on the ground, a filled polygon, a line, a broken line or a point.
        color: of it.
        width: of a lane [m], of a line or point [points of 1/72 inch].
        kinds: of polylines.
    """

    paint: Literal["lane", "area", "line", "dashes", "dot"]
    color: str
    width: float
    kinds: tuple[MapKind, ...]


MAP_LAYERS = (
    # Lanes have no width in the recordings; these are a little too wide so that neighbours close up.
    MapLayer("lane", "#ffffff", 2.0, (MapKind.LANE_BIKE,)),
    MapLayer("lane", "#ffffff", 4.4, tuple(kind for kind in LANE_KINDS if kind != MapKind.LANE_BIKE)),
    MapLayer("area", "#f6f6f3", 0.0, (MapKind.DRIVEWAY,)),
    MapLayer("area", "#dfe5ea", 0.0, (MapKind.CROSSWALK,)),
    MapLayer("area", "#e9e2d3", 0.0, (MapKind.SPEED_BUMP,)),
    MapLayer("line", "#e9ebed", 0.6, LANE_KINDS),
    MapLayer("line", _WHITE, 0.8, (MapKind.LINE_UNKNOWN, MapKind.LINE_SOLID_WHITE, MapKind.LINE_DOUBLE_WHITE)),
    MapLayer("line", _YELLOW, 0.8, (MapKind.LINE_SOLID_YELLOW, MapKind.LINE_SOLID_DOUBLE_YELLOW)),
    MapLayer("dashes", _WHITE, 0.8, (MapKind.LINE_BROKEN_WHITE,)),
    MapLayer(
        "dashes",
        _YELLOW,
        0.8,
        (MapKind.LINE_BROKEN_YELLOW, MapKind.LINE_BROKEN_DOUBLE_YELLOW, MapKind.LINE_PASSING_YELLOW),
    ),
    MapLayer("line", "#8b9096", 1.1, EDGE_KINDS),
    MapLayer("dot", STOP_SIGN_COLOR, 5.0, (MapKind.STOP_SIGN,)),
)
"""The map from the ground up."""

STOP, CAUTION, GO, UNKNOWN = "stop", "caution", "go", "unknown"
LIGHT_GROUP: dict[int, str] = {
    LightState.UNKNOWN: UNKNOWN,
    LightState.ARROW_STOP: STOP,
    LightState.STOP: STOP,
    LightState.FLASHING_STOP: STOP,
    LightState.ARROW_CAUTION: CAUTION,
    LightState.CAUTION: CAUTION,
    LightState.FLASHING_CAUTION: CAUTION,
    LightState.ARROW_GO: GO,
    LightState.GO: GO,
}
LIGHT_STYLE: dict[str, tuple[str, str]] = {
    STOP: ("s", "#c1121f"),
    CAUTION: ("^", "#e69f00"),
    GO: ("o", "#2a9d5c"),
    UNKNOWN: ("D", "#a7adb3"),
}
"""Marker and colour of a light: shape repeats what colour says."""
