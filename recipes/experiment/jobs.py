"""The jobs of a study, each a function of the configuration and of what names it, so that any worker can run it.

A job may give the seconds that it spent for the account: on another stage, or on its own where it knows better than the
clock, which does not see what a killed process had done.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from dpa.models import Contexts, Decoding
from dpa.report.table import REFERENCE
from dpa.training.run import seconds_trained
from envs.files import write_bytes, write_json
from envs.options import differences
from envs.seeding import make_generator
from recipes.align import align
from recipes.alignment.data import ON_POLICY
from recipes.alignment.likelihoods import PROBED, divergence, make_probes, probe
from recipes.alignment.watch import Watch
from recipes.collect import collect
from recipes.common.cli import finished, finite, mean_known, told_of
from recipes.common.models import open_policy, policy_config, policy_file, weights_digest
from recipes.common.rankings import TimedDistance, build_distance, open_ranked_scenes, ranking_options
from recipes.common.scenes import fingerprint, open_splits
from recipes.evaluate import evaluate
from recipes.experiment.methods import drawing_seed, setup_of
from recipes.experiment.runs import Run, RunFolder
from recipes.pretrain import pretrain
from recipes.rerank import rerank


def pretrain_job(cfg: DictConfig, seed: int) -> dict[str, float]:
    """Reference of one seed, trained or taken over."""
    folder = runs_of(cfg).training(seed, REFERENCE)
    if cfg.reference is not None:
        adopt(reference_of(cfg, seed), folder / "policy.pt")
        return {}
    pretrain(cfg, open_splits(cfg.scenes), seed, folder)
    return {"pretrain": seconds_trained(folder)}


def compared_policy(cfg: DictConfig) -> dict[str, Any]:
    """What decides the shape of the policies of an experiment: ``model``, or without it what they are made from.

    Raises:
        ValueError: there is neither.
    """
    if cfg.get("model") is not None:
        return policy_config(cfg.model)
    if cfg.trained is not None:
        return open_policy(trained_in(cfg).policy(cfg.seeds[0], REFERENCE))[2]
    if cfg.reference is None:
        raise ValueError("there is no section model to train references of; say model=NAME, or reference=FILE.")
    return open_policy(references_of(cfg)[cfg.seeds[0]])[2]


def references_of(config: Mapping[str, Any]) -> dict[int, str | None]:
    """What each seed of an experiment starts from; None where it trains that itself."""
    given, seeds = config["reference"], config["seeds"]
    one = given is None or isinstance(given, str)
    return dict.fromkeys(seeds, given) if one else dict(zip(seeds, given, strict=True))


def reference_of(cfg: DictConfig, seed: int) -> Path:
    """The file of the policy that takes the place of a trained reference.

    Raises:
        ValueError: the zoo has none of this name, or its options are not those of ``model`` or of the first reference.
    """
    named = references_of(cfg)[seed]
    path = policy_file(named)
    check_made_alike(cfg, path, f"reference={named}")
    return path


def check_made_alike(cfg: DictConfig, policy: Path, name: str) -> None:
    """All policies of an experiment have one shape.

    Raises:
        ValueError: a policy has another one.
    """
    if differ := differences(open_policy(policy)[2], compared_policy(cfg)):
        other = "the first one" if cfg.get("model") is None else "the section model"
        raise ValueError(f"{name} was made with other options than {other} ({differ}).")


def adopt_job(cfg: DictConfig, seed: int, policy: str) -> None:
    """A reference, an aligned policy or a snapshot of the folder ``trained``."""
    adopt(trained_in(cfg).policy(seed, policy), runs_of(cfg).policy(seed, policy))


def adopt(policy: Path, place: Path) -> None:
    """Take over a policy as it is; a place that holds another one is refused.

    Raises:
        ValueError: it does.
    """
    content = policy.read_bytes()
    if place.is_file() and place.read_bytes() != content:
        raise ValueError(
            f"{place} is another policy than {policy}; name another output, or remove {place.parent.parent}."
        )
    place.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(place, content)


def collect_job(cfg: DictConfig, seed: int, split: str, source: str) -> dict[str, float]:
    """Ranked rollouts of one policy; gives the seconds of their ranking, where it is done in this process."""
    runs, scenes = runs_of(cfg), open_splits(cfg.scenes)[split]
    indices = learnt_from(cfg, len(scenes)) if split == "train" else None
    distance = TimedDistance(build_distance(cfg.collection.ranking, "collection.ranking"))
    drawn, folder = drawing_seed(cfg, seed, source), runs.preferences(seed, split, source)
    collect(cfg, scenes, runs.policy(seed, source), drawn, folder, indices, distance)
    return {"rank": distance.seconds} if cfg.collection.workers.backend == "local" else {}


def learnt_from(cfg: DictConfig, num_scenes: int) -> list[int] | None:
    """Training scenes that alignment learns from, the same ones for all seeds; None: all of them."""
    if cfg.aligned_scenes is None or cfg.aligned_scenes >= num_scenes:
        return None
    drawn = torch.randperm(num_scenes, generator=make_generator(cfg.scenes.split_seed, "aligned scenes"))
    return sorted(drawn[: cfg.aligned_scenes].tolist())


def rerank_job(cfg: DictConfig, seed: int, source: str, ranking: str) -> None:
    """The same rollouts, ranked by another distance."""
    runs, scenes = runs_of(cfg), open_splits(cfg.scenes).train
    section = ranking_options(cfg.collection.ranking, cfg.rankings[ranking])
    given, made = (runs.preferences(seed, "train", source, name) for name in (None, ranking))
    rerank(section, scenes, runs.policy(seed, source), given, made, cfg.device)


def align_job(cfg: DictConfig, seed: int, method: str) -> dict[str, float]:
    """One aligned policy."""
    runs, splits, setup = runs_of(cfg), open_splits(cfg.scenes), setup_of(cfg, method)
    folder, on_policy = runs.training(seed, method), cfg.methods[method].data.kind in ON_POLICY
    with told_of(f"methods.{method}"):
        align(
            OmegaConf.merge(cfg, {"alignment": setup.merged(cfg.alignment)}),
            cfg.methods[method],
            splits.train,
            runs.policy(seed, setup.start),
            None if on_policy else runs.preferences(seed, "train", setup.start, setup.ranking),
            drawing_seed(cfg, seed, setup.start),
            folder,
            expert=None if setup.expert is None else runs.preferences(seed, "train", setup.expert),
            watch=Watch(splits.tune, runs.preferences(seed, "tune"), runs.policy(seed, REFERENCE)),
            among=learnt_from(cfg, len(splits.train)),
            section=f"methods.{method}",
        )
    return {"align": seconds_trained(folder)}


def evaluate_job(cfg: DictConfig, seed: int, policy: str, split: str, top_p: float, temperature: float) -> None:
    """One policy at one decoding, on the tuning or the evaluation scenes."""
    if split == "tune":
        cfg = OmegaConf.merge(cfg, {"evaluation": {"num_rollouts": cfg.decoding.num_rollouts}})
    runs, scenes, run = runs_of(cfg), open_splits(cfg.scenes)[split], Run(policy, Decoding(top_p, temperature))
    evaluate(cfg, scenes, runs.policy(seed, policy), run.decoding, seed, runs.evaluation(seed, run, split))


def likelihood_job(cfg: DictConfig, seed: int, policy: str, split: str) -> None:
    """How likely logs and the reference's rollouts of a split are, and the drift from the reference."""
    runs, scenes = runs_of(cfg), open_splits(cfg.scenes)[split]
    path, store = runs.likelihood(seed, policy, split), open_ranked_scenes(runs.preferences(seed, split), scenes)
    model, options, _ = open_policy(runs.policy(seed, policy), cfg.device)
    reference, _, _ = open_policy(runs.policy(seed, REFERENCE), cfg.device)
    pairs = max(1, store.provenance.num_rollouts // 4)
    decided_by = {
        "policy": weights_digest(model),
        "reference": weights_digest(reference),
        "scenes": fingerprint(scenes),
        "pairs": pairs,
        "rollouts": cfg.drift_rollouts,
        "preferences": asdict(store.provenance),
        "seed": seed,
    }
    if finished(path, decided_by) is not None:
        return
    if len(store) != len(scenes):
        raise ValueError(
            f"{store.folder} holds {len(store)} of {len(scenes)} scenes; run the same command again to fill it."
        )
    contexts = Contexts(scenes, model.featurize, options, most=1)
    probes = make_probes(store, contexts, model.tokenizer.on_cpu(), pairs)
    found = probe(model.to(cfg.device), reference.to(cfg.device), probes, cfg.device)
    drift = divergence(
        model,
        reference,
        scenes,
        options,
        num_rollouts=cfg.drift_rollouts,
        seed=seed,
        memory=cfg.evaluation.memory,
        device=cfg.device,
    )
    per_scene = {name: [finite(each[name]) for each in found] for name in PROBED} | {"kl": list(map(finite, drift))}
    mean = {name: mean_known(values) for name, values in per_scene.items()}
    write_json(path, {"options": decided_by, "mean": mean, "scenes": scenes.scene_ids, "per_scene": per_scene})


def runs_of(cfg: DictConfig) -> RunFolder:
    """The folder of the study."""
    return RunFolder(Path(cfg.output))


def chosen_by(cfg: DictConfig) -> Path:
    """The experiment that ``decoding.chosen`` leaves the choice of checkpoints and decodings to."""
    return RunFolder(Path(cfg.decoding.chosen)).experiment(cfg.experiment.name)


def trained_in(cfg: DictConfig) -> RunFolder:
    """The folder where policies were trained: another one than the study's where they are taken over."""
    return runs_of(cfg) if cfg.trained is None else RunFolder(Path(cfg.trained))
