"""Official inputs and outputs of the realism metric, as scenes and tensors."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dpa.realism import Features, Quirk, RealismConfig, compare, measure
from envs.scene import CURRENT_STEP, LOG_STEPS, Agents, Lights, LightState, MapKind, RoadMap, Scene

SHIPPED = Path(__file__).resolve().parents[2] / "data" / "realism"
"""Scenes of our own that were made to hit corner cases, with the values of the official code."""


CODES = {"code2023": "2023", "code2023dec": "2023", "code2024": "2024", "code2025": "2025"}
"""Year of each version of the official code; "code2023" is its first one (pip 1.6.0), with the ghosts."""


def golden_config(code: str, year: str) -> RealismConfig:
    """Ranges and weights of one year with the code of another."""
    weights, config = RealismConfig.load(year), RealismConfig.load(CODES[code])
    quirks = config.quirks | ({Quirk.GHOSTS} if code == "code2023" else set())
    return config.replace(continuous=weights.continuous, indicators=weights.indicators, quirks=quirks)


def measured(scene: Scene, rollouts: Tensor, config: RealismConfig) -> Features:
    """What the metric measures of one scene."""
    return measure([compare(scene, rollouts, config)], config)[0]


@dataclass(frozen=True)
class Golden:
    """One scene with rollouts of one kind.

    Attributes:
        folder: where its files are.
        scene: name of the scene.
        kind: of the rollouts.
    """

    folder: Path
    scene: str
    kind: str

    def load_scene(self, *, moved: bool = False) -> Scene:
        """The scene in the frame of its source, or in one whose origin is near and whole metres.

        Whole metres change no float32 value of a scene that lies kilometres from the origin of its source. The
        synthetic scenes lie around it and have values near zero, which would be rounded.
        """
        return scene_from_npz(dict(np.load(self.folder / "scenarios" / f"{self.scene}.npz")), moved=moved)

    def load_rollouts(self, scene: Scene) -> Tensor:
        """``[R, A, 80, 4]`` in the frame and the order of the scene."""
        data = np.load(self.folder / "rollouts" / f"{self.scene}__{self.kind}.npz")
        world = torch.from_numpy(np.stack([data[name] for name in ("x", "y", "z", "heading")], -1))
        column = {int(track): i for i, track in enumerate(data["object_id"])}
        order = [column[int(track)] for track in scene.agents.track_id[scene.agents.present]]
        world[..., :3] -= scene.origin.float()
        return world[:, order]

    def load_features(self, code: str = "code2025") -> dict[str, np.ndarray]:
        return dict(np.load(self.folder / "features" / f"{self.scene}__{self.kind}__{code}.npz"))

    def load_output(self, code: str, config: str) -> dict[str, Any]:
        path = self.folder / "outputs" / f"{self.scene}__{self.kind}__{code}__cfg{config}.json"
        return json.loads(path.read_text(encoding="utf-8"))


def scene_from_npz(data: dict[str, np.ndarray], *, moved: bool) -> Scene:
    """A scene from the golden arrays."""
    world = torch.from_numpy(np.stack([data["x"], data["y"], data["z"]], -1)).float()
    valid = torch.from_numpy(data["valid"])
    sdc = int(data["sdc_track_index"])
    origin = world[sdc, CURRENT_STEP].double().round() * moved
    num = len(world)
    first = valid.int().argmax(1)
    step = torch.where(valid[:, CURRENT_STEP], CURRENT_STEP, first)
    extent = torch.from_numpy(np.stack([data["length"], data["width"], data["height"]], -1))
    agents = Agents(
        position=(world - origin.float()) * valid[..., None],
        heading=torch.from_numpy(data["heading"]) * valid,
        velocity=torch.from_numpy(np.stack([data["vx"], data["vy"]], -1)) * valid[..., None],
        valid=valid,
        extent=extent[torch.arange(num), step],
        kind=torch.from_numpy(data["object_type"]).long(),
        track_id=torch.from_numpy(data["object_id"]).long(),
        predict=torch.isin(torch.arange(num), torch.from_numpy(data["tracks_to_predict"]).long()),
        sdc=torch.arange(num) == sdc,
        batch_size=[],
    )
    return Scene(
        agents=agents,
        road=_road(data, origin),
        lights=lights_from_npz(data, origin),
        origin=origin,
        lacks=torch.tensor(0),
        scene_id=str(data["scenario_id"]),
        batch_size=[],
    )


def _road(data: dict[str, np.ndarray], origin: Tensor) -> RoadMap:
    points, counts, kinds, ids = [], [], [], []
    for part, first_kind in (("lane", MapKind.LANE_UNDEFINED), ("road_edge", MapKind.EDGE_UNKNOWN)):
        points.append(torch.from_numpy(data[f"{part}_xyz"]).float() - origin.float())
        counts.append(torch.from_numpy(np.diff(data[f"{part}_ptr"])))
        kinds.append(torch.from_numpy(data[f"{part}_type"]).long() + int(first_kind))
        ids.append(torch.from_numpy(data[f"{part}_id"]).long())
    count = torch.cat(counts)
    return RoadMap(
        points=torch.cat(points),
        start=count.cumsum(0) - count,
        count=count,
        kind=torch.cat(kinds),
        feature_id=torch.cat(ids),
        speed_limit=torch.zeros(len(count)),
        links=torch.empty(0, 3, dtype=torch.int64),
        batch_size=[],
    )


def lights_from_npz(data: dict[str, np.ndarray], origin: Tensor) -> Lights:
    """Lights by lane; where a step lists a lane twice, the later entry wins."""
    lane_id = torch.unique(torch.from_numpy(data["tl_lane_id"]).long())
    state = torch.full((len(lane_id), LOG_STEPS), int(LightState.ABSENT))
    stop_point = torch.zeros(len(lane_id), LOG_STEPS, 3)
    row = {int(lane): i for i, lane in enumerate(lane_id)}
    ptr = data["tl_ptr"]
    for step in range(len(ptr) - 1):
        for entry in range(ptr[step], ptr[step + 1]):
            lane = row[int(data["tl_lane_id"][entry])]
            state[lane, step] = int(data["tl_state"][entry])
            stop_point[lane, step] = torch.from_numpy(data["tl_stop_point"][entry]).float() - origin.float()
    return Lights(lane_id=lane_id, state=state, stop_point=stop_point, batch_size=[])
