"""Training of a discriminator on motions that are kept on disk: one loop, stopped early by scenes held out of it."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from dpa.discriminator import Discriminator, auc, discriminator_loss
from dpa.training.batches import ShuffledOrder
from dpa.training.optim import clip_and_step, make_optimizer
from dpa.training.run import Run
from dpa.training.seeding import seed_everything
from envs.seeding import make_generator
from recipes.studies.motions import Motions, MotionShelf

Curve = list[dict[str, float]]
"""One entry for each look: ``step``, ``train_loss``, ``held_out_loss`` [nats], ``held_out_auc``."""


def fit(
    options: DictConfig,
    shape: dict[str, int],
    shelf: MotionShelf,
    folder: Path,
    *,
    seed: int,
    decided_by: dict[str, Any],
    logger: DictConfig,
) -> tuple[Discriminator, Curve]:
    """Train on the scenes of a shelf until the scenes held out of it say that it is enough.

    Args:
        options: ``training`` of the recipe.
        shape: arguments of the discriminator.
        shelf: of the motions.
        folder: of the run; a run that was killed goes on.
        seed: of everything that draws.
        decided_by: all that decides the run.
        logger: where curves go.

    Returns:
        The discriminator of the best look, and the curve of all looks.

    Raises:
        ValueError: not a scene is left to train on or to hold out.
    """
    train, held_out = split_of(_with_agents(shelf), options.held_out, seed)
    seed_everything(seed)
    net = Discriminator(**shape)
    net.standardise(torch.cat([_steps(shelf.get(scene)) for scene in train]))
    best = copy.deepcopy(net)
    run = Run(
        folder,
        {"net": net, "best": best, "optimizer": (optimizer := make_optimizer(net, options.lr, options.weight_decay))},
        config=decided_by,
        total_steps=options.steps,
        checkpoint_interval=options.checkpoint_interval,
        backend=logger.backend,
        mode=logger.mode,
        description=f"{folder.name} discriminator",
    )
    run.state = {"curve": [], "waited": 0, "loss": 0.0} | run.state
    order = ShuffledOrder(len(train), options.batch_scenes, seed)
    with run:
        for step in run.steps():
            if run.state["waited"] >= options.patience:
                break
            scenes = [train[i] for i in order(step)]
            loss = discriminator_loss(net, *_batch(shelf, scenes, make_generator(seed, "rollouts", step)))
            loss.backward()
            norm = clip_and_step(optimizer, options.max_norm)
            run.state["loss"] += loss.item()
            run.log({"train/loss": loss.item(), "train/gradient_norm": norm})
            if (step + 1) % options.look_interval == 0 or step + 1 == options.steps:
                look = measured_on(net, [shelf.get(scene) for scene in held_out])
                run.log({f"held_out/{key}": value for key, value in look.items()})
                seen = (step % options.look_interval) + 1
                _remember(run.state, step + 1, run.state["loss"] / seen, look)
                if run.state["waited"] == 0:
                    best.load_state_dict(net.state_dict())
    return best.eval(), run.state["curve"]


def split_of(scenes: Sequence[int], share: float, seed: int) -> tuple[list[int], list[int]]:
    """Scenes to train on, and a share of them, at least one, that is held out.

    Raises:
        ValueError: there are fewer than two scenes, or none is left to train on.

    Examples:
        >>> train, held_out = split_of(range(10), 0.2, seed=0)
        >>> len(train), len(held_out), sorted(train + held_out) == list(range(10))
        (8, 2, True)
    """
    count = max(1, round(share * len(scenes)))
    if count >= len(scenes):
        raise ValueError(
            f"training.held_out={share} holds {count} of {len(scenes)} scenes with controlled agents out and leaves "
            "none to train on; lower it, or give more scenes."
        )
    order = [scenes[i] for i in torch.randperm(len(scenes), generator=make_generator(seed, "held out")).tolist()]
    return sorted(order[count:]), sorted(order[:count])


def best_look(curve: Curve) -> dict[str, float]:
    """The look of the largest held-out AUC, and of these the one of the least loss; the earliest of equals.

    The loss is that of agents, and with few scenes it grows early, while the mean over the agents of a scene still
    tells logs from rollouts better and better: what ranks is the score of a scene, so that decides.
    """
    return max(curve, key=lambda look: (look["held_out_auc"], -look["held_out_loss"]))


@torch.no_grad()
def measured_on(net: Discriminator, scenes: Sequence[Motions]) -> dict[str, float]:
    """``loss`` [nats] over all rollouts of some scenes, and ``auc`` of log against rollouts within a scene."""
    losses, areas = [], []
    for each in scenes:
        log, rollouts = net.score(each.log, each.valid), net.score(each.rollouts, each.valid)
        areas.append(auc(log, rollouts))
        both = each.log.expand_as(each.rollouts).flatten(0, 1), each.rollouts.flatten(0, 1)
        valid = each.valid.repeat(len(rollouts), 1)
        losses.append(discriminator_loss(net, *both, valid, valid.any(-1).float()).item())
    return {"loss": sum(losses) / len(losses), "auc": sum(areas) / len(areas)}


def _remember(state: dict[str, Any], step: int, train_loss: float, look: dict[str, float]) -> None:
    """Note a look; ``waited`` counts those since the best one."""
    entry = {"step": step, "train_loss": train_loss, "held_out_loss": look["loss"], "held_out_auc": look["auc"]}
    state["curve"] = [*state["curve"], entry]
    state["waited"] = 0 if best_look(state["curve"]) is entry else state["waited"] + 1
    state["loss"] = 0.0


def _batch(
    shelf: MotionShelf, scenes: Sequence[int], generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Agents of some scenes, as logged and in a random rollout of each; every scene weighs the same."""
    logs, rollouts, valids, weights = [], [], [], []
    for scene in scenes:
        each = shelf.get(scene)
        counted = each.valid.any(-1)
        drawn = int(torch.randint(len(each.rollouts), (), generator=generator))
        logs.append(each.log[0, counted])
        rollouts.append(each.rollouts[drawn, counted])
        valids.append(each.valid[counted])
        weights.append(torch.full((int(counted.sum()),), 1 / int(counted.sum())))
    return torch.cat(logs), torch.cat(rollouts), torch.cat(valids), torch.cat(weights)


def _with_agents(shelf: MotionShelf) -> list[int]:
    """Scenes in which there is anything to see."""
    return [scene for scene in shelf.scenes() if shelf.get(scene).valid.any()]


def _steps(each: Motions) -> Tensor:
    """Valid steps of the log and of the first rollout, ``[N, D]``."""
    return torch.cat((each.log[0][each.valid], each.rollouts[0][each.valid]))
