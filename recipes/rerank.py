"""Rank the rollouts of a preference store by another distance: they are not rolled out again.

python -m recipes.rerank policy=runs/pretrain/policy.pt preferences=runs/preferences ranking.features=progress
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import hydra
from omegaconf import DictConfig
from torch import Tensor

from dpa.preferences import PreferenceStore, PreferenceWriter
from dpa.ranking import Ranking
from dpa.ranking.distance import rank_of
from envs import keys
from envs.progress import progress
from envs.store import SceneStore
from recipes.common.cli import CONFIG, recipe
from recipes.common.models import given_policy, open_policy
from recipes.common.rankings import build_distance, open_preferences
from recipes.common.rolled import stored
from recipes.common.scenes import open_splits


def rerank(
    ranking: DictConfig, scenes: SceneStore, policy: Path, preferences: Path, folder: Path, device: str = "cpu"
) -> PreferenceStore:
    """Fill a preference store with the rollouts of another one, ranked anew; goes on after a kill.

    Args:
        ranking: options of the distance, as in ``config/ranking``.
        scenes: that the rollouts are of.
        policy: file of the policy that made them.
        preferences: folder of the store that holds them.
        folder: of the store to fill.
        device: where distances rank that can do so anywhere.
    """
    model, options, _ = open_policy(policy)
    store, distance = open_preferences(preferences, scenes, model, policy), build_distance(ranking, "ranking")
    provenance = replace(store.provenance, ranking=distance.describe())
    there = device if getattr(distance, "on_device", False) else "cpu"
    with PreferenceWriter(folder, provenance) as writer:
        done = writer.scenes_done
        rows = [row for row, scene in enumerate(store.scenes.tolist()) if scene not in done]
        bar = progress(total=len(store), description="rank", initial=len(store) - len(rows), unit="scene")
        with bar:
            for row, each in zip(rows, stored(store, rows, scenes, model, options), strict=True):
                ranked = distance(each.scene, each.trajectories.to(there), each.controlled)
                group = store.read([row], num_agents=each.trajectories.shape[1])
                writer.append(group.update(_fields(ranked)))
                bar.update()
    return PreferenceStore(folder)


def _fields(ranked: Ranking) -> dict[str, Tensor]:
    """What a ranking decides, for a batch of one group."""
    fields = {
        keys.DISTANCE: ranked.distance,
        keys.AGENT_DISTANCE: ranked.agent_distance,
        keys.ADE: ranked.ade,
        keys.AGENT_RANKED: ranked.agent_ranked,
        keys.FEATURE_SHARE: ranked.feature_share,
        keys.RANK: rank_of(ranked.distance),
    }
    return {key: value[None].cpu() for key, value in fields.items()}


@hydra.main(**CONFIG, config_name="rerank")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.rerank``."""
    policy = given_policy(cfg.policy)
    scenes = open_splits(cfg.scenes)[cfg.split]
    store = rerank(cfg.ranking, scenes, policy, Path(cfg.preferences), Path(cfg.output), cfg.device)
    print(f"preferences of {len(store)} scenes: {cfg.output}")


if __name__ == "__main__":
    main()
