"""Scenes and rollouts packed for the player of a report page, which is ``player.html`` and ``player.js``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from dpa.ranking import FEATURES
from dpa.report.judged import Couplings, JudgedRollouts, logged_mishaps
from dpa.report.packing import pack_line, pack_numbers, pack_tracks, run_lengths, simplified, whole
from envs.render import fit_view, pose_tracks, style
from envs.scene import (
    CURRENT_STEP,
    LOG_STEPS,
    STEP_SECONDS,
    AgentKind,
    Scene,
    polylines,
)

MAP_TOLERANCE = 0.1
"""How far a packed polyline may lie from its own points [m]; lanes come with a point each half metre."""
_KINDS = (AgentKind.VEHICLE, AgentKind.PEDESTRIAN, AgentKind.CYCLIST, AgentKind.OTHER, AgentKind.UNSET)


@dataclass(frozen=True)
class PlayerScene:
    """One scene for the player.

    Attributes:
        scene: an uncollated scene.
        rollouts: of each method; methods may keep different numbers of them.
    """

    scene: Scene
    rollouts: Mapping[str, JudgedRollouts]


def pack_players(players: Sequence[PlayerScene]) -> dict[str, Any]:
    """Everything the player needs, as JSON can hold it.

    Long rows of numbers are text, see :mod:`dpa.report.packing`. A recorded scene of 50
    agents takes about 13 kB for its log and map, and 6 kB for each rollout.

    Args:
        players: scenes with their rollouts.

    Returns:
        ``scenes`` in the order given, with ``rollouts`` of each method; and what holds for all of them.

    Raises:
        ValueError: rollouts that do not fit their scene, or a scene without road edges; the message names it.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> packed = pack_players([PlayerScene(straight_road(num_vehicles=2), {})])
        >>> packed["scenes"][0]["agents"]
        ['SDC 1', 'vehicle 2']
    """
    classes = [{"name": "SDC", "color": style.SDC_COLOR, "halo": False}] + [
        {"name": kind.name.capitalize(), "color": style.AGENT_COLORS[kind], "halo": kind in style.SMALL_KINDS}
        for kind in _KINDS
    ]
    return {
        "steps": LOG_STEPS,
        "now": CURRENT_STEP,
        "seconds": STEP_SECONDS,
        "ground": style.GROUND_COLOR,
        "classes": classes,
        "lights": {group: color for group, (_, color) in style.LIGHT_STYLE.items()},
        "scenes": [_pack_scene(player) for player in players],
    }


def _pack_scene(player: PlayerScene) -> dict[str, Any]:
    scene, agents = player.scene, player.scene.agents
    kinds = map(AgentKind, agents.kind.tolist())
    who = list(zip(kinds, agents.sdc.tolist(), agents.track_id.tolist(), strict=True))
    collides, offroad = logged_mishaps(scene)
    return {
        "id": scene.scene_id,
        "view": whole(np.array(fit_view(scene))).tolist(),
        "map": _pack_map(scene),
        "lights": _pack_lights(scene),
        "class": [0 if sdc else 1 + _KINDS.index(kind) for kind, sdc, _ in who],
        "agents": [f"{'SDC' if sdc else kind.name.lower()} {track}" for kind, sdc, track in who],
        "size": whole(agents.extent[:, :2].numpy()).tolist(),
        "log": {"tracks": pack_tracks(pose_tracks(scene)), **_pack_mishaps(collides, offroad)},
        "present": agents.present.nonzero()[:, 0].tolist(),
        "rollouts": {method: _pack_method(scene, method, judged) for method, judged in player.rollouts.items()},
    }


def _pack_method(scene: Scene, method: str, judged: JudgedRollouts) -> dict[str, Any]:
    expected = (int(scene.agents.present.sum()), LOG_STEPS - CURRENT_STEP - 1, 3)
    if judged.poses.ndim != 4 or tuple(judged.poses.shape[1:]) != expected or not len(judged.poses):
        raise ValueError(
            f"scene {scene.scene_id}, method {method!r}: rollouts must be [R, A'={expected[0]}, {expected[1]}, 3] of "
            f"the agents present at the current step, got {list(judged.poses.shape)}."
        )
    return {
        "sampled": judged.sampled,
        **_pack_measure(judged.couplings),
        "kept": [_pack_rollout(judged, row) for row in range(len(judged.poses))],
    }


def _pack_rollout(judged: JudgedRollouts, row: int) -> dict[str, Any]:
    couplings = judged.couplings
    pairs = zip(couplings.partner[row], couplings.valid, strict=True)
    return {
        "number": int(judged.number[row]),
        "distance": round(float(judged.distance[row]), 3),
        "nearer": int(judged.distance_rank[row]),
        "nats": round(float(judged.log_likelihood[row]), 4),
        "likelier": int(judged.likelihood_rank[row]),
        "tracks": pack_tracks(judged.poses[row].detach().cpu()),
        **_pack_mishaps(judged.collides[row], judged.offroad[row]),
        "paid": [round(paid, 3) for paid in judged.agent_distance[row][couplings.agents].tolist()],
        "share": pack_numbers((100 * couplings.share[row]).round().long().flatten().tolist()),
        "features": _pack_features(couplings.rollouts[row], couplings.valid),
        "coupling": [pack_numbers(partners[valid].tolist()) for partners, valid in pairs],
    }


def _pack_measure(couplings: Couplings) -> dict[str, Any]:
    """What all rollouts of a method share: whom and when they are measured, by what, and their log."""
    return {
        "features": [
            {"name": name.replace("_", " "), "unit": FEATURES[name].unit.replace("^2", "²"), "weight": weight}
            for name, weight in zip(couplings.features, couplings.weights.tolist(), strict=True)
        ],
        "stride": couplings.stride,
        "ranked": couplings.agents.tolist(),
        "valid": [run_lengths(valid.numpy()) for valid in couplings.valid],
        "log": _pack_features(couplings.log, couplings.valid),
    }


def _pack_features(features: Tensor, valid: Tensor) -> list[str]:
    """Of each agent its features ``[E, T', D]`` at the valid steps in hundredths, each against the step before."""
    rows = (whole(values[there].numpy()) for values, there in zip(features, valid, strict=True))
    return [pack_numbers(np.diff(values, axis=0, prepend=0 * values[:1]).ravel().tolist()) for values in rows]


def _pack_mishaps(collides: Tensor, offroad: Tensor) -> dict[str, dict[str, list[int]]]:
    """Of each agent to which it happens: first step and length of each run."""
    return {
        name: {str(agent): run_lengths(flags[agent].numpy()) for agent in flags.any(-1).nonzero()[:, 0].tolist()}
        for name, flags in (("collides", collides), ("offroad", offroad))
    }


def _pack_map(scene: Scene) -> list[dict[str, Any]]:
    packed = []
    for layer in style.MAP_LAYERS:
        lines = [line[:, :2].numpy() for line in polylines(scene, layer.kinds)]
        if lines:
            texts = [pack_line(line[simplified(line, MAP_TOLERANCE)]) for line in lines]
            packed.append({"paint": layer.paint, "color": layer.color, "width": layer.width, "lines": texts})
    return packed


def _pack_lights(scene: Scene) -> list[dict[str, Any]]:
    """One entry for each light: where it stops vehicles, and its group at every step (None where not listed)."""
    lights, packed = scene.lights, []
    for states, points in zip(lights.state.tolist(), lights.stop_point, strict=True):
        groups = [style.LIGHT_GROUP.get(state) for state in states]
        seen = [step for step, group in enumerate(groups) if group is not None]
        if seen:
            packed.append({"at": whole(points[seen[0], :2].numpy()).tolist(), "groups": groups})
    return packed
