"""Pre-train a MotionLM by next-token prediction on logged traffic (METHOD eq. 1).

    python -m recipes.pretrain                                   # SUMO scenes, made on the spot
    python -m recipes.pretrain scenes=gpudrive scenes.train=DIR scenes.eval=DIR output=runs/reference

The weights that are best on the tuning scenes become ``policy.pt``. Run the same command again to go on after a kill.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict

from dpa.losses import NextTokenLoss, token_network
from dpa.policy import MotionLM, make_context
from dpa.training.batches import Item, ShuffledOrder, collate_items, crop_agents, log_item, micro_batches
from dpa.training.optim import accumulate_gradients, clip_and_step, make_optimizer, make_schedule
from dpa.training.run import Run
from dpa.training.seeding import seed_everything
from envs import keys
from envs.augment import mirror
from envs.progress import progress
from envs.scene import SceneSource
from envs.seeding import make_generator
from recipes.cli import CONFIG, check_steps, finished, plain, recipe, write_json
from recipes.models import build_policy, context_options, policy_config, write_policy
from recipes.scenes import Splits, fingerprint, open_splits


def pretrain(cfg: DictConfig, splits: Splits, seed: int, folder: Path) -> Path:
    """Train one reference policy.

    Args:
        cfg: with the sections ``model``, ``pretraining``, ``logger``, ``device``.
        splits: scenes.
        seed: of everything that draws.
        folder: of the run.

    Returns:
        The file of the policy.
    """
    path, result, options = folder / "policy.pt", folder / "result.json", cfg.pretraining
    config = policy_config(cfg.model)
    decided_by = {"policy": config, "pretraining": plain(options), "seed": seed, "scenes": fingerprint(splits.train)}
    if finished(result, decided_by) is not None and path.is_file():
        return path
    seed_everything(seed)
    model = build_policy(config).to(cfg.device)
    best = copy.deepcopy(model)
    train = log_items(splits.train, cfg, model, copies=options.copies, noise=options.noise, mirrored=options.mirror)
    tune = log_items(splits.tune, cfg, model)
    loss = NextTokenLoss(token_network(model), label_smoothing=options.label_smoothing)
    loss.set_keys(labels=keys.LABELS)
    optimizer = make_optimizer(model, options.lr, options.weight_decay)
    schedule = make_schedule(optimizer, options.steps, options.warmup)
    order = ShuffledOrder(len(train), options.batch_size, seed)
    run = Run(
        folder,
        {"policy": model, "best": best, "optimizer": optimizer, "schedule": schedule},
        config=decided_by,
        total_steps=options.steps,
        checkpoint_interval=options.checkpoint_interval,
        backend=cfg.logger.backend,
        mode=cfg.logger.mode,
        description="pretrain",
    )
    run.state.setdefault("best_nll", float("inf"))
    with run:
        for step in run.steps():
            crop = make_generator(seed, "crop", step)
            items = [crop_agents(train[i], options.max_agents, crop) for i in order(step)]
            losses = accumulate_gradients(loss, parts_of(items, options.max_rows, cfg.device))
            norm = clip_and_step(optimizer, options.max_norm, schedule)
            run.log({f"train/{key}": value for key, value in losses.items()} | {"train/gradient_norm": norm})
            if (step + 1) % options.tune_interval == 0 or step + 1 == options.steps:
                measured = negative_log_likelihood(model, tune, options.max_agents, cfg.device)
                run.log({f"tune/{key}": value for key, value in measured.items()})
                if measured["nll"] < run.state["best_nll"]:
                    run.state["best_nll"] = measured["nll"]
                    best.load_state_dict(model.state_dict())
    write_policy(path, best, config, {"method": "reference", "seed": seed, "tune_nll": run.state["best_nll"]})
    write_json(result, {"options": decided_by, "policy": str(path), "tune_nll": run.state["best_nll"]})
    return path


def parts_of(items: list[Item], max_rows: int, device: str) -> Iterator[tuple[TensorDict, float]]:
    """Items of similar size as batches, each with its share of the valid tokens: the loss is a mean over tokens."""
    tokens = [int(item.token_valid.sum()) for item in items]
    for part in micro_batches([item.tokens.shape[1] for item in items], max_rows):
        share = sum(tokens[i] for i in part) / sum(tokens)
        yield collate_items([items[i] for i in part]).to(device), share


def log_items(
    scenes: SceneSource,
    cfg: DictConfig,
    model: MotionLM,
    *,
    copies: int = 1,
    noise: float = 0.0,
    mirrored: bool = False,
) -> list[Item]:
    """Tokenized logs of all scenes: ``copies`` with noise of their own, and as many of their mirror images."""
    options, tokenizer = context_options(cfg.model), copy.deepcopy(model.tokenizer).cpu()
    items = []
    for index in progress(range(len(scenes)), "tokens", unit="scene"):
        scene, draw = scenes[index], make_generator(0, "noise", index)
        for image in [scene, mirror(scene)] if mirrored else [scene]:
            context = make_context(image, options)
            items += [log_item(context, tokenizer, noise=noise, generator=draw) for _ in range(copies)]
    return [item for item in items if item.token_valid.any()]


@torch.no_grad()
def negative_log_likelihood(model: MotionLM, items: list[Item], max_agents: int, device: str) -> dict[str, float]:
    """Per valid token [nats]: ``nll`` of all agents and ``nll_moving`` of those whose velocity changes at all.

    A standing agent repeats one token and is easy; it would hide how moving agents are predicted.
    """
    model.eval()
    totals = torch.zeros(2, 2, dtype=torch.float64)
    for index, item in enumerate(items):
        batch = collate_items([crop_agents(item, max_agents, make_generator(0, "tune", index))]).to(device)
        tokens, valid = batch["tokens"], batch["token_valid"]
        logits = model(batch["context"], tokens, valid)
        nll = -logits.log_softmax(-1).gather(-1, tokens[..., None])[..., 0].cpu()
        valid, tokens = valid.cpu(), tokens.cpu()
        changes = ((tokens != tokens[..., :1]) & valid).any(-1, keepdim=True)
        for row, mask in enumerate((valid, valid & changes)):
            totals[row] += torch.tensor([nll[mask].sum(), mask.sum()], dtype=torch.float64)
    model.train()
    every, moving = (totals[:, 0] / totals[:, 1].clamp(min=1)).tolist()
    return {"nll": every, "nll_moving": moving}


@hydra.main(**CONFIG, config_name="pretrain")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.pretrain``."""
    check_steps(cfg.pretraining, "pretraining")
    path = pretrain(cfg, open_splits(cfg.scenes), cfg.seed, Path(cfg.output))
    print(f"policy: {path}")


if __name__ == "__main__":
    main()
