"""A policy of any family as a TorchRL policy: samples one token per agent, incrementally."""

from __future__ import annotations

from collections import Counter
from typing import Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from dpa.models.base import ContractError, Decision, MotionModel, Observation, of_agents
from dpa.models.context import Context, Contexts, collate_contexts, pad_context
from dpa.models.distribution import Distribution
from dpa.models.precision import Precision, check_precision, running_in
from dpa.models.sampling import Decoding, rollout_noise
from envs import keys


class Chooser(Protocol):
    """A :class:`~dpa.models.base.Choose` that remembers by which log-probabilities it chose.

    Attributes:
        log_prob: ``[B, A]``, those of what has been chosen so far; 0 where nothing is drawn.
    """

    log_prob: Tensor

    def __call__(self, logits: Tensor, agents: Tensor | None = None) -> Tensor:
        """See :class:`~dpa.models.base.Choose`."""


class Draw:
    """Draws from a distribution made from that of the model.

    Args:
        distribution: of the model.
        uniform: ``[B, A, numbers]`` in [0, 1), that decide.
        decoding: how the distribution is changed.
    """

    def __init__(self, distribution: Distribution, uniform: Tensor, decoding: Decoding) -> None:
        self.distribution, self.uniform, self.decoding = distribution, uniform, decoding
        self.log_prob = torch.zeros_like(uniform[..., 0])

    def __call__(self, logits: Tensor, agents: Tensor | None = None) -> Tensor:
        """See :class:`Chooser`."""
        token, by = self.distribution.draw(logits, of_agents(self.uniform, agents), self.decoding)
        self.log_prob = by if agents is None else self.log_prob.scatter(1, agents, by)
        return token


class Likeliest:
    """Takes the most probable token.

    Args:
        distribution: of the model.
        like: ``[B, A]``, gives shape and device.
    """

    def __init__(self, distribution: Distribution, like: Tensor) -> None:
        self.distribution, self.log_prob = distribution, torch.zeros_like(like)

    def __call__(self, logits: Tensor, agents: Tensor | None = None) -> Tensor:
        """See :class:`Chooser`."""
        return self.distribution.likeliest(logits)


class MotionActor(TensorDictModuleBase):
    """Samples tokens for the rows of a :class:`~envs.traffic.TrafficEnv` with :class:`~dpa.tokens.TokenAction`.

    What a policy sees of a scene is made once, when an episode of it starts, and shared by its K rows; the policy's
    memory keeps the decisions taken between calls. Rows may stand at different decisions.

    A rollout is decided by the scene's id, its number k among the scene's rollouts and the seed: not by the batch that
    it is part of, up to the rounding of the logits (about 1e-6), which can turn a draw that falls between two tokens.
    When a rollout is begun again, or stands in a batch more than once, it comes out anew; an episode of a single
    decision is not known from one that was tried out, and is the same until :meth:`set_seed`.

    Args:
        model: the distribution.
        contexts: of the scenes that the environment's ``scene`` index points to.

    Keyword Args:
        num_rollouts: K, contiguous rows that share a scene.
        decoding: the distribution that tokens are drawn from; that of the model by default.
        seed: of the sampling.
        first_rollout: number of the first of the K rollouts, where others roll out the ones before.
        precision: ``"bfloat16"`` runs linear layers in bfloat16 (autocast), for GPUs; attention that holds places
            relative to each other as differences of large numbers stays in float32. ``"float32"`` is exact.
        compile: run what decodes through :func:`torch.compile`: slow at first, for half a minute, then faster. It needs
            a C++ compiler. Values agree to float32's rounding.

    Raises:
        ValueError: an unknown precision, or a family whose decoding is not compiled, and is to be.

    ``log_prob`` is that of the model itself, ``sampling_log_prob`` that of the distribution drawn from (0 for the most
    probable token, which ``ExplorationType.DETERMINISTIC`` and ``MODE`` take).

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import TokenAction, VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> from envs.traffic import TrafficEnv
        >>> scenes, model = [straight_road(2)], MotionLM("nano", VerletTokenizer())
        >>> env = TransformedEnv(TrafficEnv(scenes, num_rollouts=4), TokenAction(model.tokenizer))
        >>> actor = MotionActor(model, Contexts(scenes, model.featurize), num_rollouts=4)
        >>> env.rollout(16, actor)["agents", "token"].shape
        torch.Size([4, 16, 2])
    """

    def __init__(
        self,
        model: MotionModel,
        contexts: Contexts,
        *,
        num_rollouts: int = 1,
        decoding: Decoding | None = None,
        seed: int = 0,
        first_rollout: int = 0,
        precision: Precision = "float32",
        compile: bool = False,
    ) -> None:
        super().__init__()
        self.in_keys = [keys.SCENE, keys.STEP, keys.RECENT, keys.VALID, keys.CONTROLLED, keys.KIND]
        self.out_keys = [keys.TOKEN, keys.LOG_PROB, keys.SAMPLING_LOG_PROB]
        self.model, self.contexts = model, contexts
        self.num_rollouts, self.first_rollout = num_rollouts, first_rollout
        self.decoding, self.precision = decoding or Decoding(top_p=1.0), check_precision(precision)
        if compile and not model.compiles:
            raise ValueError(f"compile=true: decoding of {type(model).__name__} is not compiled; say compile=false.")
        self._memory = model.remember(compile=compile)
        self._due: list[int] = []  # the decision that each row takes next
        self._last: Tensor | None = None  # [B, A, ...], tokens of the decision before
        self.set_seed(seed)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a token for every agent and its log-probabilities."""
        (token, logits), chooser = self.decide(tensordict)
        tensordict[keys.TOKEN] = token
        tensordict[keys.LOG_PROB] = self.model.distribution.log_prob(logits, token)
        tensordict[keys.SAMPLING_LOG_PROB] = chooser.log_prob
        return tensordict

    def decide(self, tensordict: TensorDictBase) -> tuple[Decision, Chooser]:
        """Take the decision at hand, which the memory keeps, and say how its tokens were chosen."""
        seen = self._observe(tensordict)
        chooser = self.chooser(tensordict)
        with running_in(self.precision, seen.recent.device):
            decision = self._memory.step(seen, chooser)
        self._check_decision(decision, seen)
        self._last = decision.token
        return decision, chooser

    def chooser(self, tensordict: TensorDictBase) -> Chooser:
        """What chooses the tokens of the decision at hand."""
        step = tensordict[keys.STEP][:, 0]
        uniform = self._noise_there[torch.arange(len(step), device=step.device), step]
        if exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE):
            return Likeliest(self.model.distribution, uniform[..., 0])
        return Draw(self.model.distribution, uniform, self.decoding)

    def set_seed(self, seed: int) -> None:
        """Seed the sampling anew: the rollouts that begin from now on are the first ones of this seed."""
        self.seed = seed
        self._begun: dict[tuple[int, int], int] = {}

    def _observe(self, tensordict: TensorDictBase) -> Observation:
        step = tensordict[keys.STEP][:, 0]
        at = step.tolist()  # all that is read back from the device in a decision
        self._start(tensordict, at)
        self._due = [each + 1 for each in at]
        acted = self.model.tokenizer.of_numbers((step[:, None] > 0) & tensordict[keys.CONTROLLED])
        last = torch.where(acted, self._last, self.model.no_token)
        return Observation(tensordict[keys.RECENT], last, step, max(at), tensordict[keys.KIND], tensordict[keys.VALID])

    def _check_decision(self, decision: object, seen: Observation) -> None:
        """Refuse what a memory may not give: broadcast, it would pass for a decision of other agents."""
        rows, what = seen.valid.shape, type(decision).__name__
        wanted = f"a Decision of tokens {[*rows, *self.model.tokenizer.shape]} and logits {[*rows, 'P']}"
        if isinstance(decision, Decision):
            token, logits = (getattr(value, "shape", torch.Size()) for value in decision)
            if token == (*rows, *self.model.tokenizer.shape) and logits[:-1] == rows:
                return
            what = f"tokens {list(token)} and logits {list(logits)}"
        raise ContractError(f"the memory of {type(self.model).__name__} must give {wanted} at every step, got {what}.")

    # --- the start of episodes --------------------------------------------------------------------------------------
    def _start(self, tensordict: TensorDictBase, at: list[int]) -> None:
        """Look at the scenes of which an episode starts, and draw the numbers that decide the rollouts that do."""
        step, shape = tensordict[keys.STEP][:, 0], tensordict[keys.VALID].shape
        if shape[0] % self.num_rollouts:
            raise ValueError(f"num_rollouts must divide the batch of {shape[0]} rows, got {self.num_rollouts}.")
        self._check_order(at)
        if 1 in at:
            self._count(at)
        if 0 not in at:
            return
        scene, begins = tensordict[keys.SCENE].tolist(), [row for row, each in enumerate(at) if each == 0]
        anew = self._last is None or self._last.shape[:2] != shape or len(begins) == len(at)
        if anew:
            self._last = self.model.no_tokens(shape, step.device)
            self._noise = torch.zeros(shape[0], self.model.config.horizon, shape[1], self.model.distribution.numbers)
            begins = list(range(len(at)))
            self._scenes = scene[:: self.num_rollouts]
        # Padding depends on the scenes of a batch, so a change of some encodes all: rare, and cheap beside the episode.
        for row in begins:
            self._scenes[row // self.num_rollouts] = scene[row - row % self.num_rollouts]
        context = collate_contexts([self.contexts[i] for i in self._scenes]).to(step.device)
        context = pad_context(context, shape[1])
        self._check_agents(context, tensordict, step == 0)
        self._context = context
        with running_in(self.precision, step.device):
            self._memory.begin(context, self.num_rollouts, anew)
        self._draw_noise(begins, scene)

    def _check_order(self, at: list[int]) -> None:
        due = self._due if len(self._due) == len(at) else [0] * len(at)
        if any(each not in (0, own) for each, own in zip(at, due, strict=True)):
            raise ValueError(
                f"decisions of a rollout must follow each other from 0 on, got {at} where {due} or 0 was due; reset "
                "the environment, and give each environment an actor of its own."
            )

    def _check_agents(self, context: Context, tensordict: TensorDictBase, begins: Tensor) -> None:
        """Refuse contexts of other agents than the environment's."""
        group = begins.nonzero()[:, 0] // self.num_rollouts
        for name, key in (("kind", keys.KIND), ("valid", keys.VALID), ("recent", keys.RECENT)):
            mine, theirs = getattr(context.episode, name)[group], tensordict[key][begins]
            if not torch.allclose(mine.float(), theirs.float(), atol=1e-3):
                raise ValueError(
                    f"the contexts of the policy and the environment differ in {name!r} of the agents of a scene; give "
                    "both the same scenes, arrivals, decision_steps and horizon."
                )

    def _count(self, at: list[int]) -> None:
        """An episode has begun when it takes its second decision: a collector may try a policy out on the first one."""
        for row in (row for row, each in enumerate(at) if each == 1):
            group, number = divmod(row, self.num_rollouts)
            named = (self._scenes[group], self.first_rollout + number)
            self._begun[named] = self._begun.get(named, 0) + 1

    def _draw_noise(self, rows: list[int], scene: list[int]) -> None:
        horizon, numbers, beside = self.model.config.horizon, self.model.distribution.numbers, Counter()
        for row in rows:
            rollout = self.first_rollout + row % self.num_rollouts
            named = (scene[row], rollout)
            episode = self._begun.get(named, 0) + beside[named]
            beside[named] += 1  # groups of one batch may show the same scene
            agents = len(self.contexts[scene[row]].episode.kind)
            scene_id, drawn = self.contexts.scene_id(scene[row]), (horizon, agents, numbers)
            self._noise[row, :, :agents] = rollout_noise(self.seed, scene_id, rollout, episode, drawn)
        self._noise_there = self._noise.to(self._last.device, non_blocking=True)
