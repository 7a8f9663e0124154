"""Scenes far from the origin, noisy rollouts of them, and submissions to test with."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from dpa.realism.submission import Metadata, SubmissionWriter, wire
from envs.scene import CURRENT_STEP, Scene
from envs.sources.synthetic import straight_road

METADATA = Metadata("me@example.org", "mine", False, False, True, "7M", True, authors=("A", "B"), affiliation="home")
ORIGIN = torch.tensor([8123.4567, -3210.987, 12.5], dtype=torch.float64)


def far_road(number: int, vehicles: int = 2) -> Scene:
    scene = straight_road(num_vehicles=vehicles, seed=number)
    scene.origin = ORIGIN * (1 + number)
    scene.scene_id = f"scene_{number}"
    return scene


def noisy_rollouts(scene: Scene, rollouts: int = 32) -> Tensor:
    agents = scene.agents
    log = agents.trajectory[agents.present, CURRENT_STEP + 1 :]
    noise = torch.randn(rollouts, *log.shape, generator=torch.Generator().manual_seed(len(log)))
    return log + 0.1 * noise


SCENES = [far_road(number) for number in range(4)]
ROLLOUTS = [noisy_rollouts(scene) for scene in SCENES]
IDS = [scene.scene_id for scene in SCENES]


def open_writer(path: Path, **changes: object) -> SubmissionWriter:
    options = {"metadata": METADATA, "scene_ids": IDS, "decided_by": {"seed": 0}, "num_shards": 2} | changes
    return SubmissionWriter(path, **options)


def write(path: Path, order: tuple[int, ...] = (0, 1, 2, 3), **changes: object) -> bytes:
    with open_writer(path, **changes) as writer:
        for index in order:
            writer.add(index, SCENES[index], ROLLOUTS[index])
        writer.finish()
    return path.read_bytes()


def shard_bytes(messages: list, metadata: bytes | None = None) -> bytes:
    records = [message.SerializeToString(deterministic=True) for message in messages]
    head = METADATA.to_bytes() if metadata is None else metadata
    return head + b"".join(wire.rollouts_head(len(record)) + record for record in records)
