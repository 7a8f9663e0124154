"""Whether a policy keeps the contract of its family: asked before a training, which would learn from its mistakes."""

from __future__ import annotations

import copy
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from numbers import Real
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase, is_tensorclass
from torch import Tensor
from torchrl.envs import TransformedEnv

from dpa.models.actor import MotionActor
from dpa.models.base import Choose, ContractError, Decision, Memory, MotionModel, Observation, check_logits
from dpa.models.context import Context, Contexts, collate_contexts
from dpa.tokens import TokenAction
from envs import keys
from envs.episode import EpisodeOptions
from envs.scene import Scene
from envs.sources.synthetic import straight_road
from envs.traffic import TrafficEnv

NEAR = 1e-2
"""Log-probabilities of the two ways may differ by this much and this share: rounding is less, a mistake far more."""
NUDGE = 0.05
"""Spread of what is added to fresh weights, under which nothing would say what it sees."""
ROLLOUTS, AGENTS, DECISIONS = 2, 3, 5
"""More decisions than agents: swapped, they would look alike otherwise."""


def check_contract(model: MotionModel) -> None:
    """Drive a copy of a policy through two short roads, decision by decision, and ask it about all of them at once.

    Matrices of the copy are nudged, so that fresh ones say something too; neither the policy nor the global random
    numbers change. A fraction of a second, for policies of up to some million parameters.

    Args:
        model: of any family.

    Raises:
        ContractError: what a method gives has another type or shape than :mod:`dpa.models.base` says, it ends with an
            error, or the two ways do not agree (to :data:`NEAR`): then one of them sees what the other does not.

    Examples:
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> check_contract(MotionLM("nano", VerletTokenizer()))
        >>> class Odd(MotionLM):
        ...     def forward(self, context, tokens, token_valid):
        ...         return super().forward(context, tokens, token_valid).transpose(2, 3)
        >>> check_contract(Odd("nano", VerletTokenizer()))
        Traceback (most recent call last):
        ...
        dpa.models.base.ContractError: Odd.forward must give logits [2, 2, 3, 5, 169], got [2, 2, 5, 3, 169].
    """
    name, tokenizer = type(model).__name__, model.tokenizer
    if model.distribution.discrete and not tokenizer.vocab_size:
        raise ContractError(f"{name} predicts tokens of a vocabulary, and {type(tokenizer).__name__} has none.")
    rows = model.bytes_per_row()
    if not isinstance(rows, Real) or rows < 1:
        raise ContractError(f"{name}.bytes_per_row must give a number of bytes, 1 or more, got {rows!r}.")
    options = EpisodeOptions(decision_steps=tokenizer.steps, horizon=min(DECISIONS, model.config.horizon))
    agents = AGENTS + (options.horizon == AGENTS)
    scenes = [straight_road(agents, seed=1), straight_road(agents - 1, seed=2)]
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        policy = _nudged(model)
        contexts = Contexts(scenes, policy.featurize, options)
        context = _seen(contexts, type(model))
        rolled = _driven(policy, scenes, contexts, options)
        _compare(policy, context, rolled)


@contextmanager
def _asked(method: str, family: type[MotionModel]) -> Iterator[None]:
    """Errors inside the block say which method they come from, and where in the family's own file, if they do."""
    try:
        yield
    except ContractError:
        raise
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if frame.filename == sys.modules[family.__module__].__file__]
        last = (own or frames)[-1]
        place = f"{Path(last.filename).name}, line {last.lineno}"
        raise ContractError(f"{method} ends with {type(error).__name__}: {error} ({place}).") from error


class _Watched:
    """A memory whose errors are told as its own, and whose logits are numbers."""

    def __init__(self, memory: Memory, family: type[MotionModel]) -> None:
        self.memory, self.family, self.name = memory, family, f"the memory of {family.__name__}"

    def begin(self, context: Context, rollouts: int, anew: bool) -> None:
        with _asked(f"begin of {self.name}", self.family):
            self.memory.begin(context, rollouts, anew)

    def step(self, seen: Observation, choose: Choose) -> Decision:
        def of_numbers(logits: Tensor, agents: Tensor | None = None) -> Tensor:
            if not logits.isfinite().all():
                raise ContractError(f"{self.name} chooses by logits that are not finite.")
            return choose(logits, agents)

        with _asked(f"step of {self.name}", self.family):
            return self.memory.step(seen, of_numbers)


def _nudged(model: MotionModel) -> MotionModel:
    policy, generator = copy.deepcopy(model).cpu().eval(), torch.Generator().manual_seed(0)
    for parameter in (each for each in policy.parameters() if each.dim() > 1):  # others may have to be positive
        parameter.add_(NUDGE * torch.randn(parameter.shape, generator=generator))
    return policy


def _seen(contexts: Contexts, family: type[MotionModel]) -> Context:
    """What the policy sees of both scenes."""
    with _asked(name := f"{family.__name__}.featurize", family):
        each = [contexts[index] for index in range(len(contexts))]
        if not is_tensorclass(each[0]) or not hasattr(each[0], "episode") or not hasattr(each[0], "of_agents"):
            raise ContractError(
                f"{name} must give a TensorClass with the field episode and the class variable of_agents, "
                f"got {type(each[0]).__name__}."
            )
        return collate_contexts(each)


def _driven(policy: MotionModel, scenes: list[Scene], contexts: Contexts, options: EpisodeOptions) -> TensorDictBase:
    family = type(policy)
    env = TrafficEnv(scenes, options, num_scenes=len(scenes), num_rollouts=ROLLOUTS)
    env = TransformedEnv(env, TokenAction(policy.tokenizer))
    with _asked(f"{family.__name__}.remember", family):
        actor = MotionActor(policy, contexts, num_rollouts=ROLLOUTS)
        actor._memory = _Watched(actor._memory, family)
    with _asked(f"driving by tokens of {type(policy.tokenizer).__name__}", family):
        return env.rollout(options.horizon, actor)


def _compare(policy: MotionModel, context: Context, rolled: TensorDictBase) -> None:
    """What the policy said decision by decision is what it says of the whole."""

    def by_scene(key: Any) -> Tensor:
        return rolled[key].transpose(1, 2).unflatten(0, (-1, ROLLOUTS))

    name = type(policy).__name__
    tokens, controlled = by_scene(keys.TOKEN), context.episode.controlled[:, None, :, None]
    with _asked(f"{name}.forward", type(policy)):
        logits = policy(context, tokens, controlled.expand(*controlled.shape[:3], tokens.shape[3]))
        check_logits(logits, tokens, f"{name}.forward", policy.tokenizer.vocab_size or None)
    acted = by_scene(keys.CONTROLLED)
    forced, driven = policy.distribution.log_prob(logits, tokens)[acted], by_scene(keys.LOG_PROB)[acted]
    apart = ((forced - driven).abs() - NEAR * driven.abs()).max().item()
    if not apart <= NEAR:
        raise ContractError(
            f"{name} says other log-probabilities of the same tokens in forward and decision by decision (up to "
            f"{(forced - driven).abs().max().item():.2g} nats apart): forward sees what comes later, or what the "
            "memory does not keep."
        )
