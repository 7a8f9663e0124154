"""MotionLM as a TorchRL policy: samples one token per agent, incrementally."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from dpa.policy.context import AGENT_FIELDS, ContextOptions, SceneContext, collate_contexts, make_context
from dpa.policy.decoder import NodeCache, NodeInputs, SceneMemory
from dpa.policy.motionlm import MotionLM
from envs import keys
from envs.scene import SceneSource


class Contexts:
    """Contexts of the scenes of a source, made on first use and kept.

    Args:
        scenes: where scenes come from.
        options: how they are cut up.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> len(Contexts([straight_road(2)]))
        1
    """

    def __init__(self, scenes: SceneSource, options: ContextOptions | None = None) -> None:
        self.scenes = scenes
        self.options = options or ContextOptions()
        self._made: dict[int, SceneContext] = {}

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> SceneContext:
        if index not in self._made:
            self._made[index] = make_context(self.scenes[index], self.options)
        return self._made[index]


class MotionActor(TensorDictModuleBase):
    """Samples tokens for the rows of a :class:`~envs.traffic.TrafficEnv` with :class:`~dpa.tokens.TokenAction`.

    A scene is encoded once, when an episode of it starts, and shared by its K rows; keys and values of the decisions
    taken are kept between calls. Rows may stand at different decisions.

    Args:
        model: the distribution.
        contexts: of the scenes that the environment's ``scene`` index points to.

    Keyword Args:
        num_rollouts: K, contiguous rows that share a scene.
        top_p: sample from the smallest set of tokens with at least this probability (nucleus).
        temperature: divides the logits before ``top_p``.
        seed: of the sampling.

    Raises:
        ValueError: ``top_p`` outside (0, 1] or a temperature that is not positive.

    The written log-probability is that of the model itself, before temperature and ``top_p``.

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
        top_p: float = 1.0,
        temperature: float = 1.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if not 0 < top_p <= 1:
            raise ValueError(f"top_p must lie in (0, 1], got {top_p}.")
        if temperature <= 0:
            raise ValueError(f"temperature must be positive, got {temperature}.")
        self.in_keys = [keys.SCENE, keys.STEP, keys.RECENT, keys.VALID, keys.CONTROLLED, keys.KIND]
        self.out_keys = [keys.TOKEN, keys.LOG_PROB]
        self.model, self.contexts = model, contexts
        self.num_rollouts, self.top_p, self.temperature = num_rollouts, top_p, temperature
        self.seed = seed
        self._generators: dict[torch.device, torch.Generator] = {}
        self._memory: SceneMemory | None = None
        self._cache: NodeCache | None = None

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write a token for every agent and its log-probability."""
        logits = self.logits(tensordict)
        token = self._sample(logits)
        self._last = token
        tensordict[keys.TOKEN] = token
        tensordict[keys.LOG_PROB] = logits.log_softmax(-1).gather(-1, token[..., None])[..., 0]
        return tensordict

    def logits(self, tensordict: TensorDictBase) -> Tensor:
        """``[B, A, V]`` of the decision at hand; adds its nodes to the cache."""
        recent, step = tensordict[keys.RECENT], tensordict[keys.STEP][:, 0]
        self._start(tensordict[keys.SCENE], step, recent.shape[:2])
        controlled = tensordict[keys.CONTROLLED]
        last = torch.where((step[:, None] > 0) & controlled, self._last, self.model.no_token)
        valid = tensordict[keys.VALID]
        masks = self._cache.start(step, valid)
        nodes = NodeInputs(recent, last, step[:, None].expand_as(last), tensordict[keys.KIND], valid)
        return self.model.decoder(nodes, self._memory, masks, self._cache)

    def _start(self, scene: Tensor, step: Tensor, shape: torch.Size) -> None:
        """Encode the scenes of which an episode starts."""
        batch, agents = shape
        if batch % self.num_rollouts:
            raise ValueError(f"num_rollouts must divide the batch of {batch} rows, got {self.num_rollouts}.")
        fresh = (step == 0).view(-1, self.num_rollouts).any(-1)
        if not fresh.any():
            return
        if self._cache is None or self._last.shape != shape or fresh.all():
            config = self.model.config
            dim = config.width // config.heads
            like = self.model.decoder.head.weight
            size = (batch, config.heads, config.horizon, agents)
            self._cache = NodeCache(config.decoder_layers, size, dim, like)
            self._last = torch.full(shape, self.model.no_token, device=step.device)
            fresh = torch.ones_like(fresh)
            self._scenes = scene.view(-1, self.num_rollouts)[:, 0].clone()
        # Padding depends on the scenes of a batch, so a change of some encodes all: rare, and cheap beside the episode.
        self._scenes[fresh] = scene.view(-1, self.num_rollouts)[:, 0][fresh]
        context = collate_contexts([self.contexts[i] for i in self._scenes.tolist()]).to(step.device)
        self._memory = self.model.encode(pad_context(context, agents))

    def _sample(self, logits: Tensor) -> Tensor:
        if exploration_type() is ExplorationType.DETERMINISTIC:
            return logits.argmax(-1)
        probs = nucleus((logits / self.temperature).softmax(-1), self.top_p)
        return probs.flatten(0, -2).multinomial(1, generator=self._generator(logits.device)).view(probs.shape[:-1])

    def _generator(self, device: torch.device) -> torch.Generator:
        if device not in self._generators:
            self._generators[device] = torch.Generator(device).manual_seed(self.seed)
        return self._generators[device]

    def set_seed(self, seed: int) -> None:
        """Seed the sampling anew."""
        self.seed = seed
        self._generators.clear()


def nucleus(probs: Tensor, top_p: float) -> Tensor:
    """Keep the most probable tokens that together reach ``top_p``, renormalised.

    Args:
        probs: ``[..., V]``.
        top_p: in (0, 1].

    Examples:
        >>> nucleus(torch.tensor([0.5, 0.3, 0.2]), 0.6)
        tensor([0.6250, 0.3750, 0.0000])
    """
    if top_p >= 1:
        return probs
    ordered, index = probs.sort(-1, descending=True)
    # A token is kept when those before it have not reached top_p yet; the first one always is.
    kept = ordered * (ordered.cumsum(-1) - ordered < top_p)
    kept = torch.zeros_like(probs).scatter(-1, index, kept)
    return kept / kept.sum(-1, keepdim=True)


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
