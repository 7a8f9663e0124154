"""Pre-train a policy by next-token prediction on logged traffic (eq. 1 of the paper).

    python -m recipes.pretrain                                   # SUMO scenes, made on the spot
    python -m recipes.pretrain scenes=gpudrive scenes.train=DIR scenes.eval=DIR output=runs/reference
    python -m recipes.pretrain '~model' pretraining.start=zoo:smart-nano-sumo ...          # goes on from a policy
    torchrun --nproc-per-node 8 -m recipes.pretrain device=cuda pretraining.batch_size=64  # docs/scale.md

The weights that are best on the tuning scenes become ``policy.pt``. Run the same command again to go on after a kill.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from torch import Tensor, nn

from dpa.losses import NextTokenLoss, token_network
from dpa.models import MotionModel
from dpa.models.base import Auxiliary
from dpa.models.contract import check_contract
from dpa.training.batches import Item, collate_items, micro_batches
from dpa.training.checkpoint import load_policy, load_weights
from dpa.training.distributed import ALONE, Ranks, join_ranks
from dpa.training.logs import LogItems
from dpa.training.optim import accumulate_gradients, clip_and_step, make_optimizer, make_schedule
from dpa.training.run import Run
from dpa.training.seeding import seed_everything
from envs import keys
from envs.episode import EpisodeOptions
from envs.files import write_json
from envs.loader import SceneLoader
from envs.progress import progress
from envs.scene import SceneSource
from envs.seeding import make_generator
from recipes.common.cli import CONFIG, check_steps, deciding, finished, ranked_recipe
from recipes.common.models import (
    build_policy,
    check_written,
    digest_of,
    fresh_policy,
    policy_config,
    policy_file,
    write_policy,
)
from recipes.common.provenance import provenance
from recipes.common.scenes import Splits, fingerprint, open_splits

OBSERVING = ("checkpoint_interval", "max_rows", "workers", "keep_gib", "start")
"""Options of the section ``pretraining`` that change nothing about the policy, but what dropout and an auxiliary loss
draw in a pass; of its start, the weights count."""


def pretrain(
    cfg: DictConfig,
    splits: Splits,
    seed: int,
    folder: Path,
    ranks: Ranks = ALONE,
    *,
    made_by: dict[str, Any] | None = None,
) -> Path:
    """Train one reference policy.

    Args:
        cfg: with the sections ``scenes``, ``model``, ``pretraining``, ``logger``, ``device``.
        splits: scenes.
        seed: of everything that draws.
        folder: of the run.
        ranks: that train together; the batch of the options is theirs together.
        made_by: :func:`~recipes.common.provenance.provenance`, for the file of the policy.

    Returns:
        The file of the policy.

    Raises:
        ValueError: options that do not fit, or a folder with other options.
    """
    path, result, options = folder / "policy.pt", folder / "result.json", cfg.pretraining
    origin = None if options.start is None else Origin.open(options.start)
    config = config_to_train(cfg, origin)
    decided_by = {
        "policy": config,
        "pretraining": deciding(options, *OBSERVING),
        "seed": seed,
        "scenes": fingerprint(splits.train),
        "tuning_scenes": fingerprint(splits.tune),
    }
    if origin is not None:
        decided_by["start"] = origin.digest
    if ranks.agree(finished(result, decided_by) is not None and path.is_file(), "finished =", folder):
        check_written(path)
        return path
    seed_everything(seed)
    device, episode = ranks.place(cfg.device), EpisodeOptions(**config["episode"])
    model = (build_policy(config) if cfg.get("model") is None else fresh_policy(cfg.model)).to(device)
    if origin is None:
        check_contract(model)
    else:
        origin.load_into(model, config)
    best = copy.deepcopy(model)
    train = training_items(cfg, splits.train, model, episode, seed, ranks)
    tune = tuning_items(cfg, splits.tune, model, episode, ranks)
    beside = auxiliary_of(model, options.auxiliary)
    trained = nn.ModuleDict({"policy": model, **beside}).to(device)
    loss = NextTokenLoss(
        token_network(model, options.precision),
        label_smoothing=options.label_smoothing,
        auxiliary=beside.get("auxiliary"),
        auxiliary_weight=options.auxiliary,
    )
    loss.set_keys(labels=keys.LABELS)
    loss = ranks.wrap(loss)
    optimizer = make_optimizer(trained, options.lr, options.weight_decay, kind=options.optimizer, rms=options.rms)
    schedule = make_schedule(optimizer, options.steps, options.warmup, options.schedule)
    run = Run(
        folder,
        {**trained, "best": best, "optimizer": optimizer, "schedule": schedule},
        config=decided_by,
        total_steps=options.steps,
        checkpoint_interval=options.checkpoint_interval,
        backend=cfg.logger.backend,
        mode=cfg.logger.mode,
        description="pretrain",
        ranks=ranks,
    )
    run.state.setdefault("best_nll", float("inf"))
    if "train" in run.state:
        train.load_state_dict(run.state["train"])
    batches = train.endless()
    with run:
        if origin is not None and run.first_step == 0:
            look(run, model, best, tune, device, ranks)
        for step in run.steps():
            items = next(batches)
            run.state["train"] = train.state_dict()
            ranks.seed_dropout(seed, step)
            losses = accumulate_gradients(loss, parts_of(items, options.max_rows, device, ranks), ranks)
            norm = clip_and_step(optimizer, options.max_norm, schedule)
            run.log({f"train/{key}": value for key, value in losses.items()} | {"train/gradient_norm": norm})
            if (step + 1) % options.tune_interval == 0 or step + 1 == options.steps:
                look(run, model, best, tune, device, ranks)
        if ranks.main:
            made = {
                "method": "reference",
                "seed": seed,
                "tune_nll": run.state["best_nll"],
                "source": cfg.scenes.source,
                "start": None if origin is None else origin.described,
                "made_by": made_by,
            }
            write_policy(path, best, config, made)
            told = {"policy": str(path), "num_scenes": len(splits.train), "tune_nll": run.state["best_nll"]}
            write_json(result, {"options": decided_by} | told)
    ranks.wait()
    return path


def config_to_train(cfg: DictConfig, origin: Origin | None) -> dict[str, Any]:
    """What decides the policy's shape: ``model``, or without it that of ``pretraining.start``.

    Raises:
        ValueError: there is neither.
    """
    if cfg.get("model") is not None:
        return policy_config(cfg.model)
    if origin is None:
        raise ValueError("there is no section model: say model=NAME, or pretraining.start=FILE to go on from a policy.")
    return origin.config


def auxiliary_of(model: MotionModel, weight: float) -> dict[str, Auxiliary]:
    """The auxiliary loss of the policy's family by its name, where it has a weight.

    Raises:
        ValueError: the weight is negative, or the family has none.
    """
    if weight < 0:
        raise ValueError(f"pretraining.auxiliary must be at least 0, got {weight}.")
    if not weight:
        return {}
    auxiliary = model.auxiliary()
    if auxiliary is None:
        raise ValueError(
            f"{type(model).__name__} has no auxiliary loss, and pretraining.auxiliary={weight} asks for one; say 0."
        )
    return {"auxiliary": auxiliary}


def look(run: Run, model: MotionModel, best: MotionModel, tune: list[Item], device: str, ranks: Ranks = ALONE) -> None:
    """Measure the model on the tuning scenes; ``best`` becomes its copy where it is better than all before."""
    measured = negative_log_likelihood(model, tune, device, ranks)
    run.log({f"tune/{key}": value for key, value in measured.items()})
    if measured["nll"] < run.state["best_nll"]:
        run.state["best_nll"] = measured["nll"]
        best.load_state_dict(model.state_dict())


@dataclass(frozen=True)
class Origin:
    """The policy that a training starts from.

    Attributes:
        file: of the policy.
        weights: of it.
        config: of it.
        made: how it came about, as its file says.
        digest: of its weights.
    """

    file: Path
    weights: dict[str, Tensor]
    config: dict[str, Any]
    made: dict[str, Any]
    digest: str

    @classmethod
    def open(cls, name: str) -> Origin:
        """Read a policy.

        Args:
            name: its file, or its name in the zoo.
        """
        file = policy_file(name)
        weights, config, made = load_policy(file)
        return cls(file, weights, config, made, digest_of(weights))

    def load_into(self, model: MotionModel, config: dict[str, Any]) -> None:
        """Give a model these weights.

        Raises:
            ValueError: the model has other tokens, another size, or sees scenes in another way.
        """
        load_weights(model, self.weights, self.config, config, where=f"pretraining.start={self.file}")

    @property
    def described(self) -> dict[str, Any]:
        """For the file of what becomes of it."""
        return {"weights": self.digest, **self.made}


def parts_of(items: list[Item], max_rows: int, device: str, ranks: Ranks = ALONE) -> Iterator[tuple[TensorDict, float]]:
    """Items of similar size as batches, each with its share of the valid tokens of all ranks."""
    tokens = [int(item.token_valid.sum()) for item in items]
    total = max(1, int(ranks.sum(torch.tensor(sum(tokens)))))
    for part in micro_batches([item.tokens.shape[1] for item in items], max_rows):
        share = sum(tokens[i] for i in part) / total
        yield collate_items([items[i] for i in part]).to(device), share


def training_items(
    cfg: DictConfig,
    scenes: SceneSource,
    model: MotionModel,
    episode: EpisodeOptions,
    seed: int,
    ranks: Ranks = ALONE,
) -> SceneLoader:
    """Lists of tokenized logs for this rank, read as they are needed: what is kept of them is bounded."""
    options = cfg.pretraining
    logs = LogItems(
        scenes,
        model.tokenizer.on_cpu(),
        model.featurize,
        episode,
        mirror=options.mirror,
        noise=options.noise,
        recovery=options.recovery,
        max_agents=options.max_agents,
        keep_gib=options.keep_gib,
    )
    return SceneLoader(
        logs,
        ranks.share_of(options.batch_size, "pretraining.batch_size"),
        seed=seed,
        prepare=logs.prepare,
        collate=logs.collate,
        rank=ranks.rank,
        world_size=ranks.world_size,
        workers=options.workers,
        drop_last=False,
    )


def tuning_items(
    cfg: DictConfig, scenes: SceneSource, model: MotionModel, episode: EpisodeOptions, ranks: Ranks = ALONE
) -> list[Item]:
    """This rank's part of the tokenized logs of a few scenes, always the same.

    Noise is as in training: labels that lead back slowly are not the tokens of clean logs, and by those a policy that
    learns them would be judged by something else.
    """
    learnt = cfg.pretraining
    logs = LogItems(
        scenes,
        model.tokenizer.on_cpu(),
        model.featurize,
        episode,
        noise=learnt.noise,
        recovery=learnt.recovery,
        max_agents=learnt.max_agents,
    )
    bar = progress(ranks.mine(range(len(scenes))), "tokens", unit="scene", disable=not ranks.main)
    items = logs.collate([logs.prepare(index, make_generator(0, "tune", index)) for index in bar])
    if not ranks.sum(torch.tensor(sum(int(item.token_valid.sum()) for item in items))):
        raise ValueError(
            f"none of the {len(scenes)} tuning scenes has a token to predict: no agent that the policy controls "
            f"(model.episode.control={episode.control}) has a log after the current step; say "
            "model.episode.control=all, or name other scenes.tune."
        )
    return items


@torch.no_grad()
def negative_log_likelihood(
    model: MotionModel, items: list[Item], device: str, ranks: Ranks = ALONE
) -> dict[str, float]:
    """Of labels, per valid token [nats]: ``nll`` of all agents and ``nll_moving`` of those whose labels change at all.

    A standing agent repeats one token and is easy; it would hide how moving agents are predicted. Each rank gives the
    items that it measures; sums and counts are added up, so it is the mean over the items of all ranks.
    """
    model.eval()
    totals = torch.zeros(2, 2, dtype=torch.float64)
    for item in items:
        batch = collate_items([item]).to(device)
        labels, valid = batch[keys.LABELS], batch["token_valid"]
        logits = model(batch["context"], batch["tokens"], valid)
        nll = -model.distribution.log_prob(logits, labels).cpu()
        valid, labels = valid.cpu(), labels.cpu()
        changes = (~model.tokenizer.alike(labels, labels[:, :, :, :1]) & valid).any(-1, keepdim=True)
        for row, mask in enumerate((valid, valid & changes)):
            totals[row] += torch.tensor([nll[mask].sum(), mask.sum()], dtype=torch.float64)
    model.train()
    totals = ranks.sum(totals)
    every, moving = (totals[:, 0] / totals[:, 1].clamp(min=1)).tolist()
    return {"nll": every, "nll_moving": moving}


@hydra.main(**CONFIG, config_name="pretrain")
@ranked_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.pretrain``."""
    check_steps(cfg.pretraining, "pretraining")
    start = cfg.pretraining.start
    config_to_train(cfg, None if start is None else Origin.open(start))  # refused before scenes are converted
    splits = open_splits(cfg.scenes)
    with join_ranks(cfg.device) as ranks:
        made_by = provenance("pretrain", cfg.device)
        path = pretrain(cfg, splits, cfg.seed, Path(cfg.output), ranks, made_by=made_by)
        if ranks.main:
            print(f"policy: {path}")


if __name__ == "__main__":
    main()
