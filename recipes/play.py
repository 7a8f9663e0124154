"""Look at what policies do: a page that plays some scenes, log beside rollouts.

python -m recipes.play policies=[runs/pretrain/policy.pt,runs/dpa_omf/policy.pt]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig

from dpa.policy import Decoding
from dpa.report.page import write_rollouts
from dpa.report.player import PlayerScene
from dpa.rollout import make_collector, simulated_poses
from envs import keys
from envs.store import SceneStore
from recipes.cli import CONFIG, build, recipe
from recipes.models import open_policy
from recipes.scenes import open_splits


def roll_out(
    policies: Mapping[str, Path],
    scenes: SceneStore,
    wanted: Sequence[int],
    *,
    decoding: Decoding,
    num_rollouts: int = 4,
    seed: int = 0,
    device: str = "cpu",
) -> list[PlayerScene]:
    """The same scenes with rollouts of every policy.

    Args:
        policies: name -> file.
        scenes: to roll out.
        wanted: indices of the scenes.
        decoding: how tokens are drawn.
        num_rollouts: of each scene and policy.
        seed: of the sampling, the same for every policy.
        device: of the policies.
    """
    rollouts: dict[int, dict[str, torch.Tensor]] = {index: {} for index in wanted}
    for name, path in policies.items():
        model, context, _ = open_policy(path, device)
        batches = make_collector(
            scenes,
            model,
            num_rollouts=num_rollouts,
            indices=wanted,
            decoding=decoding,
            options=context,
            seed=seed,
            device=device,
        )
        for batch in batches:
            poses = simulated_poses(batch, num_rollouts).cpu()
            for row, index in enumerate(batch[keys.SCENE][::num_rollouts, 0].tolist()):
                present = int(scenes[index].agents.present.sum())
                rollouts[index][name] = poses[row, :, :present]
    return [PlayerScene(scenes[index], rollouts[index]) for index in wanted]


def named(paths: Sequence[str]) -> dict[str, Path]:
    """Policies by the name of their run's folder, or by their whole path where that is not enough.

    Examples:
        >>> list(named(["runs/pretrain/policy.pt", "runs/dpa_omf/policy.pt"]))
        ['pretrain', 'dpa_omf']
        >>> list(named(["seed_0/dpa_omf/policy.pt", "seed_1/dpa_omf/policy.pt"]))
        ['seed_0/dpa_omf/policy.pt', 'seed_1/dpa_omf/policy.pt']
    """
    names = [Path(path).parent.name for path in paths]
    return dict(zip(names if len({*names}) == len(names) else paths, map(Path, paths), strict=True))


def chosen_scenes(scenes: SceneStore, chosen: Sequence[int | str]) -> list[int]:
    """Indices of scenes that are given by id or by index.

    Raises:
        SceneError: no such scene.
        ValueError: none is given.
    """
    if not chosen:
        raise ValueError("show=[] names no scene; say for example show=[0,1].")
    return [scenes.find(str(name)) for name in chosen]


@hydra.main(**CONFIG, config_name="play")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.play``."""
    policies = named([cfg.policies] if isinstance(cfg.policies, str) else list(cfg.policies))
    scenes = open_splits(cfg.scenes)[cfg.split]
    players = roll_out(
        policies,
        scenes,
        chosen_scenes(scenes, cfg.show),
        decoding=build(Decoding, cfg.decoding, "decoding"),
        num_rollouts=cfg.num_rollouts,
        seed=cfg.seed,
        device=cfg.device,
    )
    facts = {name: str(path) for name, path in policies.items()} | {
        "decoding": f"top-p {cfg.decoding.top_p:g}, temperature {cfg.decoding.temperature:g}, seed {cfg.seed}"
    }
    print(f"page: {write_rollouts(cfg.output, players, facts)}")


if __name__ == "__main__":
    main()
