"""How likely logs, preferred and unpreferred rollouts are under a policy (table 3 of the paper, figures 4, 6 and 7)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from dpa.models import Contexts, Decoding, MotionModel, collate_contexts
from dpa.models.context import Context
from dpa.preferences import PreferenceStore, nearest_farthest
from dpa.rollout import make_collector
from dpa.tokens import MotionTokenizer
from dpa.training.logs import log_item
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import SceneSource

PROBED = (
    "pair_accuracy", "reward_accuracy", "nll_demonstration", "nll_preferred", "nll_unpreferred", "entropy"
)  # fmt: skip
"""What :func:`probe` measures of every scene."""
SIDED = ("pair_accuracy", "nll_preferred", "nll_unpreferred")
"""What :func:`probe_sides` measures of every scene."""


class Probe(NamedTuple):
    """A log and ranked rollouts of one scene: what every policy is asked about, whatever it has learnt from.

    Attributes:
        context: uncollated.
        demonstration: ``[A, T, ...]`` tokens of the log.
        demonstration_valid: ``[A, T]`` bool.
        preferred: ``[M, A, T, ...]`` tokens of the rollouts nearest to the log.
        unpreferred: ``[M, A, T, ...]`` tokens of the farthest ones.
        valid: ``[A, T]`` bool, of the rollouts.
    """

    context: Context
    demonstration: Tensor
    demonstration_valid: Tensor
    preferred: Tensor
    unpreferred: Tensor
    valid: Tensor


def make_probes(
    store: PreferenceStore,
    contexts: Contexts,
    tokenizer: MotionTokenizer,
    pairs: int,
    rows: Iterable[int] | None = None,
    rank_by: str = keys.DISTANCE,
) -> Iterator[Probe]:
    """Probes from ranked rollouts, one by one.

    Args:
        store: of rollouts, ranked by the distance that is asked about.
        contexts: of the scenes that it is of; each is asked for once.
        tokenizer: of logs.
        pairs: M, at most half of the rollouts of a scene.
        rows: of the store; all by default.
        rank_by: ``distance`` or ``ade``, which decides what is near.
    """
    near, far = nearest_farthest(store.distance if rank_by == keys.DISTANCE else store.ade, pairs)
    for row in range(len(store)) if rows is None else rows:
        context = contexts[int(store.scenes[row])]
        group = store.read([row], num_agents=len(context.episode.kind))[0]
        log, tokens = log_item(context, tokenizer), group[keys.TOKENS]
        sides = tokens[near[row]], tokens[far[row]]
        yield Probe(context, log.tokens[0], log.token_valid, *sides, group[keys.TOKEN_VALID])


@torch.no_grad()
def probe(
    model: MotionModel, reference: MotionModel, probes: Iterable[Probe], device: str = "cpu"
) -> list[dict[str, float]]:
    """Ask a policy about each probe.

    Args:
        model: in whatever mode it is; dropout would count.
        reference: what the policy started from.
        probes: of some scenes.
        device: of the models.

    Returns:
        For each probe ``pair_accuracy`` (share of pairs whose preferred rollout is the more likely one),
        ``reward_accuracy`` (share of those whose preferred rollout gained more over the reference, ties count half: a
        policy that has learnt nothing has 0.5), the negative log-likelihood per token [nats] of the demonstration, of
        the preferred and of the unpreferred rollouts, and along the rollouts the ``entropy`` and the ``kl`` from the
        reference per token [nats]. NaN where there is no token: then nothing is the likelier one.
        NaN is also the ``pair_accuracy`` of densities: an agent that stands has a probability and one that moves a
        density, so that a rollout's likelihood is mostly how many of its agents move.
    """
    return [_probed(model, reference, each, device) for each in probes]


@torch.no_grad()
def probe_sides(model: MotionModel, probes: Iterable[Probe], device: str = "cpu") -> list[dict[str, float]]:
    """Ask a policy about the rollouts of each probe alone: one pass, and none of a reference.

    Args:
        model: in whatever mode it is; dropout would count.
        probes: of some scenes.
        device: of the model.

    Returns:
        :data:`SIDED` for each probe, as :func:`probe` gives them.
    """
    found = []
    for each in probes:
        context, tokens, valid = _rollouts(each, device)
        now = _log_prob(model, model(context, tokens, valid), tokens, valid)
        found.append({name: value.item() for name, value in _sides(model, now, valid).items()})
    return found


def _rollouts(each: Probe, device: str) -> tuple[Context, Tensor, Tensor]:
    """Context, tokens ``[1, 2 * M, A, T, ...]`` and validity ``[1, 1, A, T]``, the preferred rollouts first."""
    tokens = torch.cat((each.preferred, each.unpreferred))[None]
    return collate_contexts([each.context]).to(device), tokens.to(device), each.valid[None, None].to(device)


def _log_prob(model: MotionModel, logits: Tensor, tokens: Tensor, valid: Tensor) -> Tensor:
    """``[2 * M]``, of whole rollouts."""
    return (model.distribution.log_prob(logits, tokens)[0] * valid[0]).sum((-1, -2))


def _sides(model: MotionModel, now: Tensor, valid: Tensor) -> dict[str, Tensor]:
    near, far = now.chunk(2)
    likelier = _share_above(near, far, valid)
    return {
        "pair_accuracy": likelier if model.distribution.discrete else torch.full_like(likelier, torch.nan),
        "nll_preferred": -near.mean() / valid.sum(),
        "nll_unpreferred": -far.mean() / valid.sum(),
    }


def _share_above(near: Tensor, far: Tensor, valid: Tensor, tie: float = 0.0) -> Tensor:
    """Share of pairs whose first is larger, an equal one counted as ``tie``; NaN where no token counts."""
    share = ((near > far).double() + tie * (near == far).double()).mean()
    return share if valid.any() else torch.full_like(share, torch.nan)


def _probed(model: MotionModel, reference: MotionModel, each: Probe, device: str) -> dict[str, float]:
    context, tokens, valid = _rollouts(each, device)
    logits, before = (policy(context, tokens, valid) for policy in (model, reference))
    now, then = (_log_prob(model, seen, tokens, valid) for seen in (logits, before))
    near_gain, far_gain = (now - then).chunk(2)
    log_tokens, log_valid = (value[None, None].to(device) for value in (each.demonstration, each.demonstration_valid))
    log = model.distribution.log_prob(model(context, log_tokens, log_valid), log_tokens)
    found = _sides(model, now, valid) | {
        "reward_accuracy": _share_above(near_gain, far_gain, valid, tie=0.5),
        "nll_demonstration": -log[log_valid].mean(),
        "entropy": _mean(model.distribution.entropy(logits), valid),
        "kl": _mean(model.distribution.divergence(logits, before), valid),
    }
    return {name: value.item() for name, value in found.items()}


def _mean(value: Tensor, valid: Tensor) -> Tensor:
    """Over the tokens that count; NaN where there are none."""
    return value[valid.expand_as(value)].mean()


def divergence(
    model: MotionModel,
    reference: MotionModel,
    scenes: SceneSource,
    options: EpisodeOptions,
    *,
    num_rollouts: int,
    seed: int,
    memory: float = 0.25,
    device: str = "cpu",
) -> list[float]:
    """KL(model || reference) per token [nats] of each scene, in order (figure 7 of the paper, right).

    The expectation is taken over the model's own rollouts, drawn from its whole distribution, and is exact within each
    token.

    Args:
        model: aligned policy.
        reference: policy that it started from.
        scenes: to roll out.
        options: of their episodes.
        num_rollouts: of each scene.
        seed: of the rollouts.
        memory: GiB for rollouts.
        device: of both.
    """
    contexts = Contexts(scenes, model.featurize, options, most=1)  # each is asked about once
    batches = make_collector(
        scenes,
        model,
        num_rollouts=num_rollouts,
        decoding=Decoding(top_p=1.0),
        options=options,
        seed=seed,
        memory=memory,
        device=device,
    )
    found = {index: _kl(model, reference, contexts[index], *group) for index, *group in _groups(batches, num_rollouts)}
    return [found[index] for index in range(len(scenes))]


def _groups(batches: Iterable[TensorDictBase], num_rollouts: int) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Scene, tokens ``[K, A, T, ...]``, controlled ``[A]`` of every group of a collector's batches ``[S * K, T]``."""
    for batch in batches:
        tokens = batch[keys.TOKEN].transpose(1, 2)
        for first in range(0, len(batch), num_rollouts):
            group = slice(first, first + num_rollouts)
            yield int(batch[keys.SCENE][first, 0]), tokens[group], batch[keys.CONTROLLED][first, 0]


@torch.no_grad()
def _kl(model: MotionModel, reference: MotionModel, context: Context, tokens: Tensor, controlled: Tensor) -> float:
    num_agents = len(context.episode.kind)
    tokens, controlled = tokens[None, :, :num_agents], controlled[:num_agents]
    valid = controlled[None, None, :, None].expand(1, 1, -1, tokens.shape[3])
    context = collate_contexts([context]).to(tokens.device)
    seen = (policy(context, tokens, valid) for policy in (model, reference))
    return _mean(model.distribution.divergence(*seen), valid).item()
