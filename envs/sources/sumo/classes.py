"""SUMO's classes of road users: what each is in a scene, and how large where its type does not say."""

from __future__ import annotations

from dataclasses import dataclass

from envs.scene import AgentKind


@dataclass(frozen=True)
class Body:
    """What a road user looks like.

    Attributes:
        kind: in a scene.
        is_car: can be the SDC.
        extent: length, width, height [m].
    """

    kind: AgentKind
    is_car: bool
    extent: tuple[float, float, float]


def _vehicle(*extent: float) -> Body:
    return Body(AgentKind.VEHICLE, False, extent)


_CAR = Body(AgentKind.VEHICLE, True, (5.0, 1.8, 1.5))
CLASSES: dict[str, Body] = {
    **dict.fromkeys(
        ("passenger", "taxi", "evehicle", "private", "hov", "vip", "authority", "custom1", "custom2"), _CAR
    ),
    "ignoring": _CAR,
    "army": _vehicle(5.0, 1.8, 1.5),
    "emergency": _vehicle(6.5, 2.16, 2.86),
    "delivery": _vehicle(6.5, 2.16, 2.86),
    "truck": _vehicle(7.1, 2.4, 2.4),
    "trailer": _vehicle(16.5, 2.55, 4.0),
    "bus": _vehicle(12.0, 2.5, 3.4),
    "coach": _vehicle(14.0, 2.6, 4.0),
    "motorcycle": _vehicle(2.2, 0.9, 1.5),
    "moped": _vehicle(2.1, 0.8, 1.7),
    "bicycle": Body(AgentKind.CYCLIST, False, (1.6, 0.65, 1.7)),
    "scooter": Body(AgentKind.PEDESTRIAN, False, (1.2, 0.5, 1.7)),
    "pedestrian": Body(AgentKind.PEDESTRIAN, False, (0.215, 0.478, 1.719)),
    "wheelchair": Body(AgentKind.PEDESTRIAN, False, (0.8, 0.5, 1.4)),
}
"""SUMO's ``vClass`` -> a road user of the size that SUMO gives it by default.

The kinds are those of WOMD's labels: whoever rides a motorcycle or a moped is a vehicle, an e-scooter counts as
somebody on foot, and what runs on rails is not labelled. So trams and trains, ships, planes and containers are left
out here."""
DEFAULT_TYPES = {
    "DEFAULT_VEHTYPE": "passenger",
    "DEFAULT_TAXITYPE": "taxi",
    "DEFAULT_BIKETYPE": "bicycle",
    "DEFAULT_PEDTYPE": "pedestrian",
    "DEFAULT_RAILTYPE": "rail",
    "DEFAULT_CONTAINERTYPE": "container",
}
"""Types that exist without being written down, and their class."""


def make_body(attributes: dict[str, object]) -> Body | None:
    """The body of a ``vType``; nothing for a class that is not on the road.

    Args:
        attributes: of the type; sizes that are missing are those of its class.

    Examples:
        >>> make_body({"vClass": "bus", "length": "18.5"}).extent
        (18.5, 2.5, 3.4)
        >>> make_body({"vClass": "tram"}) is None
        True
    """
    usual = CLASSES.get(str(attributes.get("vClass", "passenger")))
    if usual is None:
        return None
    sizes = zip(("length", "width", "height"), usual.extent, strict=True)
    return Body(usual.kind, usual.is_car, tuple(float(attributes.get(name, size)) for name, size in sizes))
