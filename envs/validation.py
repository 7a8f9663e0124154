"""What a scene must be before anything works on it; :meth:`~envs.scene.Scene.validate` asks for all of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from envs.scene import (
    CURRENT_STEP,
    EDGE_KINDS,
    LARGEST_NUMBER,
    LOG_STEPS,
    AgentKind,
    Agents,
    Lacks,
    LightState,
    MapKind,
    RoadMap,
    Scene,
    SceneError,
)

LONGEST_ID = 200
"""Letters of a scene's id; those of WOMD have 16, those of Argoverse 2 have 36."""
_SIZES = {
    "origin": (torch.float64, (3,)),
    "lacks": (torch.int64, ()),
    "agents.position": (torch.float32, ("agents", LOG_STEPS, 3)),
    "agents.heading": (torch.float32, ("agents", LOG_STEPS)),
    "agents.velocity": (torch.float32, ("agents", LOG_STEPS, 2)),
    "agents.valid": (torch.bool, ("agents", LOG_STEPS)),
    "agents.extent": (torch.float32, ("agents", 3)),
    "agents.kind": (torch.int64, ("agents",)),
    "agents.track_id": (torch.int64, ("agents",)),
    "agents.predict": (torch.bool, ("agents",)),
    "agents.sdc": (torch.bool, ("agents",)),
    "road.points": (torch.float32, ("points", 3)),
    "road.start": (torch.int64, ("polylines",)),
    "road.count": (torch.int64, ("polylines",)),
    "road.kind": (torch.int64, ("polylines",)),
    "road.feature_id": (torch.int64, ("polylines",)),
    "road.speed_limit": (torch.float32, ("polylines",)),
    "road.links": (torch.int64, ("links", 3)),
    "lights.lane_id": (torch.int64, ("lights",)),
    "lights.state": (torch.int64, ("lights", LOG_STEPS)),
    "lights.stop_point": (torch.float32, ("lights", LOG_STEPS, 3)),
}
"""Type and shape of each field of an uncollated scene."""


def check_scene(scene: Scene, name: str | None = None) -> None:
    """Check one uncollated scene.

    Args:
        scene: to check.
        name: what to call it in an error.

    Raises:
        SceneError: see :meth:`~envs.scene.Scene.validate`.
    """
    check_scene_id(scene.scene_id, name or "a scene")
    name = f"{name} (scene {scene.scene_id})" if name else f"scene {scene.scene_id}"
    _check_sizes(scene, name)
    _check_numbers(scene, name)
    _check_tracks(scene.agents, name)
    _check_map(scene.road, name)
    _check_finite(name, scene.lights.lane_id, "light of lane", stop_point=scene.lights.stop_point)


def check_scene_id(scene_id: object, name: str) -> None:
    """An id must be text that a terminal, a file and an error message can hold.

    Raises:
        SceneError: it is none.
    """
    if not isinstance(scene_id, str) or len(scene_id) > LONGEST_ID or not scene_id.isprintable():
        shown = ascii(scene_id[:40] if isinstance(scene_id, str | bytes) else scene_id)[:200]
        raise SceneError(f"{name}: scenario_id is {shown}; must be text of at most {LONGEST_ID} printable letters.")


def _field(scene: Scene, name: str) -> Tensor:
    part, _, field = name.rpartition(".")
    return getattr(getattr(scene, part) if part else scene, field)


def _check_sizes(scene: Scene, name: str) -> None:
    sizes: dict[str, int] = {}
    for field, (dtype, shape) in _SIZES.items():
        values = _field(scene, field)
        if values.ndim == len(shape) > 0 and isinstance(shape[0], str):
            sizes.setdefault(shape[0], values.shape[0])  # the first field of a table says how many rows it has
        wanted = tuple(sizes.get(size, size) for size in shape)
        if values.dtype == dtype and tuple(values.shape) == wanted:
            continue
        if field in ("agents.position", "agents.valid") and values.ndim == len(shape):
            raise SceneError(
                f"{name}: tracks must have {LOG_STEPS} steps of 0.1 s, got positions of shape "
                f"{tuple(scene.agents.position.shape)}. Cut or resample the recording."
            )
        raise SceneError(
            f"{name}: {field} is {values.dtype} of shape {tuple(values.shape)}; must be {dtype} of shape {wanted}."
        )


def _check_numbers(scene: Scene, name: str) -> None:
    """Numbers that stand for something must be of those that do."""
    known = {"agents.kind": AgentKind, "road.kind": MapKind, "lights.state": LightState}
    for field, members in known.items():
        values = _field(scene, field)
        unknown = ~torch.isin(values, torch.tensor(list(members)))
        if unknown.any():
            raise SceneError(f"{name}: {field} holds {int(values[unknown][0])}, which is no {members.__name__}.")
    if not 0 <= int(scene.lacks) <= sum(Lacks):
        raise SceneError(f"{name}: lacks is {int(scene.lacks)}; must be flags of Lacks.")
    if not (scene.origin.abs() <= LARGEST_NUMBER).all():
        raise SceneError(
            f"{name}: the origin is {scene.origin.tolist()}, where the SDC is at the current step; must be finite "
            f"numbers between -{LARGEST_NUMBER:g} and {LARGEST_NUMBER:g}."
        )


def _check_tracks(agents: Agents, name: str) -> None:
    if int(agents.sdc.sum()) != 1:
        raise SceneError(f"{name}: {int(agents.sdc.sum())} agents are marked as SDC; mark exactly one.")
    if not agents.present.any():
        raise SceneError(f"{name}: no agent is valid at the current step {CURRENT_STEP}; leave the scene out.")
    if not agents.present[agents.sdc].all():
        raise SceneError(f"{name}: the SDC is not valid at the current step {CURRENT_STEP}; leave the scene out.")
    for field in ("position", "heading", "velocity"):
        values = getattr(agents, field)
        shown = torch.where(agents.valid.reshape(agents.valid.shape + (1,) * (values.ndim - 2)), values, 0.0)
        _check_finite(name, agents.track_id, "track", **{field: shown})
    _check_finite(name, agents.track_id, "track", extent=agents.extent)
    flat = agents.present & ~(agents.extent > 0).all(-1)
    if flat.any():
        agent = int(flat.nonzero()[0])
        raise SceneError(
            f"{name}: track {int(agents.track_id[agent])} has the extent {agents.extent[agent].tolist()} at the "
            "current step (length, width, height), which must be positive; give its box, or mark it invalid."
        )


def _check_map(road: RoadMap, name: str) -> None:
    lie_in_order = torch.equal(road.start, road.count.cumsum(0) - road.count)
    if (
        not lie_in_order
        or ((road.count < 0) | (road.count > len(road.points))).any()
        or int(road.count.sum()) != len(road.points)
    ):
        raise SceneError(f"{name}: the points of the polylines must lie behind each other, in the polylines' order.")
    bad = ~(road.points.abs() <= LARGEST_NUMBER)
    if bad.any():
        point = int(bad.any(-1).nonzero()[0])
        line = int(torch.searchsorted(road.start + road.count, point, right=True))
        raise SceneError(
            f"{name}: map feature {int(road.feature_id[line])} has the point {road.points[point].tolist()} at index "
            f"{point - int(road.start[line])}, which {_fault(road.points[bad][0].item())}; remove the polyline."
        )
    _check_finite(name, road.feature_id, "map feature", speed_limit=road.speed_limit)
    edges = torch.isin(road.kind, torch.tensor(EDGE_KINDS)) & (road.count >= 2)
    if not edges.any():
        raise SceneError(f"{name}: the map has no road edge of two points or more; off-road is undefined.")


def _check_finite(name: str, ids: Tensor, what: str, **fields: Tensor) -> None:
    for field, values in fields.items():
        bad = ~(values.abs() <= LARGEST_NUMBER)
        if bad.any():
            row, *place = bad.nonzero()[0].tolist()
            value = values[row, *place].item()
            step = f" at step {place[0]}" if values.shape[1:2] == (LOG_STEPS,) else ""
            raise SceneError(
                f"{name}: {what} {int(ids[row])} has {field} {value:g}{step} (in float32), which {_fault(value)}; mark "
                "it invalid or leave it out."
            )


def _fault(value: float) -> str:
    return f"is larger than {LARGEST_NUMBER:g}" if math.isfinite(value) else "is not finite"
