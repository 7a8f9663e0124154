"""Make a vocabulary of logged motions, k-disks or a grid: the tokens of tokenizer=k_disks, for each class of agent.

python -m recipes.vocabulary vocabulary.size=512 output=runs/vocabulary.npz
python -m recipes.vocabulary vocabulary.maker=grid output=runs/grid.npz
python -m recipes.pretrain tokenizer@model.tokenizer=k_disks model.tokenizer.table=runs/vocabulary.npz

The file holds a card of what made it and of what it covers, which is printed as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from torch import Tensor

from dpa.tokens.vocabulary import (
    MAKERS,
    Vocabulary,
    corners,
    logged_motions,
    smallest_radius,
    stacked,
    write_vocabulary,
)
from envs.progress import progress
from envs.scene import AgentKind, Scene, SceneSource
from recipes.common.cli import CONFIG, recipe
from recipes.common.scenes import fingerprint, open_splits

MOST = 100_000
"""Motions of a class that a vocabulary is made of, drawn where there are more."""


def make_vocabulary(options: DictConfig, train: SceneSource, tune: SceneSource) -> Vocabulary:
    """A vocabulary of the motions of some scenes, with what it covers of others.

    Args:
        options: the section ``vocabulary``.
        train: scenes that the motions are of.
        tune: scenes whose motions are encoded.

    Raises:
        ValueError: no whole decision is logged of any vehicle, or an unknown maker.
    """
    if options.maker not in MAKERS:
        raise ValueError(f"vocabulary.maker must be one of {', '.join(MAKERS)}, got {options.maker!r}.")
    generator = torch.Generator().manual_seed(options.seed)
    seen, held_out = (
        logged_motions(_scenes(each, name), options.steps) for each, name in ((train, "train"), (tune, "tune"))
    )
    if not len(seen[AgentKind.VEHICLE]):
        raise ValueError(f"no vehicle of these {len(train)} scenes is logged for {options.steps} steps in a row.")
    entries, classes = {}, {}
    for kind, motions in seen.items():
        if not len(motions):
            continue
        motions = motions[torch.randperm(len(motions), generator=generator)[:MOST]]
        radius = options.radius or smallest_radius(options.maker, motions, kind, options.size, options.seed)
        entries[kind] = MAKERS[options.maker](motions, kind, options.size, radius, generator)
        classes[kind.name.lower()] = {
            "motions": len(motions), "entries": len(entries[kind]), "radius": radius,
            **coverage(held_out[kind], entries[kind], kind, radius),
        }  # fmt: skip
    made = {"maker": options.maker, "steps": options.steps, "size": options.size, "classes": classes}
    return Vocabulary(stacked(entries), made)


def coverage(motions: Tensor, entries: Tensor, kind: AgentKind, radius: float) -> dict[str, float | int | None]:
    """How well entries stand for motions that they were not made of.

    Returns:
        Number of motions, the share of them within the radius of an entry (``covered``), and the mean and 99th
        percentile of the distance to the nearest one [m]: root mean squares over corners and poses.
    """
    if not len(motions):
        return {"held_out": 0, "covered": None, "mean": None, "p99": None}
    points, table = corners(motions, kind), corners(entries, kind)
    nearest = torch.cat([torch.cdist(part, table).amin(-1) for part in points.split(4096)])
    nearest = (nearest / (4 * motions.shape[1]) ** 0.5).sort().values
    return {
        "held_out": len(nearest),
        "covered": (nearest <= radius).float().mean().item(),
        "mean": nearest.mean().item(),
        "p99": nearest[int(0.99 * (len(nearest) - 1))].item(),
    }


def _scenes(scenes: SceneSource, name: str) -> Iterator[Scene]:
    return (scenes[index] for index in progress(range(len(scenes)), f"motions {name}", unit="scene"))


def told(card: dict[str, Any]) -> Table:
    """The card as a table."""
    table = Table("agents", "motions", "entries", "radius [m]", "held out", "covered", "mean [m]", "p99 [m]")
    for name, row in card["classes"].items():
        shares = ("–" if row["covered"] is None else f"{row['covered']:.1%}",)
        errors = ("–" if row[each] is None else f"{row[each]:.3f}" for each in ("mean", "p99"))
        counts = (f"{row[each]:,}" for each in ("motions", "entries"))
        table.add_row(name, *counts, f"{row['radius']:.3f}", f"{row['held_out']:,}", *shares, *errors)
    return table


@hydra.main(**CONFIG, config_name="vocabulary")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.vocabulary``."""
    splits, output = open_splits(cfg.scenes), Path(cfg.output)
    made = make_vocabulary(cfg.vocabulary, splits.train, splits.tune)
    made.card["scenes"] = fingerprint(splits.train)
    write_vocabulary(output, made)
    Console(markup=False, width=110).print(told(made.card))


if __name__ == "__main__":
    main()
