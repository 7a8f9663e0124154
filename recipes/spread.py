"""How far each feature of rollouts lies from that of the log, and what share of the cost follows (method.md section 3).

    python -m recipes.collect policy=runs/pretrain/policy.pt
    python -m recipes.spread policy=runs/pretrain/policy.pt preferences=runs/preferences

The spread of a feature is the root mean square of the difference between rollouts and log at the same step, both
clipped, over all valid agent-steps. It goes into the feature's decorator, and ``weights="normalised"`` divides by it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import hydra
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from dpa.ranking.features import FEATURES, feature_names, feature_weights, log_trajectory, occupancy_features
from envs.files import write_json
from envs.progress import progress
from recipes.common.cli import CONFIG, recipe
from recipes.common.models import open_policy
from recipes.common.rankings import open_preferences
from recipes.common.rolled import Rolled, stored
from recipes.common.scenes import open_splits


class Spread(NamedTuple):
    """Of one feature.

    Attributes:
        feature: its name.
        spread: root mean square of the difference between rollouts and log at the same step [the feature's unit].
        paper: share in the squared cost of steps coupled with themselves, with the paper's weights.
        normalised: the same with the normalised weights that are registered.
    """

    feature: str
    spread: float
    paper: float
    normalised: float


def spreads(rollouts: Iterable[Rolled], names: Sequence[str]) -> list[Spread]:
    """Measure the spread of some features over the controlled agents.

    Args:
        rollouts: scenes, each with its rollouts.
        names: of the features.

    Raises:
        ValueError: no agent-step of any log is valid.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> scene = straight_road(1, speed=10.0)
        >>> log = log_trajectory(scene, 80)
        >>> faster = log + torch.arange(1, 81)[:, None] * torch.tensor([0.2, 0, 0, 0])
        >>> spreads([Rolled(0, scene, faster[None], torch.tensor([True]))], ["speed"])[0].spread
        2.0
    """
    total, count = torch.zeros(len(names), dtype=torch.float64), 0
    for _, scene, poses, controlled in rollouts:
        both = torch.cat((poses, log_trajectory(scene, poses.shape[2])[None]))
        phi, valid = occupancy_features(scene, both, names, ego=controlled.nonzero()[:, 0])
        total += (phi[:-1] - phi[-1:]).double().square().sum((0, 1, 2))
        count += len(poses) * int(valid.sum())
    if not count:
        raise ValueError("no agent-step of these scenes has a valid log, so there is nothing to measure; take others.")
    square = total / count
    paper, normalised = (
        share / share.sum().clamp(min=torch.finfo(share.dtype).tiny)
        for share in (feature_weights(names, weights) * square for weights in (None, "normalised"))
    )
    columns = (square.sqrt().tolist(), paper.tolist(), normalised.tolist())
    return [Spread(*row) for row in zip(names, *columns, strict=True)]


def weights_of(rows: Iterable[Spread]) -> str:
    """Weights normalised by measured spreads, as an option of a ranking; a feature that never differs keeps its own.

    Examples:
        >>> weights_of([Spread("collision", 0.1, 0.1, 0.5), Spread("speed", 2.0, 0.9, 0.5)])
        '{collision:1e+03,speed:0.25}'
    """
    weights = {row.feature: FEATURES[row.feature].weight / (row.spread or 1.0) ** 2 for row in rows}
    return "{" + ",".join(f"{name}:{weight:.3g}" for name, weight in weights.items()) + "}"


@hydra.main(**CONFIG, config_name="spread")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.spread``."""
    names = feature_names(cfg.features if isinstance(cfg.features, str) else list(cfg.features))
    if cfg.split == "eval":
        raise ValueError("split=eval: spreads become part of a distance, which is not fitted on evaluation scenes.")
    model, options, _ = open_policy(cfg.policy)
    scenes = open_splits(cfg.scenes)[cfg.split]
    store = open_preferences(cfg.preferences, scenes, model, cfg.policy)
    every = progress(range(len(store)), "spread", unit="scene")
    rows = spreads(stored(store, every, scenes, model, options), names)
    table = Table(title=f"{len(store)} scenes, {store.provenance.num_rollouts} rollouts each", title_justify="left")
    for title in ("feature", "unit", "weight", "spread", "share, paper", "share, normalised"):
        table.add_column(title, justify="left" if title in ("feature", "unit") else "right")
    for row in rows:
        feature = FEATURES[row.feature]
        numbers = (f"{row.spread:.3g}", f"{row.paper:.1%}", f"{row.normalised:.1%}")
        table.add_row(row.feature, feature.unit, f"{feature.weight:g}", *numbers)
    Console(markup=False, width=100).print(table)
    print(f"weights that these spreads normalise: 'ranking.weights={weights_of(rows)}'")
    if cfg.json is not None:
        write_json(cfg.json, [row._asdict() for row in rows])


if __name__ == "__main__":
    main()
