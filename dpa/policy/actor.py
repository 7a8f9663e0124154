"""MotionLM as a TorchRL policy: samples one token per agent, incrementally."""

from __future__ import annotations

from collections import Counter

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from dpa.policy.context import AGENT_FIELDS, ContextOptions, SceneContext, collate_contexts, make_context
from dpa.policy.decoder import NodeCache, NodeInputs, SceneMemory
from dpa.policy.motionlm import MotionLM
from dpa.policy.precision import Precision, check_precision, running_in
from dpa.policy.sampling import Decoding, draw, rollout_noise
from envs import keys
from envs.scene import SceneSource


class Contexts:
    """Contexts of the scenes of a source, made on first use; the latest are kept.

    Args:
        scenes: where scenes come from.
        options: how they are cut up.
        most: contexts that are kept, of about 100 KB each.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> contexts = Contexts([straight_road(2)])
        >>> len(contexts), contexts.scene_id(0)
        (1, 'straight_road_2_None')
    """

    def __init__(self, scenes: SceneSource, options: ContextOptions | None = None, most: int = 4096) -> None:
        self.scenes = scenes
        self.options = options or ContextOptions()
        self.most = most
        self._made: dict[int, tuple[SceneContext, str]] = {}

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> SceneContext:
        return self._entry(index)[0]

    def scene_id(self, index: int) -> str:
        """The id of a scene."""
        return self._entry(index)[1]

    def _entry(self, index: int) -> tuple[SceneContext, str]:
        entry = self._made.pop(index, None)
        if entry is None:
            scene = self.scenes[index]
            entry = make_context(scene, self.options), scene.scene_id
        if len(self._made) >= self.most:
            del self._made[next(iter(self._made))]  # the one whose last use is longest ago
        self._made[index] = entry
        return entry


class MotionActor(TensorDictModuleBase):
    """Samples tokens for the rows of a :class:`~envs.traffic.TrafficEnv` with :class:`~dpa.tokens.TokenAction`.

    A scene is encoded once, when an episode of it starts, and shared by its K rows; keys and values of the decisions
    taken are kept between calls. Rows may stand at different decisions.

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
        precision: ``"bfloat16"`` runs linear layers in bfloat16 (autocast), for GPUs; attention, which holds places
            relative to each other as differences of large numbers, stays in float32. ``"float32"`` is exact.
        compile: run the decoder through :func:`torch.compile`: slow at first, for half a minute, then faster. It needs
            a C++ compiler. Values agree to float32's rounding.

    Raises:
        ValueError: an unknown precision.

    ``log_prob`` is that of the model itself, ``sampling_log_prob`` that of the distribution drawn from (0 for the most
    probable token, which ``ExplorationType.DETERMINISTIC`` and ``MODE`` take).

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from dpa.tokens import TokenAction, VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> from envs.traffic import TrafficEnv
        >>> scenes, tokenizer = [straight_road(2)], VerletTokenizer()
        >>> env = TransformedEnv(TrafficEnv(scenes, num_rollouts=4), TokenAction(tokenizer))
        >>> actor = MotionActor(MotionLM("nano", tokenizer), Contexts(scenes), num_rollouts=4)
        >>> env.rollout(16, actor)["agents", "token"].shape
        torch.Size([4, 16, 2])
    """

    def __init__(
        self,
        model: MotionLM,
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
        # Of the method, so that the wrapper of a module is not registered beside the module.
        self._decode = torch.compile(model.decoder.forward) if compile else model.decoder.forward
        self._memory: SceneMemory | None = None
        self._due: Tensor | None = None  # [B], the decision that each row takes next
        self._cache: NodeCache | None = None
        self.set_seed(seed)

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a token for every agent and its log-probabilities."""
        logits = self.logits(tensordict).float()
        token, sampling = self._sample(logits, tensordict[keys.STEP][:, 0])
        self._last = token
        tensordict[keys.TOKEN] = token
        tensordict[keys.LOG_PROB] = logits.log_softmax(-1).gather(-1, token[..., None])[..., 0]
        tensordict[keys.SAMPLING_LOG_PROB] = sampling
        return tensordict

    def logits(self, tensordict: TensorDictBase) -> Tensor:
        """``[B, A, V]`` of the decision at hand; adds its nodes to the cache."""
        recent, step = tensordict[keys.RECENT], tensordict[keys.STEP][:, 0]
        self._start(tensordict)
        self._due = step + 1
        controlled = tensordict[keys.CONTROLLED]
        last = torch.where((step[:, None] > 0) & controlled, self._last, self.model.no_token)
        valid = tensordict[keys.VALID]
        masks = self._cache.start(step, valid)
        nodes = NodeInputs(recent, last, step[:, None].expand_as(last), tensordict[keys.KIND], valid)
        with running_in(self.precision, recent.device):
            return self._decode(nodes, self._memory, masks, self._cache)

    def set_seed(self, seed: int) -> None:
        """Seed the sampling anew: the rollouts that begin from now on are the first ones of this seed."""
        self.seed = seed
        self._begun: dict[tuple[int, int], int] = {}

    # --- the start of episodes --------------------------------------------------------------------------------------
    def _start(self, tensordict: TensorDictBase) -> None:
        """Encode the scenes of which an episode starts, and draw the numbers that decide the rollouts that do."""
        step, shape = tensordict[keys.STEP][:, 0], tensordict[keys.VALID].shape
        if shape[0] % self.num_rollouts:
            raise ValueError(f"num_rollouts must divide the batch of {shape[0]} rows, got {self.num_rollouts}.")
        scene, begins = tensordict[keys.SCENE], step == 0
        self._check_order(step)
        if (step == 1).any():
            self._count(scene, step)
        if not begins.any():
            return
        if self._cache is None or self._last.shape != shape or begins.all():
            self._allocate(shape, step.device)
            begins = torch.ones_like(begins)
            self._scenes = scene.view(-1, self.num_rollouts)[:, 0].clone()
        fresh = begins.view(-1, self.num_rollouts).any(-1)
        # Padding depends on the scenes of a batch, so a change of some encodes all: rare, and cheap beside the episode.
        self._scenes[fresh] = scene.view(-1, self.num_rollouts)[:, 0][fresh]
        context = collate_contexts([self.contexts[i] for i in self._scenes.tolist()]).to(step.device)
        context = pad_context(context, shape[1])
        self._check_agents(context, tensordict, step == 0)
        self._context = context
        with running_in(self.precision, step.device):
            self._memory = self.model.encode(context)
        self._draw_noise(begins.nonzero()[:, 0].tolist(), scene.tolist())

    def _check_order(self, step: Tensor) -> None:
        due = self._due if self._due is not None and self._due.shape == step.shape else torch.zeros_like(step)
        if ((step > 0) & (step != due)).any():
            raise ValueError(
                f"decisions of a rollout must follow each other from 0 on, got {step.tolist()} where {due.tolist()} or "
                "0 was due; reset the environment, and give each environment an actor of its own."
            )

    def _check_agents(self, context: SceneContext, tensordict: TensorDictBase, begins: Tensor) -> None:
        """Refuse contexts of other agents than the environment's."""
        group = begins.nonzero()[:, 0] // self.num_rollouts
        for name, key in (("kind", keys.KIND), ("valid", keys.VALID), ("recent", keys.RECENT)):
            mine, theirs = getattr(context, name)[group], tensordict[key][begins]
            if not torch.allclose(mine.float(), theirs.float(), atol=1e-3):
                raise ValueError(
                    f"the contexts of the policy and the environment differ in {name!r} of the agents of a scene; give "
                    "both the same scenes, arrivals, decision_steps and horizon."
                )

    def _allocate(self, shape: torch.Size, device: torch.device) -> None:
        """Buffers for B rows of A agents; those of the episodes before serve again."""
        config = self.model.config
        size = (shape[0], config.heads, config.horizon, shape[1])
        if self._cache is None or self._cache.shape != size:
            like = self.model.decoder.head.weight
            self._cache = NodeCache(config.decoder_layers, size, config.width // config.heads, like)
        self._cache.clear()
        self._last = torch.full(shape, self.model.no_token, device=device)
        self._noise = torch.zeros(shape[0], config.horizon, shape[1])

    def _count(self, scene: Tensor, step: Tensor) -> None:
        """An episode has begun when it takes its second decision: a collector may try a policy out on the first one."""
        for row in (step == 1).nonzero()[:, 0].tolist():
            named = (int(scene[row]), self.first_rollout + row % self.num_rollouts)
            self._begun[named] = self._begun.get(named, 0) + 1

    def _draw_noise(self, rows: list[int], scene: list[int]) -> None:
        horizon, beside = self.model.config.horizon, Counter()
        for row in rows:
            rollout = self.first_rollout + row % self.num_rollouts
            named = (scene[row], rollout)
            episode = self._begun.get(named, 0) + beside[named]
            beside[named] += 1  # groups of one batch may show the same scene
            agents = len(self.contexts[scene[row]].kind)
            scene_id = self.contexts.scene_id(scene[row])
            self._noise[row, :, :agents] = rollout_noise(self.seed, scene_id, rollout, episode, (horizon, agents))
        self._noise_there = self._noise.to(self._last.device, non_blocking=True)

    # --- sampling ---------------------------------------------------------------------------------------------------
    def _sample(self, logits: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Tokens ``[B, A]`` and the log-probabilities by which they were drawn."""
        if exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE):
            token = logits.argmax(-1)
            return token, torch.zeros_like(logits[..., 0])
        log_probs = self.decoding.log_probs(logits)
        uniform = self._noise_there[torch.arange(len(step), device=step.device), step]
        token = draw(log_probs, uniform)
        return token, log_probs.gather(-1, token[..., None])[..., 0]


def pad_context(context: SceneContext, agents: int) -> SceneContext:
    """Pad the agents of a batch of contexts to ``agents``.

    Raises:
        ValueError: the contexts hold more agents.
    """
    missing = agents - context.kind.shape[1]
    if missing < 0:
        raise ValueError(f"the contexts hold {context.kind.shape[1]} agents and the environment {agents}.")
    context = context.clone(recurse=False)
    for name in AGENT_FIELDS:
        value = getattr(context, name)
        setattr(context, name, torch.cat((value, value.new_zeros(len(value), missing, *value.shape[2:])), 1))
    return context
