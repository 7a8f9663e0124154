"""Scenes and rollouts packed for the player of a report page: whole centimetres, each step against the last one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from envs.render import fit_view, pose_tracks, style
from envs.scene import (
    CURRENT_STEP,
    LOG_STEPS,
    STEP_SECONDS,
    AgentKind,
    Scene,
    polylines,
)

CENTIMETRE = 0.01
"""Unit of packed positions [m] and headings [rad]."""
MAP_TOLERANCE = 0.1
"""How far a packed polyline may lie from its own points [m]; lanes come with a point each half metre."""

Track = list[int | None]
"""Poses of one agent: x, y, heading as differences from its last known pose (the first: from 0); None where absent."""


@dataclass(frozen=True)
class PlayerScene:
    """One scene for the player.

    Attributes:
        scene: an uncollated scene.
        rollouts: for each method ``[R, A', 80, 3]`` x, y, heading of the A' agents present at the current step, in
            scene order; NaN where an agent is not there. Methods may have different R.
    """

    scene: Scene
    rollouts: Mapping[str, Tensor]


def pack_players(players: Sequence[PlayerScene]) -> dict[str, Any]:
    """Everything the player needs, as JSON can hold it.

    Args:
        players: scenes with their rollouts.

    Raises:
        ValueError: rollouts that do not fit their scene; the message names scene and method.

    Examples:
        >>> import torch
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(num_vehicles=2)
        >>> packed = pack_players([PlayerScene(scene, {"reference": torch.zeros(1, 2, 80, 3)})])
        >>> packed["scenes"][0]["log"][0][:6]  # 10 m/s to the right, from 10 m behind the origin
        [-1000, -250, 0, 100, 0, 0]
    """
    kinds = [AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST, AgentKind.OTHER, AgentKind.UNSET]
    classes = [{"name": "SDC", "color": style.SDC_COLOR, "halo": False}] + [
        {"name": kind.name.capitalize(), "color": style.AGENT_COLORS[kind], "halo": kind in style.SMALL_KINDS}
        for kind in kinds
    ]
    return {
        "steps": LOG_STEPS,
        "now": CURRENT_STEP,
        "seconds": STEP_SECONDS,
        "ground": style.GROUND_COLOR,
        "classes": classes,
        "lights": {group: color for group, (_, color) in style.LIGHT_STYLE.items()},
        "scenes": [_pack_scene(player, kinds) for player in players],
    }


def _pack_scene(player: PlayerScene, kinds: Sequence[AgentKind]) -> dict[str, Any]:
    scene, agents = player.scene, player.scene.agents
    view = fit_view(scene)
    return {
        "id": scene.scene_id,
        "view": _whole(np.array(view)).tolist(),
        "map": _pack_map(scene),
        "lights": _pack_lights(scene),
        "class": [
            0 if sdc else 1 + kinds.index(AgentKind(kind))
            for kind, sdc in zip(agents.kind.tolist(), agents.sdc.tolist(), strict=True)
        ],
        "size": _whole(agents.extent[:, :2].numpy()).tolist(),
        "log": pack_tracks(pose_tracks(scene)),
        "present": agents.present.nonzero()[:, 0].tolist(),
        "rollouts": {method: _pack_rollouts(scene, method, given) for method, given in player.rollouts.items()},
    }


def _pack_rollouts(scene: Scene, method: str, rollouts: Tensor) -> list[list[Track]]:
    expected = (int(scene.agents.present.sum()), LOG_STEPS - CURRENT_STEP - 1, 3)
    if rollouts.ndim != 4 or tuple(rollouts.shape[1:]) != expected or not len(rollouts):
        raise ValueError(
            f"scene {scene.scene_id}, method {method!r}: rollouts must be [R, A'={expected[0]}, {expected[1]}, 3] of "
            f"the agents present at the current step, got {list(rollouts.shape)}."
        )
    return [pack_tracks(rollout) for rollout in rollouts.detach().cpu()]


def pack_tracks(poses: Tensor) -> list[Track]:
    """Pack poses ``[A, T, 3]`` (NaN where absent), one :data:`Track` for each agent.

    Differences are taken after rounding, so that adding them up gives every rounded pose exactly.

    Examples:
        >>> import torch
        >>> pack_tracks(torch.tensor([[[1.0, 2.0, 0.5], [1.5, 2.0, 0.5], [torch.nan] * 3, [2.0, 2.0, 0.5]]]))
        [[100, 200, 50, 50, 0, 0, None, 50, 0, 0]]
    """
    tracks = []
    for agent in poses.numpy():
        there = np.isfinite(agent).all(-1)
        steps = np.diff(_whole(agent[there]), axis=0, prepend=np.zeros((1, 3), dtype=np.int64))
        if there.all():
            tracks.append(steps.ravel().tolist())
            continue
        rest = iter(steps.tolist())
        tracks.append([item for known in there for item in (next(rest) if known else [None])])
    return tracks


def _pack_map(scene: Scene) -> list[dict[str, Any]]:
    packed = []
    for layer in style.MAP_LAYERS:
        lines = [_pack_line(line[:, :2].numpy()) for line in polylines(scene, layer.kinds)]
        if lines:
            packed.append({"paint": layer.paint, "color": layer.color, "width": layer.width, "lines": lines})
    return packed


def _pack_line(line: NDArray[np.float32]) -> list[int]:
    points = _whole(line[simplified(line, MAP_TOLERANCE)])
    return np.diff(points, axis=0, prepend=np.zeros((1, 2), dtype=np.int64)).ravel().tolist()


def simplified(line: NDArray[np.float32], tolerance: float) -> NDArray[np.bool_]:
    """Which points of a polyline to keep so that it moves by no more than a tolerance (Ramer, Douglas and Peucker).

    Args:
        line: ``[n, 2]``.
        tolerance: [m].

    Returns:
        ``[n]`` bool; the ends are kept.

    Examples:
        >>> simplified(np.array([[0.0, 0.0], [1.0, 0.01], [2.0, 0.0], [2.0, 5.0]]), 0.1).tolist()
        [True, False, True, True]
    """
    keep = np.zeros(len(line), dtype=bool)
    keep[[0, -1]] = True
    pieces = [(0, len(line) - 1)]
    while pieces:
        first, last = pieces.pop()
        if last - first < 2:
            continue
        chord, inner = line[last] - line[first], line[first + 1 : last] - line[first]
        # The distance is to the chord, not to its line: a track that doubles back would else lose its turning point.
        along = np.clip(inner @ chord / max(float(chord @ chord), 1e-12), 0, 1)
        away = np.linalg.norm(inner - along[:, None] * chord, axis=1)
        worst = int(away.argmax())
        if away[worst] > tolerance:
            middle = first + 1 + worst
            keep[middle] = True
            pieces += [(first, middle), (middle, last)]
    return keep


def _pack_lights(scene: Scene) -> list[dict[str, Any]]:
    """One entry for each light: where it stops vehicles, and its group at every step (None where not listed)."""
    lights, packed = scene.lights, []
    for states, points in zip(lights.state.tolist(), lights.stop_point, strict=True):
        groups = [style.LIGHT_GROUP.get(state) for state in states]
        seen = [step for step, group in enumerate(groups) if group is not None]
        if seen:
            packed.append({"at": _whole(points[seen[0], :2].numpy()).tolist(), "groups": groups})
    return packed


def _whole(values: NDArray[np.floating]) -> NDArray[np.int64]:
    return np.rint(np.asarray(values, dtype=np.float64) / CENTIMETRE).astype(np.int64)
