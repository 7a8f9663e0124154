"""Scenes of a recipe: raw files are converted once, then split into train, tune and eval."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from itertools import combinations
from pathlib import Path

import torch
from omegaconf import DictConfig, ListConfig

from envs.convert import convert
from envs.seeding import make_generator
from envs.shards import FORMAT_VERSION
from envs.sources import SOURCES
from envs.store import SceneStore
from recipes.common.cli import build


@dataclass(frozen=True)
class Splits:
    """Scenes to train on, to choose checkpoints and decoding on, and to evaluate on (never to tune on).

    Attributes:
        train: scenes that losses see.
        tune: scenes that no loss sees, for checkpoints and decoding.
        eval: scenes of files of their own.
    """

    train: SceneStore
    tune: SceneStore
    eval: SceneStore

    def __getitem__(self, name: str) -> SceneStore:
        if name not in (names := [field.name for field in fields(self)]):
            raise ValueError(f"split must be one of {', '.join(names)}, got {name!r}.")
        return getattr(self, name)

    def sizes(self) -> dict[str, int]:
        """Number of scenes of each split."""
        return {"train": len(self.train), "tune": len(self.tune), "eval": len(self.eval)}


def open_splits(cfg: DictConfig) -> Splits:
    """Open the splits that ``cfg.scenes`` describes, converting what is not converted yet.

    ``train`` and ``eval`` are what :func:`envs.convert.convert` takes for the source, or folders of stores for the
    source ``store``. So may be ``tune``; as a number it is so many of the training scenes, drawn with ``split_seed``.

    Raises:
        ValueError: nothing where a split should be, fewer training scenes than ``tune`` asks for, or scenes that are in
            two splits.
    """
    drawn = isinstance(cfg.tune, int)
    for split in ("train", "eval") if drawn else ("train", "tune", "eval"):
        inputs = _named(cfg, split)
        if cfg.source in SOURCES:  # all of it is there before any is converted, which can take hours
            SOURCES[cfg.source].find(inputs)
    train, held_out = (_chosen(_open(cfg, split), cfg.select, split) for split in ("train", "eval"))
    if drawn:
        train, tune = _drawn(train, cfg.tune, cfg.split_seed)
    else:
        tune = _chosen(_open(cfg, "tune"), cfg.select, "tune")
    for (one, first), (other, second) in combinations({"train": train, "tune": tune, "eval": held_out}.items(), 2):
        if shared := sorted(set(first.scene_ids) & set(second.scene_ids)):
            raise ValueError(
                f"scenes.{one} and scenes.{other} share {len(shared)} scenes (the first is {shared[0]!r})."
            )
    if cfg.limit is not None:
        train, held_out = (scenes.subset(range(min(cfg.limit, len(scenes)))) for scenes in (train, held_out))
    return Splits(train, tune, held_out)


def _drawn(pool: SceneStore, count: int, seed: int) -> tuple[SceneStore, SceneStore]:
    """The scenes to train on, and ``count`` others."""
    if not 0 < count < len(pool):
        raise ValueError(
            f"scenes.tune, taken from the {len(pool)} scenes of scenes.train, must leave some to train on, got "
            f"{count}; say for example scenes.tune={max(1, len(pool) // 5)}."
        )
    order = torch.randperm(len(pool), generator=make_generator(seed, "tune")).tolist()
    return pool.subset(sorted(order[count:])), pool.subset(sorted(order[:count]))


def fingerprint(scenes: SceneStore) -> str:
    """Digest of the scenes in order, of what is in them as well as of their ids: an index means nothing without it."""
    rows = zip(scenes.scene_ids, scenes.checksums.tolist(), strict=True)
    return hashlib.sha256("\n".join(f"{name} {checksum}" for name, checksum in rows).encode()).hexdigest()[:16]


def _chosen(scenes: SceneStore, select: DictConfig, split: str) -> SceneStore:
    chosen = build(scenes.select, select, "scenes.select")
    if not len(chosen):
        raise ValueError(f"scenes.select={dict(select)} leaves none of the {len(scenes)} scenes of scenes.{split}.")
    return chosen


def _named(cfg: DictConfig, split: str) -> list[str]:
    """What the user named."""
    paths = cfg[split]
    if not isinstance(paths, str | ListConfig):
        number = "a number of training scenes, " if split == "tune" else ""
        raise ValueError(f"scenes.{split} must be {number}a path or a list of paths, got {paths!r}.")
    return [paths] if isinstance(paths, str) else list(paths)


def _open(cfg: DictConfig, split: str) -> SceneStore:
    inputs = _named(cfg, split)
    if cfg.source == "store":
        return SceneStore(*inputs)
    name = hashlib.sha256("\n".join([f"{cfg.source} {FORMAT_VERSION}", *inputs]).encode()).hexdigest()[:12]
    folder = Path(cfg.cache) / f"{cfg.source}_{name}"
    return convert(cfg.source, inputs, folder, workers=cfg.workers, shard_size=cfg.shard_size, show_progress=True)
