"""Optimiser, learning-rate schedule and the step that guards against gradients that are not finite."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Literal, TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from dpa.training.distributed import ALONE, Ranks, without_sync
from dpa.training.muon import RMS, Muon

T = TypeVar("T")
OPTIMIZERS = ("adamw", "muon")
SCHEDULES = ("linear", "cosine")
MUON_SIDE = 32
"""Rows and columns that a matrix has at least to be made orthogonal; the thin ones of input features are AdamW's."""
EMBEDDINGS = (nn.Embedding, nn.EmbeddingBag)
SPARED = ("embedding", "bias", "frequency")
"""Ends of the names of bare parameters that are not decayed, whatever their shape."""
BETAS = (0.9, 0.95)
"""Decay rates of AdamW's moments; 0.95 is usual for transformers, whose gradients have heavy tails."""


def make_optimizer(
    module: nn.Module,
    lr: float,
    weight_decay: float,
    betas: tuple[float, float] = BETAS,
    kind: Literal["adamw", "muon"] = "adamw",
    rms: float = RMS,
) -> AdamW:
    """An optimiser whose weight decay spares norms, biases and embeddings.

    Decay pulls towards zero. That regularises the matrices of linear maps, but it shrinks the scale of a norm and the
    rows of tokens that a batch does not contain. Parameters of fewer than two dimensions, those of embedding modules,
    and bare parameters whose name ends in one of :data:`SPARED` are not decayed.

    Args:
        module: whatever holds the parameters to train; those that need no gradient are left out.
        lr: peak learning rate.
        weight_decay: decay of the matrices.
        betas: decay rates of the first and second moment.
        kind: ``adamw``, or ``muon`` for the matrices and AdamW for the rest. Keys and values in one matrix, and the
            output layer, which others leave to AdamW, are matrices like all.
        rms: of Muon's steps, see :data:`~dpa.training.muon.RMS`.

    Raises:
        ValueError: no parameter of ``module`` needs a gradient, or an unknown kind.

    Examples:
        >>> net = nn.Sequential(nn.Embedding(7, 4), nn.Linear(4, 4), nn.LayerNorm(4))
        >>> [(len(g["params"]), g["weight_decay"]) for g in make_optimizer(net, 1e-3, 0.1).param_groups]
        [(1, 0.1), (4, 0.0)]
    """
    if kind not in OPTIMIZERS:
        raise ValueError(f"the optimiser must be one of {', '.join(OPTIMIZERS)}, got {kind!r}.")
    embeddings = {id(p) for part in module.modules() if isinstance(part, EMBEDDINGS) for p in part.parameters()}
    decayed, spared = [], []
    for name, parameter in module.named_parameters():
        if not parameter.requires_grad:
            continue
        spare = parameter.ndim < 2 or id(parameter) in embeddings or name.endswith(SPARED)
        (spared if spare else decayed).append(parameter)
    if not decayed and not spared:
        raise ValueError(f"{type(module).__name__} has no parameter that needs a gradient; unfreeze some of it.")
    if kind == "adamw":
        return AdamW(_group(decayed, weight_decay) + _group(spared, 0.0), lr=lr, betas=betas, fused=True)
    wide = [each for each in decayed if each.ndim == 2 and min(each.shape) >= MUON_SIDE]
    thin = [each for each in decayed if each.ndim != 2 or min(each.shape) < MUON_SIDE]
    rest = _group(thin, weight_decay, orthogonal=False) + _group(spared, 0.0, orthogonal=False)
    return Muon(_group(wide, weight_decay, orthogonal=True, rms=rms) + rest, lr=lr, betas=betas)


def _group(parameters: list[nn.Parameter], weight_decay: float, **more: Any) -> list[dict[str, Any]]:
    """One group, or none where there is no parameter."""
    return [{"params": parameters, "weight_decay": weight_decay, **more}] if parameters else []


def make_schedule(
    optimizer: Optimizer, total_steps: int, warmup_steps: int = 0, shape: Literal["linear", "cosine"] = "cosine"
) -> LambdaLR:
    """Linear warm-up to the optimiser's learning rate, then linear or cosine decay to 0 at ``total_steps``.

    Args:
        optimizer: its ``lr`` is the peak.
        total_steps: updates of the whole run.
        warmup_steps: updates of the warm-up; the last of them is taken at the peak.
        shape: how the rate falls.

    Returns:
        A scheduler to step once per update (:func:`clip_and_step` does).

    Raises:
        ValueError: an unknown shape, or a warm-up that does not end within the run.

    Examples:
        >>> optimizer = make_optimizer(nn.Linear(2, 2), lr=1.0, weight_decay=0.0)
        >>> schedule = make_schedule(optimizer, total_steps=6, warmup_steps=2, shape="linear")
        >>> rates = []
        >>> for _ in range(6):
        ...     rates.append(schedule.get_last_lr()[0])
        ...     _ = clip_and_step(optimizer, max_norm=1.0, schedule=schedule)
        >>> rates
        [0.5, 1.0, 1.0, 0.75, 0.5, 0.25]
    """
    if shape not in SCHEDULES:
        raise ValueError(f"shape must be one of {', '.join(SCHEDULES)}, got {shape!r}.")
    if not 0 <= warmup_steps < total_steps:
        raise ValueError(
            f"warmup_steps must lie in [0, total_steps), got {warmup_steps} of {total_steps}. Shorten the warm-up."
        )

    def factor(step: int) -> float:
        if step < warmup_steps:
            return (step + 1) / warmup_steps
        left = max(0.0, (total_steps - step) / (total_steps - warmup_steps))
        return left if shape == "linear" else 0.5 * (1 - math.cos(math.pi * left))

    return LambdaLR(optimizer, factor)


def accumulate_gradients(
    loss: Callable[[TensorDictBase], TensorDictBase],
    parts: Iterable[tuple[TensorDictBase, float]],
    ranks: Ranks = ALONE,
) -> dict[str, Tensor]:
    """Gradients of a loss over a batch that is passed in parts, on one rank or several.

    Ranks may have different numbers of parts: gradients are exchanged once, in the backward pass of each one's last.

    Args:
        loss: gives ``loss_*`` entries, which are summed, and figures; with several ranks, what
            :meth:`~dpa.training.distributed.Ranks.wrap` returned.
        parts: this rank's parts, each with its share of the whole; the shares of all ranks sum to 1.
        ranks: that pass the batch together.

    Returns:
        Every entry over the whole batch of all ranks, detached: means weighted by share; a figure ``x_std`` beside
        ``x_mean`` is the spread over all parts together.

    Raises:
        ValueError: this rank has no part, and the others would wait for it.

    Examples:
        >>> from tensordict import TensorDict
        >>> weight = torch.ones((), requires_grad=True)
        >>> def loss(batch):
        ...     return TensorDict({"loss_x": weight * batch["x"].mean()})
        >>> first, second = (TensorDict({"x": torch.tensor(x)}) for x in ([1.0, 3.0], [5.0]))
        >>> accumulate_gradients(loss, [(first, 2 / 3), (second, 1 / 3)])["loss_x"], weight.grad
        (tensor(3.), tensor(3.))
    """
    means: dict[str, Tensor] = {}
    kinds: dict[str, torch.dtype] = {}
    for (batch, share), last in _mark_last(parts):
        with without_sync(loss, last):
            found = loss(batch)
            total = sum(value for key, value in found.items() if key.startswith("loss_"))
            (ranks.world_size * share * total).backward()  # the exchange divides by the number of ranks
        # In float64, because a spread is the difference of two large numbers.
        figures = {key: value.detach().double() for key, value in found.items()}
        kinds |= {key: value.dtype for key, value in found.items()}
        for key in _spreads(figures):
            figures[key] = figures[key] ** 2 + figures[key.removesuffix("_std") + "_mean"] ** 2
        for key, value in figures.items():
            means[key] = means.get(key, 0) + share * value
    if not means and not ranks.alone:
        raise ValueError(f"rank {ranks.rank} has no part of the batch; give it one, if need be with a share of 0.")
    means = ranks.sum_figures(means)
    for key in _spreads(means):
        means[key] = (means[key] - means[key.removesuffix("_std") + "_mean"] ** 2).clamp(min=0).sqrt()
    return {key: value.to(kinds[key]) for key, value in means.items()}


def _mark_last(parts: Iterable[T]) -> Iterator[tuple[T, bool]]:
    """Each part, and whether it is the last."""
    before: list[T] = []
    for part in parts:
        if before:
            yield before.pop(), False
        before.append(part)
    if before:
        yield before.pop(), True


def _spreads(figures: dict[str, Tensor]) -> list[str]:
    return [key for key in figures if key.endswith("_std") and key.removesuffix("_std") + "_mean" in figures]


def clip_and_step(
    optimizer: Optimizer,
    max_norm: float,
    schedule: LambdaLR | None = None,
) -> float:
    """Clip the gradients, update the parameters, advance the schedule and clear the gradients.

    Args:
        optimizer: holds the parameters.
        max_norm: bound on the norm of all gradients together.
        schedule: what :func:`make_schedule` returned.

    Returns:
        The norm before clipping.

    Raises:
        FloatingPointError: the norm is infinite or not a number; the parameters are unchanged.

    Examples:
        >>> net = nn.Linear(1, 1, bias=False)
        >>> optimizer = make_optimizer(net, lr=0.1, weight_decay=0.0)
        >>> (3 * net.weight).sum().backward()
        >>> clip_and_step(optimizer, max_norm=1.0)
        3.0
    """
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    norm = torch.nn.utils.clip_grad_norm_(parameters, max_norm).item()
    if not math.isfinite(norm):
        raise FloatingPointError(
            f"the gradient norm is {norm}; the parameters are unchanged. Lower the learning rate, or look for an input "
            "that is not finite."
        )
    optimizer.step()
    if schedule is not None:
        schedule.step()
    optimizer.zero_grad(set_to_none=True)
    return norm
