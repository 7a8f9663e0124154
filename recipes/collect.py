"""Roll a policy out, rank its rollouts against the log, and keep them as preferences (method.md sections 3 and 4).

    python -m recipes.collect policy=runs/pretrain/policy.pt
    python -m dpa.preferences info runs/preferences

Run the same command again to go on after a kill. Several commands may fill one folder at the same time: each skips what
is stored when it starts and, with ``part`` and ``parts``, does a part of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import hydra
from omegaconf import DictConfig

from dpa.models import Decoding
from dpa.preferences import PreferenceStore, PreferenceWriter, Provenance, data_card
from dpa.ranking import Distance
from dpa.ranking.transform import RankRollouts
from dpa.rollout import Workers, make_collector
from dpa.rollout.collector import rows_within
from envs.files import write_json
from envs.progress import progress
from envs.store import SceneStore
from recipes.common.cli import CONFIG, build, plain, recipe
from recipes.common.models import given_policy, open_policy, weights_digest
from recipes.common.rankings import build_distance
from recipes.common.scenes import fingerprint, open_splits


def collect(
    cfg: DictConfig,
    scenes: SceneStore,
    policy: Path,
    seed: int,
    folder: Path,
    indices: Sequence[int] | None = None,
    distance: Distance | None = None,
) -> PreferenceStore:
    """Fill a preference store with ranked rollouts of the scenes that it lacks.

    Args:
        cfg: with the sections ``collection`` and ``device``.
        scenes: to roll out.
        policy: file of the policy.
        seed: of the sampling.
        folder: of the store.
        indices: scenes to roll out; all by default.
        distance: that ranks; by default the one that the options name.
    """
    indices = range(len(scenes)) if indices is None else indices
    options = cfg.collection
    model, episode, config = open_policy(policy, cfg.device)
    distance = distance or build_distance(options.ranking, "collection.ranking")
    # What is wrong with an option is told before a store is begun with it.
    decoding, workers = check_collection(options)
    rows_within(options.memory, model)
    provenance = Provenance(
        policy=weights_digest(model),
        scenes=fingerprint(scenes),
        ranking=distance.describe(),
        sampling=plain(options.decoding) | {"precision": options.precision},
        seed=seed,
        num_rollouts=options.num_rollouts,
        horizon=episode.horizon,
        vocab_size=model.tokenizer.vocab_size,
        tokenizer=config["tokenizer"],
    )
    with PreferenceWriter(folder, provenance, chunk_scenes=options.chunk_scenes) as writer:
        done = writer.scenes_done
        with progress(
            total=len(indices), description="collect", initial=len(done.intersection(indices)), unit="scene"
        ) as bar:
            for groups in make_collector(
                scenes,
                model,
                num_rollouts=options.num_rollouts,
                indices=indices,
                done=done,
                decoding=decoding,
                options=episode,
                seed=seed,
                make_postproc=partial(RankRollouts, num_rollouts=options.num_rollouts, distance=distance),
                workers=workers,
                memory=options.memory,
                device=cfg.device,
                precision=options.precision,
                compile=options.compile,
            ):
                bar.update(writer.append(groups))
    return PreferenceStore(folder)


def check_collection(options: DictConfig) -> tuple[Decoding, Workers]:
    """How tokens are drawn and by whom.

    Args:
        options: the section ``collection``.

    Raises:
        ValueError: naming the option that cannot be.
    """
    decoding = build(Decoding, options.decoding, "collection.decoding")
    workers = build(Workers, options.workers, "collection.workers")
    if options.num_rollouts < 1:
        raise ValueError(f"collection.num_rollouts must be 1 or more, got {options.num_rollouts}.")
    return decoding, workers


@hydra.main(**CONFIG, config_name="collect")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.collect``."""
    policy = given_policy(cfg.policy)
    scenes = open_splits(cfg.scenes)[cfg.split]
    if not 0 <= cfg.part < cfg.parts:
        raise ValueError(f"part must be from 0 to parts - 1, got part={cfg.part} of parts={cfg.parts}.")
    indices = range(cfg.part, len(scenes), cfg.parts)
    store = collect(cfg, scenes, policy, cfg.seed, Path(cfg.output), indices)
    if cfg.json is not None:
        write_json(cfg.json, data_card(store).to_json())
    print(f"preferences of {len(store)} scenes: {cfg.output}")


if __name__ == "__main__":
    main()
